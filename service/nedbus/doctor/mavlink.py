"""Check of a MAVLink link: packets, messages, positions and the ULog stream; needs the extra `mavlink`."""

import errno
import math
import struct
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus.errors import SourceError
from nedbus.mavlink import AUTOPILOT, HIGH_LATENCY, NO_HEARTBEAT, Senders
from nedbus.sources import DuplicateIds, Link, expected_header, open_link, parse_link
from nedbus.timings import TIMINGS

from .finding import FIRST_PARTNER, Finding, limit_findings, list_names

_READ_TIMEOUT: Final = 0.25  # s
_MAX_SENDERS: Final = 5
_POSITION: Final = "LOCAL_POSITION_NED"
_BAUD: Final = 57600
_SYSTEM: Final = 245  # our system id, as in the MAVLink source
_BACKEND: Final = "SDLOG_BACKEND"
_TO_MAVLINK: Final = 2  # bit 1 of SDLOG_BACKEND


@dataclass(slots=True)
class _Traffic:
    """What arrived on a link.

    `packets`: by sender. `systems`: the messages of autopilots by system id. `ignored`: why the messages of a sender
    are ignored, by system and component id. `duplicates`: two addresses with one system id, by system id.
    """

    packets: Counter[str] = field(default_factory=Counter)
    systems: dict[int, list[Any]] = field(default_factory=dict)
    ignored: dict[tuple[int, int], str] = field(default_factory=dict)
    duplicates: dict[int, str] = field(default_factory=dict)


def check_mavlink(link: str) -> Iterator[Finding]:
    """Listen to a link for 3 s and yield the findings; raise ConfigError for an invalid link."""
    try:
        with closing(open_link(link, baud=_BAUD)) as opened:
            traffic = _listen(opened)
    except SourceError as exc:
        is_taken = isinstance(exc.__cause__, OSError) and exc.__cause__.errno == errno.EADDRINUSE
        advice = "check the address and port, or the device and its permissions"
        if is_taken:
            advice = "fine if 'nedbus serve' is the other program; 'ss -ulpn' shows it"
        yield Finding("mavlink", link, "warning" if is_taken else "wrong", exc.reason, advice)
        return
    packets, systems = traffic.packets, traffic.systems
    if not packets:
        advice = "check firewalls, and that the vehicle sends to this host and port ('mavlink status' in PX4's shell)"
        if parse_link(link).kind == "udpout":
            advice = f"{advice}; {FIRST_PARTNER}"
        yield Finding("mavlink", link, "wrong", f"no packet within {TIMINGS.listen:g} s", advice)
    elif not systems and not traffic.ignored:
        seen = f"no MAVLink among the packets from {list_names(sorted(packets))} (total: {packets.total()})"
        advice = "check the baud rate, or use a port that no other program sends to"
        yield Finding("mavlink", link, "wrong", seen, advice)
    yield from limit_findings(_check_ignored(link, traffic))
    yield from limit_findings(
        Finding("mavlink", f"{link} system {system} component {AUTOPILOT}", "wrong", fault)
        for system, fault in sorted(traffic.duplicates.items())
    )
    ordered = sorted(systems.items())
    yield from limit_findings(_check_system(link, number, messages) for number, messages in ordered)
    yield from limit_findings(
        _check_log(link, number, each) for number, each in ordered if any(map(_is_px4, each))
    )


def _check_ignored(link: str, traffic: _Traffic) -> Iterator[Finding]:
    """Yield the senders that are ignored; cameras and ground stations are normal, but not alone."""
    for (system, component), reason in sorted(traffic.ignored.items()):
        subject, seen = f"{link} system {system} component {component}", f"ignored: {reason}"
        if not (system and component) or not traffic.systems:
            yield Finding("mavlink", subject, "wrong", seen)
        elif system in traffic.systems and component == AUTOPILOT:
            advice = (
                "another program uses the ids of the autopilot; give it a component id of its own"
            )
            yield Finding("mavlink", subject, "warning", f"some HEARTBEATs are {seen}", advice)
        elif component == AUTOPILOT:
            advice = f"only autopilots should use component id {AUTOPILOT}; give this program another one"
            yield Finding("mavlink", subject, "ok", seen, advice)


