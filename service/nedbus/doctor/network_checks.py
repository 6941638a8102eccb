"""Checks of the network behind a router: sessions, permissions, services, vehicles, clocks and other prefixes."""

from collections.abc import Iterator
from typing import Final

from nedbus.clock import format_duration, format_since
from nedbus.health import ServiceStatus, SourceStatus
from nedbus.vehicle_events import by_vehicle
from nedbus_msgs import Address, get_topic, prefix_of

from .finding import FIRST_PARTNER, Finding, State, brief, list_names
from .observation import Observation

_NEARLY_FULL: Final = 0.8  # fraction of a router's max_sessions
_ACCESS_RULES: Final = (
    "see access_control in the router's file (config/router-secure.json5), and docs/security.md"
)
_MAX_TEXT: Final = 300  # characters of text from a peer
_MAX_REMARKS: Final = 3  # of a source
_MAX_WARNING: Final = 602  # characters of the origin and the reason of a rejection
_SILENT_PERIODS: Final = 3.0  # message intervals after which an address is silent
_MAX_TIME: Final = 1e11  # s; maximum Unix time accepted from a service
_CLOCK_WARNING: Final = 0.5  # s
_CLOCK_WRONG: Final = 5.0  # s
_SYNCHRONISE: Final = "run NTP or PTP on both hosts; check them with 'timedatectl'"


def check_routers(seen: Observation) -> Iterator[Finding]:
    """Yield the number of sessions at each router; warn if it is close to the limit."""
    if not seen.routers:
        yield Finding(
            "router", "", "ok", "connected; its other sessions are not visible to this client"
        )
    for router in seen.routers:
        is_full, text = False, f"connected sessions: {router.sessions:,}"
        if router.max_sessions is not None:
            text = f"{router.sessions:,} of {router.max_sessions:,} sessions"
            is_full = router.sessions >= _NEARLY_FULL * router.max_sessions
        advice = (
            "raise max_sessions and the limit of open files, or run a second router (docs/hosts.md)"
        )
        yield Finding(
            "router", router.zid, "warning" if is_full else "ok", text, advice if is_full else ""
        )


def check_permissions(seen: Observation) -> Iterator[Finding]:
    """Yield the read permission, inferred from received messages, and the write permission, tested with a probe."""
    reading = _check_reading(seen)
    yield reading
    vehicle = seen.vehicle
    if vehicle is None:
        yield Finding(
            "write",
            "",
            "unknown",
            "write permission not tested",
            "test it with 'nedbus doctor --vehicle 1'",
        )
    elif seen.verdict == "allowed":
        yield Finding(
            "write", vehicle, "ok", f"this client may publish vehicle {vehicle}: a probe arrived"
        )
    elif seen.verdict == "denied":  # a reader needs no write permission
        state: State = (
            "warning" if reading.state == "unknown" else "ok" if reading.state == "ok" else "wrong"
        )
        text = f"the router silently drops messages that this client publishes as vehicle {vehicle}"
        advice = (
            f"fine for a reader; to publish, use the certificate of that vehicle; {_ACCESS_RULES}"
        )
        yield Finding("write", vehicle, state, text, advice)
    else:
        text = f"write permission not tested: the router does not let this client read a probe for vehicle {vehicle}"
        advice = f"allow {seen.prefix}/*/@doctor/* as in config/router-secure.json5, or run the doctor as a reader"
        yield Finding("write", vehicle, "unknown", text, advice)


def _check_reading(seen: Observation) -> Finding:
    if seen.delays or seen.ages:
        return Finding("read", "", "ok", "this client may read: it receives messages")
    published = _published(seen)
    if not published:
        return Finding("read", "", "unknown", "read permission not tested: nothing is published")
    text = f"services report that they publish {list_names(published)}, but no message arrives here"
    if seen.verdict == "allowed":
        advice = "a vehicle's certificate only permits writing: use a reader's certificate"
        return Finding("read", "", "warning", text, advice)
    advice = f"check that these services may write and this client may read these vehicles; {_ACCESS_RULES}"
    return Finding("read", "", "wrong", text, advice)


