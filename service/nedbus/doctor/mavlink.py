"""Check of a MAVLink link: packets, messages, positions and the ULog stream; needs the extra `mavlink`."""

import errno
import math
from collections.abc import Iterator
from typing import Final

from nedbus.errors import SourceError
from nedbus.sources import LinkSurvey, SystemTraffic, expected_header, parse_link, survey_link
from nedbus.timings import TIMINGS

from .finding import FIRST_PARTNER, Finding, State, limit_findings, list_names

_POSITION: Final = "LOCAL_POSITION_NED"
_SATELLITE: Final = "HIGH_LATENCY2"
_AUTOPILOT: Final = 1  # component id: MAV_COMP_ID_AUTOPILOT1
_BACKEND: Final = "SDLOG_BACKEND"
_TO_MAVLINK: Final = 2  # bit 1 of SDLOG_BACKEND
_FEW_TOPICS: Final = 16  # in the logger_topics.txt that docs/live.md proposes
_HEADER_MARGIN: Final = 1.2  # of the time for the header that the advice proposes


def check_mavlink(link: str) -> Iterator[Finding]:
    """Listen to a link for 3 s and yield the findings; raise ConfigError for an invalid link."""
    try:
        survey = survey_link(link, TIMINGS.listen)
    except SourceError as exc:
        yield _explain_failure(link, exc)
        return
    if not survey.packets:
        yield _no_packet(link)
    elif not survey.systems and not survey.ignored:
        senders = list_names(sorted(survey.packets))
        seen = f"no MAVLink among the packets from {senders} (total: {survey.packets.total()})"
        advice = "check the baud rate, or use a port that no other program sends to"
        yield Finding("mavlink", link, "wrong", seen, advice)
    yield from limit_findings(_check_ignored(link, survey))
    yield from limit_findings(_check_duplicates(link, survey))
    systems = sorted(survey.systems.items())
    yield from limit_findings(_check_system(link, number, system) for number, system in systems)
    yield from limit_findings(
        _check_log(link, number, system) for number, system in systems if system.is_px4
    )


def _explain_failure(link: str, error: SourceError) -> Finding:
    """Return the finding that a link cannot be opened; a port in use may be that of a running service."""
    cause = error.__cause__
    if isinstance(cause, OSError) and cause.errno == errno.EADDRINUSE:
        advice = "fine if 'nedbus serve' is the other program; 'ss -ulpn' shows it"
        return Finding("mavlink", link, "warning", error.reason, advice)
    advice = "check the address and port, or the device and its permissions"
    return Finding("mavlink", link, "wrong", error.reason, advice)


def _no_packet(link: str) -> Finding:
    advice = "check firewalls, and that the vehicle sends to this host and port ('mavlink status' in PX4's shell)"
    if parse_link(link).kind == "udpout":
        advice = f"{advice}; {FIRST_PARTNER}"
    return Finding("mavlink", link, "wrong", f"no packet within {TIMINGS.listen:g} s", advice)


def _check_ignored(link: str, survey: LinkSurvey) -> Iterator[Finding]:
    """Yield the senders that are ignored; cameras and ground stations are normal, but not alone."""
    for (system, component), reason in sorted(survey.ignored.items()):
        subject = f"{link} system {system} component {component}"
        seen = f"ignored: {reason}"
        is_broadcast = system == 0 or component == 0
        if is_broadcast or not survey.systems:
            yield Finding("mavlink", subject, "wrong", seen)
        elif component != _AUTOPILOT:
            continue
        elif system in survey.systems:
            advice = (
                "another program uses the ids of the autopilot; give it a component id of its own"
            )
            yield Finding("mavlink", subject, "warning", f"some HEARTBEATs are {seen}", advice)
        else:
            advice = f"only autopilots should use component id {_AUTOPILOT}; give this program another one"
            yield Finding("mavlink", subject, "ok", seen, advice)


def _check_duplicates(link: str, survey: LinkSurvey) -> Iterator[Finding]:
    for system, fault in sorted(survey.duplicates.items()):
        yield Finding("mavlink", f"{link} system {system} component {_AUTOPILOT}", "wrong", fault)


def _check_system(link: str, number: int, system: SystemTraffic) -> Finding:
    """Return which messages an autopilot sends, above all its position."""
    name = f"{link} system {number}"
    messages = system.messages
    types = list_names(kind for kind, _ in messages.most_common())
    if messages[_POSITION]:
        rate = messages[_POSITION] / TIMINGS.listen
        seen = f"{_POSITION} at {rate:.0f} Hz; messages: {types}"
        advice = ""
        if not messages["ODOMETRY"]:
            advice = "evh and evv come from ODOMETRY, which 'nedbus serve' requests"
        return Finding("mavlink", name, "ok", seen, advice)
    kinds = set(messages)
    if kinds == {_SATELLITE}:
        advice = "'nedbus serve' publishes global position, status and battery, and sends nothing to the vehicle"
        return Finding("mavlink", name, "ok", f"a satellite link: {_SATELLITE} only", advice)
    seen = f"no {_POSITION}, only {types}"
    if kinds == {"HEARTBEAT"}:
        seen = "HEARTBEAT only"
    advice = (
        f"'nedbus serve --source mavlink:{link}' requests it; if none arrives, PX4 may have no estimate, or may need"
        f" 'mavlink stream -s {_POSITION} -r 30' in its shell"
    )
    return Finding("mavlink", name, "warning", seen, advice)


def _check_log(link: str, number: int, system: SystemTraffic) -> Finding:
    """Return whether PX4 can send its ULog stream on this link; it is not requested."""
    name = f"{link} system {number}"
    if system.log_clients:
        return _describe_clients(name, system)
    backend = system.log_backend
    if backend is not None and not backend & _TO_MAVLINK:
        seen = f"{_BACKEND} is {backend}: PX4 refuses to send its ULog stream"
        advice = f"set {_BACKEND} to 3 (file and MAVLink), and restart PX4"
        return Finding("mavlink", name, "warning", seen, advice)
    load = system.size / TIMINGS.listen / 1000
    seen = f"PX4 found; the link carries {load:.0f} kB/s"
    options = "log=1"
    trip = system.round_trip
    if trip is not None:
        few = expected_header(trip, topics=_FEW_TOPICS)
        default = expected_header(trip)
        seen = (
            f"{seen}; round trip {1e3 * trip:.0f} ms: the header of the ULog stream blocks PX4's logger for {few:.0f} s"
            f" with logger_topics.txt, {default:.0f} s with the default topics"
        )
        if default > TIMINGS.log_header:
            options = f"{options}&header={math.ceil(_HEADER_MARGIN * default)}"
    advice = f"for all fields of all topics, run 'nedbus serve --source \"mavlink:{link}?{options}\"' (docs/live.md)"
    return Finding("mavlink", name, "ok", seen, advice)


def _describe_clients(name: str, system: SystemTraffic) -> Finding:
    """Return to whom PX4 sends its ULog stream; fine if that is a service of nedbus."""
    clients = sorted(
        f"system {client} component {component}" for client, component in system.log_clients
    )
    seen = f"sends its ULog stream to {list_names(clients)}"
    advice = "PX4 streams to one client: it refuses 'nedbus serve' while another one receives"
    state: State = "warning"
    if system.sends_log_to_nedbus:
        state = "ok"
    return Finding("mavlink", name, state, seen, advice)
