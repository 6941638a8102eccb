"""The addresses that are published: queried once, then followed by their liveliness tokens."""

from __future__ import annotations

import logging
import threading
import time
from itertools import groupby
from operator import attrgetter
from typing import Final

from nedbus.transport import AliveTokens, Session
from nedbus_msgs import Address, AddressError, address_of_alive_key, alive_key_expr

_log = logging.getLogger(__name__)

_POLL: Final = 0.002  # s between two looks for an answer


class VehicleDirectory:
    """The addresses that are published, from the first query on."""

    def __init__(self, *, prefix: str) -> None:
        self._prefix = prefix
        self._lock = threading.Lock()
        self._addresses: dict[str, Address] = {}  # by the key of the token
        self._tokens: AliveTokens | None = None

    def vehicles(self, session: Session, *, timeout: float) -> dict[str, list[Address]]:
        """Return the addresses of each vehicle, both sorted; the first call waits up to `timeout` seconds."""
        with self._lock:
            if self._tokens is None:
                self._tokens = AliveTokens(session, alive_key_expr(prefix=self._prefix))
                self._tokens.ask()
            self._take(self._tokens, timeout)
            while self._tokens.is_asking:
                time.sleep(_POLL)
                self._take(self._tokens, timeout)
            self._take(self._tokens, timeout)  # what the subscriber was told before the last answer
            addresses = sorted(self._addresses.values())
        return {vehicle: list(group) for vehicle, group in groupby(addresses, key=attrgetter("vehicle"))}

    def _take(self, tokens: AliveTokens, timeout: float) -> None:
        for key, alive in tokens.take(timeout=timeout):
            if not alive:
                self._addresses.pop(key, None)
                continue
            try:
                self._addresses[key] = address_of_alive_key(key, prefix=self._prefix)
            except AddressError:
                _log.debug("%r: a liveliness token that is not one of nedbus", key[:200])
