"""Clients that a router with TLS refuses: Zenoh tells of them in its own log only, which it writes to stdout."""

from __future__ import annotations

import logging
import os
import re
import threading
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.log_event import about

_log = logging.getLogger(__name__)

_LEVEL: Final = "zenoh_link_tls=warn"
_COLOUR: Final = re.compile(r"\x1b\[[0-9;]*m")
_REFUSED: Final = re.compile(r"WARN .*\bzenoh_link_tls::unicast: (.*)\. Hint: ")  # of its listener: all have a hint
_REASONS: Final = {  # by a part of what Zenoh says
    "certificate expired": "its certificate has expired",
    "BadSignature": "its certificate is of another authority",
    "UnknownIssuer": "its certificate is of another authority",
    "sent no certificates": "it shows no certificate",
    "fatal alert": "it does not accept the certificate of this router",
    "corrupt message": "it does not speak TLS",
    "handshake eof": "it breaks off the handshake",
}


def log_refusals() -> None:
    """Log each client that a router of this process refuses from now on; Zenoh does not say from where it connects.

    It takes the place of stdout, to which all else passes on: what RUST_LOG asks of Zenoh.
    """
    stdout = os.dup(1)
    read, write = os.pipe()
    os.dup2(write, 1)
    os.close(write)
    zenoh.init_log_from_env_or(_LEVEL)
    threading.Thread(target=_follow, args=(read, stdout), name="nedbus-refusals", daemon=True).start()


def _follow(read: int, stdout: int) -> None:
    with open(read, "rb") as lines:
        for line in lines:
            found = _REFUSED.search(_COLOUR.sub("", line.decode(errors="replace")))
            if found is None:
                with suppress(OSError):  # its reader is gone
                    os.write(stdout, line)
                continue
            said = found[1]
            reason = next((text for part, text in _REASONS.items() if part in said), said)
            _log.warning("a client is refused: %s", reason, extra=about("client-refused", reason=reason))
