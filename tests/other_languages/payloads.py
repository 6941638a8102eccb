"""Print the values of payloads, given in hexadecimal: one line each, separated by spaces, texts in hexadecimal."""

import sys

from decode import decode_payload  # type: ignore[import-not-found] # of the documentation


def show(value: object) -> str:
    """Return the text of a value."""
    if isinstance(value, list):
        return "".join(map(show, value))
    return f" {value.hex() if isinstance(value, bytes) else value}"


for text in sys.argv[1:]:
    print(show(decode_payload(bytes.fromhex(text))))  # noqa: T201 - the test reads it
