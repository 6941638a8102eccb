"""Which addresses are published: asked once, then followed by their liveliness tokens."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from typing import Final

from nedbus.log_event import about
from nedbus.transport import MAX_ANSWERS, Session, ask_alive_keys, follow_alive_keys
from nedbus_msgs import Address, AddressError, address_of_alive_key, alive_key_expr

_log = logging.getLogger(__name__)

_ASK_AGAIN: Final = 30.0  # s after an incomplete answer


class VehicleDirectory:
    """Know the addresses that are published, from the first question on.

    Asking a router for all tokens costs everybody who shares it; following them costs nothing while nothing changes.
    At most 10,000 tokens are kept, whoever declares them; that there are more, or that the router was too slow to list
    them, is logged.
    """

    def __init__(self, session: Session, *, prefix: str) -> None:
        self._session = session
        self._prefix = prefix
        self._asking = threading.Lock()
        self._addresses: dict[str, Address] = {}  # by the key of the token
        self._gone: set[str] = set()  # tokens that went while all were asked for
        self._next_ask = float("-inf")
        self._end: Callable[[], object] | None = None

    def vehicles(self, *, timeout: float) -> dict[str, list[Address]]:
        """Return the addresses of each vehicle, both sorted; the first call waits up to `timeout` seconds."""
        with self._asking:
            key_expr = alive_key_expr(prefix=self._prefix)
            if self._end is None:
                self._end = follow_alive_keys(self._session, key_expr, self._on_change)
            if time.monotonic() >= self._next_ask:
                self._ask(key_expr, timeout)
        vehicles: dict[str, list[Address]] = {}
        for address in sorted(self._addresses.copy().values()):
            vehicles.setdefault(address.vehicle, []).append(address)
        return vehicles

    def _ask(self, key_expr: str, timeout: float) -> None:
        keys, complete = ask_alive_keys(self._session, key_expr, timeout=timeout)
        for key in keys:
            if key not in self._gone:
                self._on_change(key, True)
        self._gone.clear()
        self._next_ask = float("inf") if complete else time.monotonic() + _ASK_AGAIN
        if not complete:
            _log.warning(
                "%s: not all liveliness tokens are known, after %d: some vehicles are missing",
                key_expr,
                len(keys),
                extra=about("incomplete"),
            )

    def _on_change(self, key: str, alive: bool) -> None:
        if not alive:
            self._addresses.pop(key, None)
            if self._asking.locked() and len(self._gone) < MAX_ANSWERS:
                self._gone.add(key)
        elif len(self._addresses) < MAX_ANSWERS:
            try:
                self._addresses[key] = address_of_alive_key(key, prefix=self._prefix)
            except AddressError:
                _log.debug("%.200r: a liveliness token that is not one of nedbus", key)
