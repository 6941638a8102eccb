"""The addresses that are published: queried once, then followed by their liveliness tokens."""

from __future__ import annotations

import logging
import threading
import time
from itertools import groupby
from operator import attrgetter
from typing import Final

from nedbus.log_event import about
from nedbus.transport import MAX_ANSWERS, AliveChanges, Session, ask_alive_keys
from nedbus_msgs import Address, AddressError, address_of_alive_key, alive_key_expr

_log = logging.getLogger(__name__)

_INCOMPLETE_PAUSE: Final = 10.0  # s after an incomplete answer
_CONTRADICTED_PAUSE: Final = 0.2  # s after one that looks complete, and lacks what is known


class VehicleDirectory:
    """The addresses that are published, from the first query on.

    Asking a router for all tokens costs all its clients; following them costs nothing while nothing changes.
    Zenoh 1.10 can leave out of an answer, on a busy host, any of the tokens that this session was told of before, and
    it looks complete: so all tokens are followed from the first, and what is known has to be in an answer.
    At most 10,000 tokens are kept of all peers; that there are more, or that the router was too slow to list
    them, is logged.
    """

    def __init__(self, session: Session, *, prefix: str) -> None:
        self._session = session
        self._prefix = prefix
        self._key_expr = alive_key_expr(prefix=prefix)
        self._lock = threading.Lock()
        self._addresses: dict[str, Address] = {}  # by the key of the token
        self._next_query = float("-inf")
        self._changes: AliveChanges | None = None

    def vehicles(self, *, timeout: float) -> dict[str, list[Address]]:
        """Return the addresses of each vehicle, both sorted; the first call waits up to `timeout` seconds."""
        with self._lock:
            if self._changes is None:
                self._changes = AliveChanges(self._session, self._key_expr)
            self._take(self._changes)
            if time.monotonic() >= self._next_query:
                self._query(timeout)
                self._take(self._changes)  # what went meanwhile
            addresses = sorted(self._addresses.values())
        return {vehicle: list(group) for vehicle, group in groupby(addresses, key=attrgetter("vehicle"))}

    def _query(self, timeout: float) -> None:
        keys, complete = ask_alive_keys(self._session, self._key_expr, timeout=timeout)
        pause = float("inf") if self._addresses.keys() <= set(keys) else _CONTRADICTED_PAUSE
        self._next_query = time.monotonic() + (pause if complete else _INCOMPLETE_PAUSE)
        for key in keys:
            self._change(key, alive=True)
        if not complete:
            text = "%s: not all liveliness tokens are known, after %d: some vehicles are missing"
            _log.warning(text, self._key_expr, len(keys), extra=about("incomplete"))

    def _take(self, changes: AliveChanges) -> None:
        taken = changes.take()
        if changes.missed:
            changes.missed = False
            self._addresses.clear()
            self._next_query = float("-inf")
        for key, alive in taken:
            self._change(key, alive=alive)

    def _change(self, key: str, *, alive: bool) -> None:
        if not alive:
            self._addresses.pop(key, None)
        elif len(self._addresses) < MAX_ANSWERS:
            try:
                self._addresses[key] = address_of_alive_key(key, prefix=self._prefix)
            except AddressError:
                _log.debug("%r: a liveliness token that is not one of nedbus", key[:200])