def check_services(seen: Observation) -> Iterator[Finding]:
    """Yield findings on the version and the sources of each service; it has a status for each of its vehicles."""
    known: list[Finding] = []
    for finding in _check_statuses(seen):
        if finding not in known:
            known.append(finding)
            yield finding


def _check_statuses(seen: Observation) -> Iterator[Finding]:
    for service in seen.services:
        name = brief(service.service)
        version = brief(service.version or "unknown")
        if service.is_outdated:
            where = brief(service.host or "an unknown host")
            text = f"nedbus {version} on {where}: its status does not name its vehicle, and is not used"
            yield Finding("service", name, "wrong", text, "update nedbus on its host")
            continue
        if version.split(".")[:2] != seen.version.split(".")[:2]:
            advice = "install the same version on both sides; CHANGELOG.md lists changes of the wire format"
            text = f"the service runs nedbus {version}, this client {seen.version}"
            yield Finding("version", name, "warning", text, advice)
        findings = [finding for source in service.sources for finding in _check_source(source)]
        yield from findings
        if all(finding.state == "ok" for finding in findings):
            host = brief(service.host or "an unknown host")
            text = f"nedbus {version} on {host}, sources without faults: {len(service.sources)}"
            yield Finding("service", name, "ok", text)
    if not seen.services:
        advice = "start one with 'nedbus serve'; publishing scripts do not count as services"
        yield Finding("service", "", "unknown", "no nedbus service answers", advice)


def _published(seen: Observation) -> list[str]:
    return sorted({brief(address) for source in seen.sources for address in source.addresses})


def _check_source(source: SourceStatus) -> Iterator[Finding]:
    name, state = brief(source.source), source.state
    error = (source.error or "unknown reason")[:_MAX_TEXT]
    if state in {"failed", "retrying"}:
        ends = "it has stopped" if state == "failed" else "it is being restarted"
        yield Finding(
            "source", name, "wrong", f"{state}: {error}", f"{ends}; see the log of its service"
        )
    elif state in {"waiting", "starting"}:
        advice = "check that the vehicle sends to the service; for MAVLink, run 'nedbus doctor --mavlink LINK' there"
        if source.source.startswith("mavlink:udpout:"):
            advice = f"{advice}; {FIRST_PARTNER}"
        yield Finding("source", name, "warning", f"{state}: no message yet", advice)
    if source.overload:
        yield Finding(
            "source", name, "wrong", source.overload[:_MAX_TEXT], "stop other programs on its host"
        )
    if source.silent:
        advice = (
            "PX4 may be losing them: remove rel= from all lines of its zenoh/pub.csv (docs/live.md)"
        )
        seen = f"announced, but silent while other topics arrive: {list_names(source.silent, 20)}"
        yield Finding("source", name, "warning", seen, advice)
    if source.not_carried:
        advice = (
            "to carry them, pass PX4's definitions: px4-zenoh:?msg=NAME.msg, or a folder of them"
        )
        seen = f"published by vehicles, but not carried: {list_names(source.not_carried, 20)}"
        yield Finding("source", name, "ok", seen, advice)
    for log in source.log_streams:
        stream = f"{name} vehicle {brief(log.vehicle)}"
        if log.reason:
            seen = f"no ULog stream, fields are converted from MAVLink: {log.reason[:_MAX_TEXT]}"
            yield Finding(
                "source", stream, "warning", seen, "see 'The ULog stream' in docs/live.md"
            )
        if log.gaps:
            seen = f"the ULog stream lost {log.lost} LOGGING_DATA, about {log.lost_messages} messages; gaps: {log.gaps}"
            advice = "raise the rate of the link, or log fewer topics; see the table of rates in docs/live.md"
            yield Finding("source", stream, "warning", seen, advice)
    if stale := [address for address in source.stale if address not in source.silent]:
        advice = (
            "check that the vehicle is on and its link is up; the source recovers automatically"
        )
        yield Finding("source", name, "warning", f"no more messages of {list_names(stale)}", advice)
    if source.rejected > 0:
        why = f" ({list_names(source.rejections)})" if source.rejections else ""
        first = "".join(f"; {text[:_MAX_WARNING]}" for text in source.warnings[:1])
        advice = "rejected messages are not published; see the service's log or the @rejected keys for all reasons"
        yield Finding(
            "source", name, "warning", f"messages rejected: {source.rejected:,}{why}{first}", advice
        )
    elif source.warnings:  # remarks, such as that on a satellite link
        remarks = "; ".join(text[:_MAX_WARNING] for text in source.warnings[:_MAX_REMARKS])
        yield Finding("source", name, "ok", remarks)


