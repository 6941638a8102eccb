"""What comes on a MAVLink link: nothing, something else, heartbeats only, or positions. Needs the extra `mavlink`."""

from __future__ import annotations

import errno
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from dataclasses import dataclass, field
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus.errors import SourceError
from nedbus.sources import Link, open_link

from .finding import Finding, list_names
from .port_owner import udp_port_owner

_TICK: Final = 0.25  # s
_MAX_SYSTEMS: Final = 20
_MAX_SENDERS: Final = 5
_POSITION: Final = "LOCAL_POSITION_NED"
_BAUD: Final = 57600
_SYSTEM: Final = 245  # ours, as in the source


@dataclass(slots=True)
class Heard:
    """What came: bytes and datagrams, from whom, how many bytes of it are not MAVLink, and the messages by system."""

    packets: int = 0
    junk: int = 0
    senders: set[str] = field(default_factory=set)
    systems: dict[int, Counter[str]] = field(default_factory=dict)


def check_mavlink(link: str, *, listen: float) -> list[Finding]:
    """Listen to a link for so many seconds and return what is found; raise ConfigError for an invalid one."""
    try:
        with closing(open_link(link, baud=_BAUD)) as opened:
            try:
                heard = _listen(opened, listen)
            except OSError as exc:
                reason = (exc.strerror or str(exc)).lower()
                return [Finding("mavlink", link, "wrong", f"the link broke: {reason}", "is the other side still on?")]
    except SourceError as exc:
        return [_explain(link, exc)]
    return list(_judge(link, heard, listen))


def _listen(link: Link, seconds: float) -> Heard:
    heard, end, next_heartbeat = Heard(), time.monotonic() + seconds, 0.0
    parser = _parser()
    sender = dialect.MAVLink(None, _SYSTEM, dialect.MAV_COMP_ID_ONBOARD_COMPUTER)
    while (now := time.monotonic()) < end:
        if link.peer is not None and now >= next_heartbeat:  # who does not know us sends nothing
            next_heartbeat = now + 1.0
            link.send(_heartbeat().pack(sender), link.peer)
        for data, peer in link.read(_TICK):
            heard.packets += 1
            if len(heard.senders) < _MAX_SENDERS:
                heard.senders.add(":".join(map(str, peer[:2])) if isinstance(peer, tuple) else str(peer))
            if not link.stream:
                parser = _parser()
            for message in parser.parse_buffer(data) or []:
                _count(heard, message)
            if not link.stream:
                heard.junk += parser.buf_len()
            if time.monotonic() >= end:
                break
    return heard


def _count(heard: Heard, message: Any) -> None:
    raw = bytes(message.get_msgbuf())
    if message.get_type() == "BAD_DATA":
        heard.junk += len(raw)
        return
    system = raw[5] if raw[0] == dialect.PROTOCOL_MARKER_V2 else raw[3]
    if system in heard.systems or len(heard.systems) < _MAX_SYSTEMS:
        heard.systems.setdefault(system, Counter())[message.get_type()] += 1


def _judge(link: str, heard: Heard, seconds: float) -> Iterator[Finding]:
    senders = list_names(sorted(heard.senders))
    if not heard.packets:
        advice = "does the vehicle send to this host and port ('mavlink status' in PX4's shell)? a firewall, a router?"
        yield Finding("mavlink", link, "wrong", f"nothing arrives within {seconds:g} s", advice)
        return
    if not heard.systems:
        seen = f"{heard.packets} packets from {senders} that are not MAVLink"
        yield Finding(
            "mavlink", link, "wrong", seen, "who sends there? take another port, or the baud rate of the vehicle"
        )
        return
    for system, counts in sorted(heard.systems.items()):
        yield _judge_system(link, system, counts, seconds)
    if heard.junk:
        yield Finding("mavlink", link, "warning", f"{heard.junk} bytes that are not MAVLink, beside it, from {senders}")


def _judge_system(link: str, system: int, counts: Counter[str], seconds: float) -> Finding:
    name = f"{link} system {system}"
    kinds = list_names(kind for kind, _ in counts.most_common())
    if counts[_POSITION]:
        seen = f"{_POSITION} at {counts[_POSITION] / seconds:.0f} Hz, of {kinds}"
        if counts["ODOMETRY"]:
            return Finding("mavlink", name, "ok", seen)
        advice = "without ODOMETRY evh and evv are not provided: the source requests it"
        return Finding("mavlink", name, "ok", seen, advice)
    if counts["ODOMETRY"]:
        seen = f"ODOMETRY, and no {_POSITION}: {kinds}"
    else:
        seen = "HEARTBEAT only" if set(counts) == {"HEARTBEAT"} else f"no {_POSITION}: {kinds}"
    advice = (
        f"'nedbus serve --source mavlink:{link}' requests it; if it stays so, PX4 has no estimate yet, or"
        f" 'mavlink stream -s {_POSITION} -r 30' in its shell switches it on"
    )
    return Finding("mavlink", name, "warning", seen, advice)


def _explain(link: str, error: SourceError) -> Finding:
    cause = error.__cause__
    if isinstance(cause, OSError) and cause.errno == errno.EADDRINUSE:
        owner = udp_port_owner(int(link.rpartition(":")[2])) or "another process, which this user may not see"
        advice = "that one gets what arrives: if it is 'nedbus serve' all is well, else stop it or take another port"
        return Finding("mavlink", link, "warning", f"its port is taken by {owner}", advice)
    return Finding("mavlink", link, "wrong", error.reason, "check the link: address, port or device, and permissions")


def _heartbeat() -> Any:
    return dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE, 3
    )


def _parser() -> Any:
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    return parser
