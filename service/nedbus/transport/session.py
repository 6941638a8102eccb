"""Zenoh client sessions, and translation of Zenoh errors."""

import json
import math
import os
import random
import re
import threading
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cache, partial
from itertools import chain, repeat
from typing import Final

import zenoh

from nedbus import limits
from nedbus.endpoints import check_endpoints, resolution_error, split_endpoint
from nedbus.errors import ClosedError, ConfigError, ConnectError, ForkError, NedbusError
from nedbus.timings import TIMINGS

from .tls import Tls, read_certificate

Session = zenoh.Session
RawSample = zenoh.Sample

# Shared memory limits a router to 351 local sessions, without any gain for messages of 244 bytes.
# Gossip and multicast would let peers find each other and bypass the router.
# Queues are longer than Zenoh's default: two batches are too few for the bursts of a fleet.
# Sessions add no timestamps: publishers stamp each message, so a router never replaces a timestamp.
COMMON_SETTINGS: Final = {
    "scouting/multicast/enabled": False,
    "scouting/gossip/enabled": False,
    "timestamping/enabled": False,
    "transport/shared_memory/enabled": False,
    "transport/link/tx/queue/size/data_high": 16,
    "transport/link/tx/queue/size/data": 16,
}
_CLOSED: Final = re.compile(r"session closed|undeclared|ringbuffer has been deleted", re.IGNORECASE)
_PAUSES: Final = (0.05, 0.1, 0.2, 0.4, 0.8)  # backoff between the first attempts to connect [s]

_forks: Final[list[None]] = []  # not empty in a process that was forked from one with sessions


def is_forked() -> bool:
    """Return whether this process was forked from one with Zenoh sessions, in which case Zenoh does not work."""
    return bool(_forks)


def require_unforked() -> None:
    """Raise ForkError in a process that was forked from one with Zenoh sessions."""
    if _forks:
        raise ForkError


@cache
def _watch_forks() -> None:
    os.register_at_fork(after_in_child=partial(_forks.append, None))


def open_session(config: zenoh.Config) -> Session:
    """Open a session; raise ForkError in a process forked from one with sessions, where Zenoh would hang."""
    require_unforked()
    _watch_forks()
    return zenoh.open(config)


def open_client(
    endpoints: Sequence[str],
    *,
    timeout: float | None,
    tls: Tls | None = None,
    stop: threading.Event | None = None,
) -> Session:
    """Open a session as a client of the first router that answers; Ctrl-C or setting `stop` cancels the wait.

    The session reconnects automatically when its link breaks.

    Raises ConnectError if no endpoint answers within `timeout` seconds (None: wait forever), ConfigError for a
    malformed endpoint or an unreadable TLS file.
    """
    check_endpoints(endpoints, where="connect")
    settings: dict[str, object] = {
        **COMMON_SETTINGS,
        "mode": "client",
        "transport/link/tx/lease": round(1000 * TIMINGS.lease),
        "connect/endpoints": list(endpoints),
        "connect/timeout_ms": 0,
        "connect/retry": random_backoff(),
        "listen/endpoints": [],
        # Longer than any wait for tokens: at this timeout, Zenoh reports an unfinished list as complete.
        "routing/interests/timeout": 120_000,
        # Including key and headers; larger messages from peers are rejected.
        "transport/link/rx/max_message_size": limits.REPLY_BYTES + 2**12,
        # 16 buffers, which are used again. A message that is being read keeps its buffer: with Zenoh's single one, each
        # message would need a new one of 64 kB, and a paced reader would take 6 % more time.
        "transport/link/rx/buffer_size": 2**20,
    }
    if tls is not None:
        settings["transport/link/tls"] = tls.zenoh_settings()
    if timeout is None:
        timeout = math.inf
    end = time.monotonic() + timeout
    stop = stop or threading.Event()
    reason = ""
    for pause in chain(_PAUSES, repeat(1.0)):
        # Short, because an endpoint may accept and then send nothing; at least 1 s, because reconnects over a slow link
        # use the same timeout.
        open_timeout = min(3.0, max(1.0, end - time.monotonic()))
        settings["transport/unicast/open_timeout"] = round(1000 * open_timeout)
        try:
            return open_session(insert_settings(zenoh.Config(), settings, where="connect"))
        except zenoh.ZError as exc:
            reason = error_reason(exc)
            left = end - time.monotonic()
            if left <= 0 or stop.wait(min(left, pause)):
                break
    # For most failures Zenoh reports only "Unable to connect".
    cause = resolution_error(endpoints)
    if not cause and tls is not None:
        cause = tls.explain()
    if (
        not cause
        and (tls is None or tls.certificate is None)
        and endpoints[0].startswith(("tls/", "quic/"))
    ):
        cause = (
            "no certificate given: routers with mutual TLS require one (tls_certificate, tls_key)"
        )
    if cause or stop.is_set():
        secure = []
    else:
        secure = _tls_ports(endpoints)
    advice = f"{' and '.join(secure)} speaks TLS: use tls/ instead of tcp/" if secure else ""
    reason = cause or ("" if "Unable to connect" in reason else reason)
    raise ConnectError(endpoints, timeout, reason, advice=advice)


def _tls_ports(endpoints: Sequence[str]) -> list[str]:
    """Return the tcp/ endpoints at which a server speaks TLS; Zenoh reports only that it cannot connect."""
    parts = {endpoint: split_endpoint(endpoint) for endpoint in endpoints}
    return [
        endpoint
        for endpoint, part in parts.items()
        if part is not None
        and part[0] == "tcp"
        and read_certificate(part[1], part[2], TIMINGS.tls_hint)
    ]


def random_backoff() -> dict[str, float]:
    """Return Zenoh's `connect/retry` section with a random backoff, so a fleet does not reconnect simultaneously."""
    first, longest = random.uniform(100, 300), random.uniform(1000, 3000)  # noqa: S311 - not a secret
    return {
        "period_init_ms": round(first),
        "period_max_ms": round(longest),
        "period_increase_factor": 1.5,
    }


def insert_settings(
    config: zenoh.Config, settings: Mapping[str, object], *, where: str
) -> zenoh.Config:
    """Add settings to a Zenoh configuration and return it; raise ConfigError for a value that Zenoh rejects."""
    for key, value in settings.items():
        try:
            config.insert_json5(key, json.dumps(value))
        except zenoh.ZError as exc:
            raise ConfigError(where, f"Zenoh rejects {value!r} as {key}") from exc
    return config


def entity_name(entity: zenoh.EntityGlobalId) -> str:
    """Return the id of a publisher or reader as text: session id and entity id, separated by a colon."""
    return f"{entity.zid}:{entity.eid}"


@contextmanager
def translate_zenoh_errors() -> Iterator[None]:
    """Translate Zenoh errors: to ClosedError if the session is closed, else to NedbusError with Zenoh's reason."""
    try:
        yield
    except zenoh.ZError as exc:
        raise translate_error(exc) from exc


def translate_error(error: zenoh.ZError) -> NedbusError:
    """Return the error that `translate_zenoh_errors` raises for a Zenoh error.

    The error text decides, because `Session.is_closed` waits for a Zenoh lock without releasing the GIL.
    """
    if _CLOSED.search(str(error)):
        return ClosedError()
    return NedbusError(f"Zenoh reports: {error_reason(error)}")


def error_reason(error: zenoh.ZError) -> str:
    """Return the reason reported by the operating system, else the whole text without source paths."""
    text = re.sub(r" at /\S+", "", str(error)).strip()
    match = re.search(r": ([A-Z][a-z][^:\[\]]*) \(os error", text)
    if match:
        return match[1].lower()
    return text
