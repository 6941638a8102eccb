"""Check of a MAVLink link for packets, messages and positions; needs the extra `mavlink`."""

from __future__ import annotations

import errno
import time
from collections import Counter
from collections.abc import Iterator
from contextlib import closing
from typing import Any, Final

from pymavlink.dialects.v20 import common as dialect

from nedbus.errors import SourceError
from nedbus.sources import Link, open_link

from .finding import Finding, limit_findings, list_names

_READ_TIMEOUT: Final = 0.25  # s
_MAX_SENDERS: Final = 5
_POSITION: Final = "LOCAL_POSITION_NED"
_BAUD: Final = 57600
_SYSTEM: Final = 245  # ours, as in the source


def check_mavlink(link: str, listen: float) -> Iterator[Finding]:
    """Listen to a link for `listen` seconds and yield the findings; raise ConfigError for an invalid link."""
    try:
        with closing(open_link(link, baud=_BAUD)) as opened:
            senders, systems = _listen(opened, listen)
    except SourceError as exc:
        is_taken = isinstance(exc.__cause__, OSError) and exc.__cause__.errno == errno.EADDRINUSE
        advice = "check address, port or device, and permissions"
        if is_taken:
            advice = "fine if 'nedbus serve' uses the port; else stop the process shown by 'ss -ulpn', or use another"
        yield Finding("mavlink", link, "warning" if is_taken else "wrong", exc.reason, advice)
        return
    if not senders:
        advice = "check that the vehicle sends to this host and port ('mavlink status' in PX4's shell), and firewalls"
        yield Finding("mavlink", link, "wrong", f"no packet within {listen:g} s", advice)
    elif not systems:
        seen = f"{senders.total()} packets from {list_names(sorted(senders))}, none of them MAVLink"
        advice = "check the baud rate, or use a port that no other program sends to"
        yield Finding("mavlink", link, "wrong", seen, advice)
    yield from limit_findings(
        _judge_system(f"{link} system {system}", link, counts, listen) for system, counts in sorted(systems.items())
    )


def _listen(link: Link, seconds: float) -> tuple[Counter[str], dict[int, Counter[str]]]:
    """Count packets by sender, and messages by system and type."""
    senders: Counter[str] = Counter()
    systems: dict[int, Counter[str]] = {}
    end, next_heartbeat = time.monotonic() + seconds, 0.0
    parser = _new_parser()
    sender = dialect.MAVLink(None, _SYSTEM, dialect.MAV_COMP_ID_ONBOARD_COMPUTER)
    heartbeat = dialect.MAVLink_heartbeat_message(
        dialect.MAV_TYPE_ONBOARD_CONTROLLER, dialect.MAV_AUTOPILOT_INVALID, 0, 0, dialect.MAV_STATE_ACTIVE, 3
    )
    while (now := time.monotonic()) < end:
        if link.peer is not None and now >= next_heartbeat:  # the peer sends only to known addresses
            next_heartbeat = now + 1.0
            link.send(heartbeat.pack(sender), link.peer)
        for data, peer in link.read(_READ_TIMEOUT):
            name = ":".join(map(str, peer[:2])) if isinstance(peer, tuple) else str(peer)
            if name in senders or len(senders) < _MAX_SENDERS:
                senders[name] += 1
            if not link.stream:
                parser = _new_parser()
            for message in parser.parse_buffer(data) or []:
                if not message.get_type().startswith(("BAD_DATA", "UNKNOWN")):  # these have no header
                    systems.setdefault(message.get_srcSystem(), Counter())[message.get_type()] += 1  # 255 at most
    return senders, systems


def _judge_system(name: str, link: str, counts: Counter[str], seconds: float) -> Finding:
    types = list_names(type_ for type_, _ in counts.most_common())
    if counts[_POSITION]:
        seen = f"{_POSITION} at {counts[_POSITION] / seconds:.0f} Hz, of {types}"
        advice = "" if counts["ODOMETRY"] else "evh and evv need ODOMETRY, which 'nedbus serve' requests"
        return Finding("mavlink", name, "ok", seen, advice)
    seen = "HEARTBEAT only" if set(counts) == {"HEARTBEAT"} else f"no {_POSITION}: {types}"
    advice = (
        f"'nedbus serve --source mavlink:{link}' requests it; if none arrives, PX4 may have no estimate yet, or needs"
        f" 'mavlink stream -s {_POSITION} -r 30' in its shell"
    )
    return Finding("mavlink", name, "warning", seen, advice)


def _new_parser() -> Any:
    parser = dialect.MAVLink(None)
    parser.robust_parsing = True
    return parser
