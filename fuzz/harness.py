"""Fuzz one parser with libFuzzer: `python -m fuzz.harness ulog FOLDER`; if FOLDER is a file, run only that input."""

import logging
import sys

import atheris

# guides inputs to what `startswith` expects; the hook for `re` lacks arguments
atheris.enabled_hooks.add("str")
with atheris.instrument_imports(include=["nedbus", "nedbus_msgs", "mcap"]):
    from . import parsers


def main() -> None:
    """Run until a limit is reached, or until an error escapes."""
    name, *flags = sys.argv[1:]
    logging.disable()  # gaps in a log are expected here
    parse = parsers.PARSERS[name]

    def run(data: bytes) -> None:
        parse(data)

    atheris.Setup([name, *flags], run)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
