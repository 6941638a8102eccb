"""The vehicle directory: published addresses and the number of their publishers, from liveliness tokens."""

import logging
import threading
import time
from collections import Counter
from collections.abc import Callable
from contextlib import suppress
from functools import partial
from typing import Self

import zenoh

from nedbus.errors import AddressError, ConnectError
from nedbus.log_event import about
from nedbus_msgs import Address, Selection, address_of_alive_key
from nedbus_msgs.text import counted

from .fleet_tokens import FleetTokens
from .liveliness import LivelinessTokens
from .session import Session

_log = logging.getLogger(__name__)


class Publishers(Counter[Address]):
    """The number of publishers of each address; `complete`: False while some are not known."""

    complete = True


class VehicleDirectory:
    """Addresses and their publishers, from the liveliness tokens that `follow` subscribes to on the first call."""

    def __init__(
        self, follow: Callable[[], LivelinessTokens | FleetTokens], *, prefix: str
    ) -> None:
        self._prefix = prefix
        self._follow = follow
        self._lock = threading.Lock()
        self._closed = threading.Event()
        self._addresses: dict[str, Address] = {}  # by token key
        self._known = Publishers()  # the last list
        self._known.complete = False
        self._tokens: LivelinessTokens | FleetTokens | None = None
        self._logged = False

    @classmethod
    def of_fleet(
        cls, open_session: Callable[[], Session], selection: Selection, *, prefix: str
    ) -> Self:
        """Return a directory of the selected streams; arguments as in FleetTokens."""
        return cls(partial(FleetTokens, open_session, selection, prefix=prefix), prefix=prefix)

    def close(self) -> None:
        """End the subscription."""
        self._closed.set()  # ends a wait that holds the lock
        with self._lock, suppress(zenoh.ZError):  # the session is already closed
            if self._tokens is not None:
                tokens, self._tokens = self._tokens, None
                tokens.undeclare()

    def publishers(self, *, timeout: float) -> Publishers:
        """Return the publishers of each address; wait up to `timeout` seconds while the list is incomplete.

        The first call connects. If another thread is listing for longer, its last list is returned.
        """
        end = time.monotonic() + timeout
        if self._lock.acquire(timeout=min(max(0.0, timeout), threading.TIMEOUT_MAX)):
            try:
                self._known = self._list(timeout, end)
            finally:
                self._lock.release()
        known = self._known
        publishers = Publishers(known)
        publishers.complete = known.complete
        return publishers

    def _list(self, timeout: float, end: float) -> Publishers:
        if self._tokens is None and not self._closed.is_set():
            with suppress(ConnectError):  # try again on the next call
                self._tokens = self._follow()
        while self._tokens is not None:
            for key, alive in self._tokens.poll():
                if not alive:
                    self._addresses.pop(key, None)
                    continue
                try:
                    self._addresses[key] = address_of_alive_key(key, prefix=self._prefix)
                except AddressError:
                    _log.debug("%r: ignored a liveliness token that is not from nedbus", key[:200])
            if not self._tokens.is_listing or time.monotonic() >= end or self._closed.wait(0.002):
                break
        publishers = Publishers(self._addresses.values())
        publishers.complete = self._tokens is not None and self._tokens.complete
        is_listing = self._tokens is None or self._tokens.is_listing
        if is_listing and timeout and not self._logged:
            text = "the router listed only %s within %g s; it may be slow, or forbid listing others"
            _log.warning(
                text, counted(len(publishers), "stream"), timeout, extra=about("incomplete")
            )
        self._logged = is_listing and (self._logged or timeout > 0)
        return publishers
