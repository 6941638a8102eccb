"""Log events of an embedded router: links to other routers that come up or break, and refused clients.

Zenoh does not report links, and writes refusals only to its own log, on stdout.
"""

from __future__ import annotations

import logging
import os
import re
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.log_event import about

from .session import Session
from .tls import Tls

_log = logging.getLogger(__name__)

UPLINK_POLL: Final = 1.0
"""Seconds between checks of the links."""

_LINK_TIMEOUT: Final = 3.0  # s until a link that does not come up is logged
_COLOUR: Final = re.compile(r"\x1b\[[0-9;]*m")
_REFUSED: Final = re.compile(r"WARN .*\bzenoh_link_tls::unicast: (.*)\. Hint: ")  # of a listener; all have a hint
_REASONS: Final = {  # by substring of Zenoh's text
    "certificate expired": "its certificate has expired",
    "BadSignature": "its certificate is signed by another authority",
    "UnknownIssuer": "its certificate is signed by another authority",
    "sent no certificates": "it sent no certificate",
    "fatal alert": "it does not accept the certificate of this router",
    "corrupt message": "it does not speak TLS",
    "handshake eof": "it aborted the handshake",
}


class Uplinks:
    """Log when the links to other routers come up, fail to come up, or are lost; call `check` every second."""

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
        self._due = now() + _LINK_TIMEOUT
        self._is_up: dict[str, bool | None] = dict.fromkeys(endpoints)  # last logged state; None before the first

    def check(self) -> None:
        """Compare the expected links with the open ones."""
        # The destination of an open link is the dialled endpoint, but its host name may have been resolved.
        dialled = {_protocol_and_port(link.dst) for link in self._session.info.links()}
        for endpoint, was_up in self._is_up.items():
            is_up = _protocol_and_port(endpoint) in dialled
            if is_up == was_up or (not is_up and was_up is None and self._now() < self._due):
                continue
            self._is_up[endpoint] = is_up
            if is_up:
                _log.info("joined %s", endpoint, extra=about("link-back"))
            elif was_up:
                _log.warning("the link to %s is lost: still trying", endpoint, extra=about("link-broken"))
            else:
                reason = self._explain(endpoint)
                _log.warning("no link to %s%s: still trying", endpoint, reason, extra=about("link-broken"))

    def _explain(self, endpoint: str) -> str:
        if not endpoint.startswith(("tls/", "quic/")):
            return ""
        if self._tls is None:
            return " (no certificates are given for it: set tls_ca, tls_certificate and tls_key)"
        explanation = self._tls.explain()
        return f" ({explanation})" if explanation else ""


def _protocol_and_port(locator: str) -> tuple[str, str]:
    address = locator.partition("?")[0].partition("#")[0]
    return address.partition("/")[0], address.rpartition(":")[2]


def log_refusals() -> None:
    """Log each client that a router of this process refuses from now on; its address is not known.

    Redirects stdout through a pipe, reads refusals from Zenoh's log, and passes on all other lines.
    """
    stdout = os.dup(1)
    read, write = os.pipe()
    os.dup2(write, 1)
    os.close(write)
    zenoh.init_log_from_env_or("zenoh_link_tls=warn")
    threading.Thread(target=_filter, args=(read, stdout), name="nedbus-refusals", daemon=True).start()


def _filter(read: int, stdout: int) -> None:
    with open(read, "rb") as lines:
        for line in lines:
            found = _REFUSED.search(_COLOUR.sub("", line.decode(errors="replace")))
            if found is not None:
                reason = next((text for part, text in _REASONS.items() if part in found[1]), found[1])
                _log.warning("a client is refused: %s", reason, extra=about("client-refused", reason=reason))
                continue
            with suppress(OSError):  # the reader of stdout is gone
                os.write(stdout, line)
