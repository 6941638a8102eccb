"""Probe for write permission: Zenoh drops forbidden messages without an error at the sender.

One session subscribes to a key below each vehicle that is not a topic; another session publishes on it. If no message
arrives although the router has announced the subscriber to the publisher, the router denies the write.
"""

import secrets
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from typing import Final, Literal, cast

import zenoh

from nedbus.errors import ConnectError, NedbusError
from nedbus.timings import TIMINGS
from nedbus_msgs import ANY

from .session import Session, open_client, translate_zenoh_errors
from .tls import Tls

WriteVerdict = Literal["allowed", "denied", "unknown"]
"""Whether a client may publish a vehicle; "unknown" if a probe could not tell."""

CONFIRMED: Final = 3
"""Consecutive denials that count as a refusal; a slow or restarting router causes fewer."""

_POLL: Final = 0.02  # s
_RETRY: Final = 0.2  # s before a probe is sent again, because declarations may still be in flight
_SPARE: Final = 16  # slots in the channel beyond one probe per vehicle


def probe_writes(
    reader: Session,
    writer: Session,
    vehicles: Collection[str],
    *,
    prefix: str,
    timeout: float = 1.0,
) -> dict[str, WriteVerdict]:
    """Return for each vehicle whether `writer` may publish it; "unknown" if `reader` is not allowed to subscribe.

    `timeout`: time for the router to announce the subscriber, and again for an allowed message to arrive [s].
    """
    # the `**` of readers does not match a chunk that starts with @
    probe = f"@doctor/{secrets.token_hex(8)}"
    keys = {f"{prefix}/{vehicle}/{probe}": vehicle for vehicle in vehicles}
    missing = dict(keys)
    capacity = len(keys) + _SPARE

    def receive() -> bool:
        for sample in islice(iter(subscriber.handler.try_recv, None), capacity):
            missing.pop(str(sample.key_expr), None)
        return not missing

    with translate_zenoh_errors():
        subscriber = reader.declare_subscriber(
            f"{prefix}/{ANY}/{probe}", zenoh.handlers.RingChannel(capacity)
        )
        # Deleted rather than undeclared, because `undeclare` waits without releasing the GIL.
        publisher = writer.declare_publisher(next(iter(keys)))
        # Zenoh's stubs declare a bool, but the status is an object, which is always true.
        matched = _wait(
            lambda: cast("zenoh.MatchingStatus", publisher.matching_status).matching, timeout
        )
        for _ in range(round(timeout / _RETRY)):
            for key in missing:
                # Above the priority of data, whose queue may be full and would drop the probe.
                writer.put(
                    key,
                    b"probe",
                    congestion_control=zenoh.CongestionControl.DROP,
                    priority=zenoh.Priority.INTERACTIVE_HIGH,
                    express=True,
                )
            if _wait(receive, _RETRY):
                break
    refused: WriteVerdict = "unknown"
    if matched:
        refused = "denied"
    return {vehicle: refused if key in missing else "allowed" for key, vehicle in keys.items()}


def probe_at_router(
    session: Session,
    endpoints: Sequence[str],
    vehicles: Collection[str],
    *,
    tls: Tls,
    prefix: str,
    stop: threading.Event | None = None,
) -> Mapping[str, WriteVerdict]:
    """Probe with a second session to one of these endpoints; no verdicts if the two sessions share no router."""
    routers = routers_of(session)
    for endpoint in endpoints if vehicles else ():
        try:
            reader = open_client([endpoint], timeout=TIMINGS.probe_open, tls=tls, stop=stop)
        except ConnectError:
            continue
        with reader:
            shared = routers_of(reader)
            if not shared or not shared <= routers:
                continue
            verdicts = probe_writes(reader, session, vehicles, prefix=prefix, timeout=TIMINGS.probe)
            # A missing probe message means a denial only if no link was lost during the check.
            is_unchanged = routers_of(reader) == shared and routers_of(session) == routers
            return verdicts if is_unchanged else {}
    return {}


def is_refused(probe: Callable[[], WriteVerdict | None]) -> bool | None:
    """Return True after CONFIRMED denials by `probe`, False after an acceptance, None if it cannot be told."""
    for _ in range(CONFIRMED):
        verdict = probe()
        if verdict == "allowed":
            return False
        if verdict != "denied":
            return None
    return True


def secure_endpoints(endpoints: Sequence[str], tls: Tls | None) -> list[str]:
    """Return the endpoints at which access rules apply to a certificate; none without a client certificate."""
    if tls is None or tls.certificate is None:
        return []
    return [endpoint for endpoint in endpoints if endpoint.startswith(("tls/", "quic/"))]


def routers_of(session: Session) -> frozenset[str]:
    """Return the Zenoh ids of the routers to which a session is connected."""
    with suppress(NedbusError), translate_zenoh_errors():
        return frozenset(str(zid) for zid in session.info.routers_zid())
    return frozenset()


def _wait(condition: Callable[[], bool], seconds: float) -> bool:
    end = time.monotonic() + seconds
    while not (met := condition()) and time.monotonic() < end:
        time.sleep(_POLL)
    return met