def _listen(link: Link) -> _Traffic:
    """Collect what arrives; request SDLOG_BACKEND and TIMESYNC from each PX4."""
    traffic = _Traffic()
    senders = Senders()
    addresses = DuplicateIds()
    end = time.monotonic() + TIMINGS.listen
    next_heartbeat = 0.0
    parser = None
    sender = dialect.MAVLink(None, _SYSTEM, dialect.MAV_COMP_ID_ONBOARD_COMPUTER)
    heartbeat = dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_ONBOARD_CONTROLLER,
        dialect.MAV_AUTOPILOT_INVALID,
        0,
        0,
        dialect.MAV_STATE_ACTIVE,
        3,
    )
    while (now := time.monotonic()) < end:
        # some peers send only to addresses that they received from
        if link.peer is not None and now >= next_heartbeat:
            next_heartbeat = now + 1.0
            link.send(heartbeat.pack(sender), link.peer)
        for data, peer, _ in link.read(_READ_TIMEOUT):
            name = ":".join(map(str, peer[:2])) if isinstance(peer, tuple) else str(peer)
            if name in traffic.packets or len(traffic.packets) < _MAX_SENDERS:
                traffic.packets[name] += 1
            if parser is None or not link.stream:
                parser = dialect.MAVLink(None)
                parser.robust_parsing = True
            for message in parser.parse_buffer(data) or []:
                # these types have no header
                if message.get_type().startswith(("BAD_DATA", "UNKNOWN")):
                    continue
                ids = message.get_srcSystem(), message.get_srcComponent()
                if reason := senders.ignore_reason(message, *ids):
                    traffic.ignored[ids] = reason
                    continue
                if traffic.ignored.get(ids) == NO_HEARTBEAT:
                    del traffic.ignored[ids]  # it has identified itself since
                if duplicate := addresses.add(ids[0], peer, now):
                    traffic.duplicates[ids[0]] = duplicate
                traffic.systems.setdefault(ids[0], []).append(message)
                if _is_px4(message):
                    request = dialect.MAVLink_param_request_read_message(
                        *ids, _BACKEND.encode(), -1
                    )
                    link.send(request.pack(sender), peer)
                    link.send(
                        dialect.MAVLink_timesync_message(0, time.monotonic_ns()).pack(sender), peer
                    )
                elif message.get_type() == "TIMESYNC" and message.tc1:
                    message.round_trip = (time.monotonic_ns() - message.ts1) / 1e9
    return traffic


def _is_px4(message: Any) -> bool:
    return bool(
        message.get_type() == "HEARTBEAT" and message.autopilot == dialect.MAV_AUTOPILOT_PX4
    )


def _check_system(link: str, number: int, messages: Sequence[Any]) -> Finding:
    name = f"{link} system {number}"
    counts = Counter(message.get_type() for message in messages)
    types = list_names(type_ for type_, _ in counts.most_common())
    if counts[_POSITION]:
        seen = f"{_POSITION} at {counts[_POSITION] / TIMINGS.listen:.0f} Hz; messages: {types}"
        advice = (
            ""
            if counts["ODOMETRY"]
            else "evh and evv come from ODOMETRY, which 'nedbus serve' requests"
        )
        return Finding("mavlink", name, "ok", seen, advice)
    if set(counts) == {HIGH_LATENCY}:
        advice = "'nedbus serve' publishes global position, status and battery, and sends nothing to the vehicle"
        return Finding("mavlink", name, "ok", f"a satellite link: {HIGH_LATENCY} only", advice)
    seen = "HEARTBEAT only" if set(counts) == {"HEARTBEAT"} else f"no {_POSITION}, only {types}"
    advice = (
        f"'nedbus serve --source mavlink:{link}' requests it; if none arrives, PX4 may have no estimate, or may need"
        f" 'mavlink stream -s {_POSITION} -r 30' in its shell"
    )
    return Finding("mavlink", name, "warning", seen, advice)


def _check_log(link: str, number: int, messages: Sequence[Any]) -> Finding:
    """Check whether PX4 can send its ULog stream on this link, without requesting it."""
    name = f"{link} system {number}"
    data = [message for message in messages if message.get_type().startswith("LOGGING_DATA")]
    if clients := {
        f"system {each.target_system} component {each.target_component}" for each in data
    }:
        seen = f"sends its ULog stream to {list_names(sorted(clients))}"
        advice = "PX4 streams to one client: it refuses 'nedbus serve' while another one receives, unless log=take"
        return Finding(
            "mavlink", name, "ok" if f"system {_SYSTEM} " in seen else "warning", seen, advice
        )
    values = [each.param_value for each in messages if getattr(each, "param_id", "") == _BACKEND]
    backend = _TO_MAVLINK
    if values:  # PX4 sends integers as the bytes of a float
        (backend,) = struct.unpack("<i", struct.pack("<f", values[-1]))
    if not backend & _TO_MAVLINK:
        seen = f"{_BACKEND} is {backend}: PX4 refuses to send its ULog stream"
        return Finding(
            "mavlink",
            name,
            "warning",
            seen,
            f"set {_BACKEND} to 3 (file and MAVLink), and restart PX4",
        )
    size = sum(len(message.get_msgbuf()) for message in messages)
    seen = f"PX4 found; the link carries {size / TIMINGS.listen / 1000:.0f} kB/s"
    options = "log=1"
    round_trips = [
        trip for each in messages if 0 <= (trip := getattr(each, "round_trip", -1)) < TIMINGS.listen
    ]
    if round_trips:
        trip = min(round_trips)
        few, most = expected_header(trip, topics=16), expected_header(trip)
        seen += f"; round trip {1e3 * trip:.0f} ms: the header of the ULog stream blocks PX4's logger for {few:.0f} s"
        seen += f" with logger_topics.txt, {most:.0f} s with the default topics"
        if most > TIMINGS.log_header:
            options += f"&header={math.ceil(1.2 * most)}"
    advice = f"for all fields of all topics, run 'nedbus serve --source \"mavlink:{link}?{options}\"' (docs/live.md)"
    return Finding("mavlink", name, "ok", seen, advice)
