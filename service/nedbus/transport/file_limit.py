"""How many files a router may have open: each session is one, and a usual soft limit, 1024, ends before they do.

At the limit a router accepts no more connections, and neither Zenoh nor a log says so.
"""

from __future__ import annotations

import logging
import resource
from contextlib import suppress
from typing import Final

from nedbus.log_event import about

_OTHERS: Final = 100  # files of a process that are no sessions: a router has 21, a service its sources and HTTP clients

_log = logging.getLogger(__name__)


def allow_sessions(sessions: int, *, pending: int) -> None:
    """Raise the soft limit of this process for a router with so many sessions and handshakes, as far as it may.

    Logs a warning when the hard limit leaves no room for all sessions.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    wanted = sessions + pending + _OTHERS
    if hard != resource.RLIM_INFINITY:
        wanted = min(wanted, hard)
    if soft != resource.RLIM_INFINITY and soft < wanted:
        with suppress(OSError, ValueError, OverflowError):  # a kernel may allow less than the hard limit says
            resource.setrlimit(resource.RLIMIT_NOFILE, (wanted, hard))
            soft = wanted
    if soft != resource.RLIM_INFINITY and soft < sessions + _OTHERS:
        _log.warning(
            "only %s open files are allowed: room for about %s sessions, and not for the %s of max_sessions:"
            " raise the limit (ulimit -n, LimitNOFILE=)",
            soft,
            max(0, soft - _OTHERS),
            sessions,
            extra=about("router"),
        )
