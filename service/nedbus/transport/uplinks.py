"""Log of the links from a service or a router to other routers, which Zenoh lists but does not report."""

import logging
import socket
import time
from collections.abc import Callable, Sequence
from typing import Final

from nedbus.endpoints import split_endpoint
from nedbus.log_event import about

from .session import Session
from .tls import Tls

_log = logging.getLogger(__name__)

_LINK_TIMEOUT: Final = 3.0  # s before a link that does not come up is logged


class Uplinks:
    """Log when uplinks (links to routers) come up, fail to come up, break and recover; call `check` every second.

    A router keeps one link to each endpoint; a client, whose session is open, keeps one link to any of them.
    """

    def __init__(
        self,
        session: Session,
        endpoints: Sequence[str],
        *,
        is_client: bool = False,
        tls: Tls | None = None,
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self._session = session
        self._tls = tls
        self._now = now
        self._is_client = is_client
        names = [" or ".join(endpoints)] if is_client else endpoints
        # Last logged state of each link, None at first, and the time of its change [s].
        self._states: dict[str, tuple[bool | None, float]] = dict.fromkeys(
            names, (is_client or None, now())
        )

    def check(self) -> None:
        """Compare the configured links with the open ones, and log changes."""
        # The destination of an open link is the dialled endpoint, but its host name may have been resolved.
        dialled = [link.dst for link in self._session.info.links()]
        for name, (was_up, since) in self._states.items():
            is_up = bool(dialled) if self._is_client else self._is_linked(name, dialled)
            lasted = self._now() - since
            if is_up == was_up or (not is_up and was_up is None and lasted < _LINK_TIMEOUT):
                continue
            self._states[name] = is_up, since if was_up is None else self._now()
            if is_up:
                text = (
                    f"joined {name}"
                    if was_up is None
                    else f"the link to {name} is up after {lasted:.0f} s"
                )
                _log.info("%s", text, extra=about("link_up"))
            elif was_up:
                _log.warning("the link to %s is lost: reconnecting", name, extra=about("link_lost"))
            else:
                _log.warning(
                    "no link to %s%s: still trying",
                    name,
                    self._explain(name),
                    extra=about("link_lost"),
                )

    def _is_linked(self, endpoint: str, dialled: Sequence[str]) -> bool:
        """Return whether a link to an endpoint is open; compare hosts only if several endpoints share its port."""
        protocol, host, port = split_endpoint(endpoint) or (endpoint, "", 0)
        hosts = {
            each[1]
            for each in map(split_endpoint, dialled)
            if each and each[::2] == (protocol, port)
        }
        if (
            not hosts
            or sum(
                each[::2] == (protocol, port) for each in map(split_endpoint, self._states) if each
            )
            == 1
        ):
            return bool(hosts) or endpoint in dialled  # a Unix socket has no host
        try:
            return not hosts.isdisjoint(
                [host, *(str(each[4][0]) for each in socket.getaddrinfo(host, None))]
            )
        except OSError:
            return True  # a failed name resolution does not affect an open link

    def _explain(self, endpoint: str) -> str:
        if not endpoint.startswith(("tls/", "quic/")):
            return ""
        missing = "set tls_ca, tls_certificate and tls_key, which are missing"
        explanation = self._tls.explain() if self._tls else missing
        return f" ({explanation})" if explanation else ""
