"""Log of the links from a service or a router to other routers, which Zenoh lists but does not report."""

import logging
import socket
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from nedbus.endpoints import split_endpoint
from nedbus.log_event import about

from .session import Session
from .tls import Tls

_log = logging.getLogger(__name__)

_LINK_TIMEOUT: Final = 3.0  # s before a link that does not come up is logged


@dataclass(slots=True)
class _Uplink:
    """A configured link; `is_up`: its last logged state, None before the first; `since`: the time of the change [s]."""

    name: str
    since: float
    is_up: bool | None = None


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
        self._uplinks = [_Uplink(endpoint, now()) for endpoint in dict.fromkeys(endpoints)]
        if is_client:
            self._uplinks = [_Uplink(" or ".join(endpoints), now(), is_up=True)]

    def check(self) -> None:
        """Compare the configured links with the open ones, and log changes."""
        # The destination of an open link is the dialled endpoint, but its host name may have been resolved.
        dialled = [link.dst for link in self._session.info.links()]
        for uplink in self._uplinks:
            if self._is_client:
                is_up = bool(dialled)
            else:
                is_up = self._is_linked(uplink.name, dialled)
            if is_up != uplink.is_up:
                self._change(uplink, is_up)

    def _change(self, uplink: _Uplink, is_up: bool) -> None:
        """Log a change, except that a new link is not up yet."""
        name = uplink.name
        was_up = uplink.is_up
        lasted = self._now() - uplink.since
        if was_up is None:
            if not is_up and lasted < _LINK_TIMEOUT:
                return
        else:
            uplink.since += lasted
        uplink.is_up = is_up
        if is_up and was_up is None:
            _log.info("joined %s", name, extra=about("link_up"))
        elif is_up:
            _log.info("the link to %s is up after %.0f s", name, lasted, extra=about("link_up"))
        elif was_up:
            _log.warning("the link to %s is lost: reconnecting", name, extra=about("link_lost"))
        else:
            reason = self._explain(name)
            _log.warning("no link to %s%s: still trying", name, reason, extra=about("link_lost"))

    def _is_linked(self, endpoint: str, dialled: Sequence[str]) -> bool:
        """Return whether a link to an endpoint is open; compare hosts only if several endpoints share its port."""
        if endpoint in dialled:
            return True
        address = split_endpoint(endpoint)
        if address is None:
            return False
        protocol, host, port = address
        linked_hosts = _hosts_on(protocol, port, dialled)
        if not linked_hosts:
            return False
        configured_hosts = _hosts_on(protocol, port, [uplink.name for uplink in self._uplinks])
        if len(configured_hosts) == 1:
            return True
        try:
            resolved = socket.getaddrinfo(host, None)
        except OSError:
            return True  # a failed name resolution does not affect an open link
        hosts = {host}
        hosts.update(str(info[4][0]) for info in resolved)
        return not hosts.isdisjoint(linked_hosts)

    def _explain(self, endpoint: str) -> str:
        if not endpoint.startswith(("tls/", "quic/")):
            return ""
        missing = "set tls_ca, tls_certificate and tls_key, which are missing"
        if self._tls:
            explanation = self._tls.explain()
        else:
            explanation = missing
        return f" ({explanation})" if explanation else ""


def _hosts_on(protocol: str, port: int, endpoints: Iterable[str]) -> list[str]:
    """Return the hosts of the endpoints with this protocol and port."""
    hosts: list[str] = []
    for address in map(split_endpoint, endpoints):
        if address is not None and (address[0], address[2]) == (protocol, port):
            hosts.append(address[1])
    return hosts
