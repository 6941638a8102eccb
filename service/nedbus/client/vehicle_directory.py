"""Which addresses are published: asked once, then followed by their liveliness tokens."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable

from nedbus.transport import MAX_ANSWERS, Session, alive_keys, follow_alive_keys
from nedbus_msgs import Address, AddressError, address_of_alive_key, alive_key_expr

_log = logging.getLogger(__name__)


class VehicleDirectory:
    """Know the addresses that are published, from the first question on.

    Asking a router for all tokens costs everybody who shares it; following them costs nothing while nothing changes.
    At most 10,000 tokens are kept, whoever declares them.
    """

    def __init__(self, session: Session, *, prefix: str) -> None:
        self._session = session
        self._prefix = prefix
        self._opening = threading.Lock()
        self._addresses: dict[str, Address] = {}  # by the key of the token
        self._gone: set[str] = set()  # tokens that went while all were asked for
        self._full = False
        self._end: Callable[[], object] | None = None

    def vehicles(self, *, timeout: float) -> dict[str, list[Address]]:
        """Return the addresses of each vehicle, both sorted; the first call waits up to `timeout` seconds."""
        with self._opening:
            if self._end is None:
                key_expr = alive_key_expr(prefix=self._prefix)
                self._end = follow_alive_keys(self._session, key_expr, self._on_change)
                found = alive_keys(self._session, key_expr, timeout=timeout)
                for key in found:
                    if key not in self._gone:
                        self._on_change(key, True)
                self._gone.clear()
        vehicles: dict[str, list[Address]] = {}
        for address in sorted(self._addresses.copy().values()):
            vehicles.setdefault(address.vehicle, []).append(address)
        return vehicles

    def _on_change(self, key: str, alive: bool) -> None:
        if not alive:
            self._addresses.pop(key, None)
            if self._opening.locked() and len(self._gone) < MAX_ANSWERS:
                self._gone.add(key)
        elif len(self._addresses) < MAX_ANSWERS:
            self._add(key)
        elif not self._full:
            self._full = True
            _log.warning(
                "more than %d liveliness tokens under %s: not all vehicles are known", MAX_ANSWERS, self._prefix
            )

    def _add(self, key: str) -> None:
        try:
            self._addresses[key] = address_of_alive_key(key, prefix=self._prefix)
        except AddressError:
            _log.debug("%.200r: a liveliness token that is not one of nedbus", key)