def check_vehicles(seen: Observation) -> Iterator[Finding]:
    """Yield findings on the addresses of all vehicles, or of the selected one."""
    vehicle = seen.vehicle
    arrived = seen.delays.keys()
    known = sorted(each for each in {*seen.alive, *arrived} if vehicle in (None, each.vehicle))
    for address in known:
        yield from _check_address(seen, address, flows=address in arrived)
    for name, report in by_vehicle(seen.accounts).items():
        now, current = report.now, report.vehicles[name]
        if vehicle in (None, name) and current.severity != "info" and not current.is_forgotten(now):
            advice = f"see the events before it with 'nedbus why --vehicle {name}'"
            text = f"{current.text[:_MAX_TEXT]}{format_since(current.since, now)}"
            yield Finding(
                "vehicle", name, "wrong" if current.severity == "bad" else "warning", text, advice
            )
    if not seen.alive.complete:
        advice = "a vehicle may have over 1,000 publishers: the log names it; otherwise, try again"
        yield Finding("vehicle", "", "unknown", "not all streams are listed", advice)
    shown = set(map(str, known))
    hidden = [
        each
        for each in _published(seen)
        if each not in shown and vehicle in (None, each.partition("/")[0])
    ]
    # otherwise this client may lack read permission
    for each in hidden if arrived or seen.ages else ():
        advice = "check that the router's access rules allow that service to write this vehicle (docs/security.md)"
        text = f"reported as published by {list_names(_publishers_of(seen, each))}, but no message arrives"
        yield Finding("vehicle", each, "wrong", text, advice)
    if flowing := [address for address in known if address in arrived]:
        vehicles = {address.vehicle for address in flowing}
        yield Finding(
            "vehicle",
            "",
            "ok",
            f"messages arrive; vehicles: {len(vehicles)}, topics: {len(flowing)}",
        )
    if not known and not hidden:
        yield _missing_vehicle(seen)


def _missing_vehicle(seen: Observation) -> Finding:
    """Return the finding that the selected vehicle, or any, is not published."""
    vehicle = seen.vehicle
    advice = "start its source: 'nedbus serve --source ...'"
    if any(finding.state != "ok" for source in seen.sources for finding in _check_source(source)):
        advice = "see the findings on sources"
    elif seen.services:
        names = list_names(map(_name_of, seen.services))
        advice = f"no source of {names} receives it: check the name, or start its source there"
    if others := sorted({each.vehicle for each in {*seen.alive, *seen.delays}}):
        advice += f"; published: {', '.join(others[:20])}"
    if vehicle is None:
        return Finding("vehicle", "", "warning", f"no vehicle found under {seen.prefix}/", advice)
    return Finding("vehicle", vehicle, "wrong", f"not found under {seen.prefix}/", advice)


def _name_of(service: ServiceStatus) -> str:
    return f"service {brief(service.service)} on {brief(service.host or 'an unknown host')}"


def _publishers_of(seen: Observation, address: str) -> list[str]:
    """Return the services that report this address as published, with their hosts and sources."""
    return [
        f"{_name_of(service)} ({brief(source.source)})"
        for service in seen.services
        for source in service.sources
        if address in source.addresses
    ]


