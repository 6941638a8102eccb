"""The links of a router to the routers that it joins: whether they are up, as Zenoh itself logs nothing of them."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from typing import Final

from nedbus.log_event import about

from .session import Session
from .tls import Tls

_log = logging.getLogger(__name__)

UPLINK_POLL: Final = 1.0
"""Seconds between two checks."""

_PATIENCE: Final = 3.0  # s until a link that is not up is worth a warning


class Uplinks:
    """Log when the link to each of these routers comes up, does not come up, or is lost; call `check` every second."""

    def __init__(
        self,
        session: Session,
        endpoints: Sequence[str],
        *,
        tls: Tls | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._session = session
        self._tls = tls
        self._now = now
        self._down_since: dict[str, float] = dict.fromkeys(endpoints, now())
        self._up: set[str] = set()
        self._warned: set[str] = set()

    def check(self) -> None:
        """Compare what should be linked with what is."""
        # The other side of a link that this router opened is the endpoint that it dialled, under another host name.
        dialled = {_protocol_and_port(link.dst) for link in self._session.info.links()}
        for endpoint, since in list(self._down_since.items()):
            if _protocol_and_port(endpoint) in dialled:
                if endpoint not in self._up:
                    self._up.add(endpoint)
                    self._warned.discard(endpoint)
                    _log.info("joined %s", endpoint, extra=about("link-back"))
            elif endpoint in self._up:
                self._up.remove(endpoint)
                self._down_since[endpoint] = self._now()
                self._warned.add(endpoint)
                _log.warning("the link to %s is lost: still trying", endpoint, extra=about("link-broken"))
            elif endpoint not in self._warned and self._now() - since >= _PATIENCE:
                self._warned.add(endpoint)
                _log.warning(
                    "no link to %s%s: still trying", endpoint, self._reason(endpoint), extra=about("link-broken")
                )

    def _reason(self, endpoint: str) -> str:
        if not endpoint.startswith(("tls/", "quic/")):
            return ""
        if self._tls is None:
            return ", and no certificate was given for it: set tls_ca, and tls_certificate and tls_key"
        explanation = self._tls.explain()
        return f" ({explanation})" if explanation else ""


def _protocol_and_port(locator: str) -> tuple[str, str]:
    address = locator.partition("?")[0].partition("#")[0]
    return address.partition("/")[0], address.rpartition(":")[2]
