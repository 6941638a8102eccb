"""Coverage-guided fuzzing of all parsers of untrusted bytes, with Atheris (`make fuzz`)."""