def _check_address(seen: Observation, address: Address, *, flows: bool) -> Iterator[Finding]:
    name = str(address)
    age, rate = seen.ages.get(address), get_topic(address.topic).rate
    if not flows and rate and (seen.listened if age is None else age) > _SILENT_PERIODS / rate:
        last = "no message yet" if address not in seen.ages else "its last message has no timestamp"
        if age is not None:
            last = f"its last message is {format_duration(age)} old"
        advice = "its publisher runs but sends nothing: check its input, such as a service's source or a script's loop"
        # topics of a replay may start later
        state: State = "wrong" if address in seen.ages else "warning"
        yield Finding(
            "vehicle", name, state, f"alive, but silent for {seen.listened:.0f} s: {last}", advice
        )
    if error := seen.errors.get(address):
        advice = "check that nedbus publishes this key; a newer message layout needs a newer nedbus on this host"
        yield Finding(
            "vehicle", name, "wrong", f"cannot decode a payload: {error[:_MAX_TEXT]}", advice
        )
    if (publishers := seen.alive[address]) > 1:
        advice = "readers receive a mixture of their messages: stop all but one, or give each its own --vehicle"
        text = f"{publishers} publishers of this address"
        if services := _publishers_of(seen, name):
            text = f"{text}: {list_names(services)}"
            if publishers > len(services):
                text = f"{text}, and {publishers - len(services)} that no service reports, such as a script"
        yield Finding("vehicle", name, "wrong", text, advice)


def check_clocks(seen: Observation) -> Iterator[Finding]:
    """Yield findings on clocks that are off; if all others agree with each other, this host's clock is off."""
    clocks = {  # offset from this host's clock, and its uncertainty [s]
        f"service {brief(each.service)} on {brief(each.host)}": (each.now - seen.asked, seen.error)
        for each in seen.services
        if each.now is not None and abs(each.now) < _MAX_TIME  # false for NaN
    }
    for address, delay in seen.delays.items():
        if delay is not None:
            # a positive delay includes the network latency
            error = 0.0 if delay < 0 else _CLOCK_WARNING
            clocks[f"publisher of {address}"] = (-delay, error)
    off = {
        name: offset
        for name, (offset, error) in clocks.items()
        if abs(offset) > _CLOCK_WARNING + error
    }
    if (
        len(off) > 1
        and len(off) == len(clocks)
        and max(off.values()) - min(off.values()) < _CLOCK_WARNING
    ):
        middle = sorted(off.values())[len(off) // 2]
        others = f"{len(off)} others, which agree with each other"
        yield _clock_finding("this host", "this host's clock", -middle, others, _SYNCHRONISE)
        return
    only = len(clocks) == len(off)
    blame = (
        "either clock may be off:"
        if only
        else "the other clocks agree with this host's; set this one:"
    )
    for name, offset in off.items():
        yield _clock_finding(name, "its clock", offset, "this host's", f"{blame} {_SYNCHRONISE}")
    if clocks and not off:
        largest = max(abs(offset) for offset, _ in clocks.values())
        yield Finding(
            "clock",
            "",
            "ok",
            f"all clocks agree with this host's within {format_duration(largest)}",
        )


def _clock_finding(name: str, clock: str, offset: float, reference: str, advice: str) -> Finding:
    text = f"{clock} is {format_duration(abs(offset))} {'ahead of' if offset > 0 else 'behind'} {reference}"
    return Finding(
        "clock", name, "wrong" if abs(offset) > _CLOCK_WRONG else "warning", text, advice
    )


def check_other_keys(seen: Observation) -> Iterator[Finding]:
    """Yield other prefixes and ROS 2 topics, which readers of this prefix do not receive."""
    prefixes = {prefix_of(key) for key in seen.elsewhere}
    for prefix in sorted(prefixes - {""})[:5]:
        advice = f"use --prefix {prefix} or NEDBUS_PREFIX={prefix} to read them, or correct the publisher's prefix"
        text = f"messages are published under {prefix}/, but the prefix here is {seen.prefix}/"
        yield Finding("prefix", prefix, "warning", text, advice)
    if seen.ros2 and not any(each.source.startswith("px4-zenoh:") for each in seen.sources):
        topics = list_names(sorted({f"/{token.key.topic}" for token in seen.ros2}))
        advice = "run 'nedbus serve --source px4-zenoh:' to bridge them"
        yield Finding(
            "ros2",
            "",
            "warning",
            f"ROS 2 or PX4 publishes {topics}, but no service bridges it",
            advice,
        )


NETWORK_CHECKS: Final = (
    check_routers, check_permissions, check_services, check_vehicles, check_clocks, check_other_keys,
)  # fmt: skip
