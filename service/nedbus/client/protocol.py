"""The protocol of publishers and readers of nedbus beside messages.

A lossless publisher requests acknowledgements of the readers of mode `every` with the query
`<key>/@ack?publisher=<id>;number=<sequence number>;read=<0 or 1>`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

LIVE: Final = b"live"
"""Attachment of a publisher's answer with its last message, which that of a storage does not have."""

CLOSED: Final = b"closed"
"""The acknowledgement of a reader that is closed; that of any other is empty."""

_MAX_DIGITS: Final = 10  # of a sequence number


def write_parameters(publisher: str, number: int, *, read: bool) -> str:
    """Return the parameters of the query that requests an acknowledgement."""
    return f"publisher={publisher};number={number};read={read:d}"


def read_parameters(get: Callable[[str], str | None]) -> tuple[str, int, bool] | None:
    """Return publisher, number and `read` of a query; `get` returns its parameters by name. None for others."""
    publisher, number = get("publisher"), get("number") or ""
    if publisher is None or not number.isdecimal() or len(number) > _MAX_DIGITS:
        return None
    return publisher, int(number), get("read") == "1"
