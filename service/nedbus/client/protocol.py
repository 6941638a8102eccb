"""The acknowledgement protocol between publishers and readers.

A lossless publisher requests acknowledgements from readers of mode `every` with the query
`<key>/@ack?publisher=<id>;number=<sequence number>;read=<0 or 1>`.
"""

from collections.abc import Callable
from typing import Final

LIVE: Final = b"live"  # attachment of a publisher's reply with its last message; a storage's reply has none
CLOSED: Final = b"closed"  # acknowledgement of a closed reader; others are empty
_MAX_DIGITS: Final = 10  # of a sequence number


def read_parameters(get: Callable[[str], str | None]) -> tuple[str, int, bool] | None:
    """Return publisher, number and `read` of an acknowledgement request, None if it is invalid.

    `get` returns a parameter by name.
    """
    publisher, number = get("publisher"), get("number") or ""
    if publisher is None or not number.isdecimal() or len(number) > _MAX_DIGITS:
        return None
    return publisher, int(number), get("read") == "1"
