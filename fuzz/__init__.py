"""Coverage-guided fuzzing of everything that parses foreign bytes, with Atheris (`make fuzz`)."""
