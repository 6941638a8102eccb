"""Checks of the network behind a router: sessions, permissions, services, vehicles, clocks and other prefixes."""

from collections.abc import Collection, Iterator, Mapping
from typing import Final, NamedTuple

from nedbus import limits
from nedbus.clock import format_duration, format_since
from nedbus.health import LogStreamStatus, ServiceStatus, SourceStatus
from nedbus.vehicle_events import by_vehicle
from nedbus_msgs import Address, get_topic, prefix_of

from .finding import FIRST_PARTNER, Finding, State, brief, list_names
from .observation import Observation

_NEARLY_FULL: Final = 0.8  # fraction of a router's max_sessions
_ACCESS_RULES: Final = (
    "see access_control in the router's file (config/router-secure.json5), and docs/security.md"
)
_OTHER_PREFIXES: Final = 5  # named, one finding each
_REMARKS: Final = 3  # of a source, in one finding
_SILENT_PERIODS: Final = 3.0  # message intervals after which an address is silent
_FAR_FUTURE: Final = 1e11  # s; later Unix times of a service are no times
_CLOCK_WARNING: Final = 0.5  # s
_CLOCK_WRONG: Final = 5.0  # s
_SYNCHRONISE: Final = "run NTP or PTP on both hosts; check them with 'timedatectl'"


def check_routers(seen: Observation) -> Iterator[Finding]:
    """Yield the number of sessions at each router; warn if it is close to the limit."""
    if not seen.routers:
        text = "connected; its other sessions are not visible to this client"
        yield Finding("router", "", "ok", text)
    for router in seen.routers:
        limit = router.max_sessions
        if limit is None:
            yield Finding("router", router.zid, "ok", f"connected sessions: {router.sessions:,}")
            continue
        text = f"{router.sessions:,} of {limit:,} sessions"
        if router.sessions < _NEARLY_FULL * limit:
            yield Finding("router", router.zid, "ok", text)
            continue
        advice = (
            "raise max_sessions and the limit of open files, or run a second router (docs/hosts.md)"
        )
        yield Finding("router", router.zid, "warning", text, advice)


def check_permissions(seen: Observation) -> Iterator[Finding]:
    """Yield the read permission, inferred from received messages, and the write permission, tested with a probe."""
    reading = _check_reading(seen)
    yield reading
    vehicle = seen.vehicle
    if vehicle is None:
        advice = "test it with 'nedbus doctor --vehicle 1'"
        yield Finding("write", "", "unknown", "write permission not tested", advice)
    elif seen.verdict == "allowed":
        text = f"this client may publish vehicle {vehicle}: a probe arrived"
        yield Finding("write", vehicle, "ok", text)
    elif seen.verdict == "denied":
        text = f"the router silently drops messages that this client publishes as vehicle {vehicle}"
        advice = (
            f"fine for a reader; to publish, use the certificate of that vehicle; {_ACCESS_RULES}"
        )
        yield Finding("write", vehicle, _STATE_OF_DENIAL[reading.state], text, advice)
    else:
        text = f"write permission not tested: the router does not let this client read a probe for vehicle {vehicle}"
        advice = f"allow {seen.prefix}/*/@doctor/* as in config/router-secure.json5, or run the doctor as a reader"
        yield Finding("write", vehicle, "unknown", text, advice)


_STATE_OF_DENIAL: Final[Mapping[State, State]] = {
    "ok": "ok",  # a reader needs no write permission
    "unknown": "warning",
    "warning": "wrong",
    "wrong": "wrong",
}
"""The state of a denied write permission by that of the read permission."""


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
    findings = list[Finding]()
    for service in seen.services:
        findings += _check_service(service, seen.version)
    if not seen.services:
        advice = "start one with 'nedbus serve'; publishing scripts do not count as services"
        findings.append(Finding("service", "", "unknown", "no nedbus service answers", advice))
    yield from dict.fromkeys(findings)


def _check_service(service: ServiceStatus, own_version: str) -> Iterator[Finding]:
    """Yield the findings on one status of a service."""
    name = brief(service.service)
    version = brief(service.version or "unknown")
    host = brief(service.host or "an unknown host")
    if service.is_outdated:
        text = f"nedbus {version} on {host}: its status does not name its vehicle, and is not used"
        yield Finding("service", name, "wrong", text, "update nedbus on its host")
        return
    if _release_of(version) != _release_of(own_version):
        advice = (
            "install the same version on both sides; CHANGELOG.md lists changes of the wire format"
        )
        text = f"the service runs nedbus {version}, this client {own_version}"
        yield Finding("version", name, "warning", text, advice)
    findings = list[Finding]()
    for source in service.sources:
        findings += _check_source(source)
    yield from findings
    if all(finding.state == "ok" for finding in findings):
        text = f"nedbus {version} on {host}, sources without faults: {len(service.sources)}"
        yield Finding("service", name, "ok", text)


def _release_of(version: str) -> list[str]:
    """Return the major and the minor version."""
    return version.split(".")[:2]


def _published(seen: Observation) -> list[str]:
    """Return the addresses that services report as published."""
    names = {brief(address) for source in seen.sources for address in source.addresses}
    return sorted(names)


def _check_source(source: SourceStatus) -> Iterator[Finding]:
    """Yield the findings on a source, from what its service reports."""
    name = brief(source.source)
    yield from _check_state(name, source)
    if source.overload:
        text = source.overload[: limits.PEER_TEXT]
        yield Finding("source", name, "wrong", text, "stop other programs on its host")
    if source.silent:
        advice = (
            "PX4 may be losing them: remove rel= from all lines of its zenoh/pub.csv (docs/live.md)"
        )
        topics = list_names(source.silent, limits.SHOWN_NAMES)
        seen = f"announced, but silent while other topics arrive: {topics}"
        yield Finding("source", name, "warning", seen, advice)
    if source.not_carried:
        advice = (
            "to carry them, pass PX4's definitions: px4-zenoh:?msg=NAME.msg, or a folder of them"
        )
        topics = list_names(source.not_carried, limits.SHOWN_NAMES)
        seen = f"published by vehicles, but not carried: {topics}"
        yield Finding("source", name, "ok", seen, advice)
    for log in source.log_streams:
        yield from _check_log_stream(f"{name} vehicle {brief(log.vehicle)}", log)
    stale = [address for address in source.stale if address not in source.silent]
    if stale:
        advice = (
            "check that the vehicle is on and its link is up; the source recovers automatically"
        )
        yield Finding("source", name, "warning", f"no more messages of {list_names(stale)}", advice)
    yield from _check_rejections(name, source)


def _check_state(name: str, source: SourceStatus) -> Iterator[Finding]:
    """Yield that a source has failed, or that nothing has arrived."""
    state = source.state
    error = (source.error or "unknown reason")[: limits.PEER_TEXT]
    if state == "failed":
        advice = "it has stopped; see the log of its service"
        yield Finding("source", name, "wrong", f"failed: {error}", advice)
    elif state == "retrying":
        advice = "it is being restarted; see the log of its service"
        yield Finding("source", name, "wrong", f"retrying: {error}", advice)
    elif state in {"waiting", "starting"}:
        advice = "check that the vehicle sends to the service; for MAVLink, run 'nedbus doctor --mavlink LINK' there"
        if source.source.startswith("mavlink:udpout:"):
            advice = f"{advice}; {FIRST_PARTNER}"
        yield Finding("source", name, "warning", f"{state}: no message yet", advice)


def _check_log_stream(name: str, log: LogStreamStatus) -> Iterator[Finding]:
    """Yield that a vehicle has no ULog stream, or that messages of it were lost."""
    if log.reason:
        reason = log.reason[: limits.PEER_TEXT]
        seen = f"no ULog stream, fields are converted from MAVLink: {reason}"
        advice = "see 'The ULog stream' in docs/live.md"
        yield Finding("source", name, "warning", seen, advice)
    if log.gaps:
        seen = f"the ULog stream lost {log.lost} LOGGING_DATA, about {log.lost_messages} messages; gaps: {log.gaps}"
        advice = "raise the rate of the link, or log fewer topics; see the table of rates in docs/live.md"
        yield Finding("source", name, "warning", seen, advice)


def _check_rejections(name: str, source: SourceStatus) -> Iterator[Finding]:
    """Yield that messages are rejected; without any, the remarks of a source, such as that on a satellite link."""
    # The origin of a rejection and its reason are two texts of a peer.
    texts = [text[: 2 * limits.PEER_TEXT] for text in source.warnings]
    if source.rejected > 0:
        seen = f"messages rejected: {source.rejected:,}"
        if source.rejections:
            seen = f"{seen} ({list_names(source.rejections)})"
        if texts:
            seen = f"{seen}; {texts[0]}"
        advice = "rejected messages are not published; see the service's log or the @rejected keys for all reasons"
        yield Finding("source", name, "warning", seen, advice)
    elif texts:
        yield Finding("source", name, "ok", "; ".join(texts[:_REMARKS]))


def check_vehicles(seen: Observation) -> Iterator[Finding]:
    """Yield findings on the addresses of all vehicles, or of the selected one."""
    vehicle = seen.vehicle
    arrived = seen.delays.keys()
    known = sorted(
        address for address in {*seen.alive, *arrived} if vehicle in (None, address.vehicle)
    )
    for address in known:
        yield from _check_address(seen, address, flows=address in arrived)
    yield from _check_reports(seen)
    if not seen.alive.complete:
        advice = "a vehicle may have over 1,000 publishers: the log names it; otherwise, try again"
        yield Finding("vehicle", "", "unknown", "not all streams are listed", advice)
    hidden = _hidden_addresses(seen, known)
    if arrived or seen.ages:  # otherwise this client may lack read permission
        for name in hidden:
            yield _explain_hidden(seen, name)
    flowing = [address for address in known if address in arrived]
    if flowing:
        vehicles = {address.vehicle for address in flowing}
        text = f"messages arrive; vehicles: {len(vehicles)}, topics: {len(flowing)}"
        yield Finding("vehicle", "", "ok", text)
    if not known and not hidden:
        yield _missing_vehicle(seen)


def _check_reports(seen: Observation) -> Iterator[Finding]:
    """Yield the faults of vehicles in the event reports of services."""
    for name, report in by_vehicle(seen.accounts).items():
        if seen.vehicle not in (None, name):
            continue
        current = report.vehicles[name]
        if current.severity == "info" or current.is_forgotten(report.now):
            continue
        since = format_since(current.since, report.now)
        text = f"{current.text[: limits.PEER_TEXT]}{since}"
        advice = f"see the events before it with 'nedbus why --vehicle {name}'"
        state: State = "warning"
        if current.severity == "bad":
            state = "wrong"
        yield Finding("vehicle", name, state, text, advice)


def _hidden_addresses(seen: Observation, known: Collection[Address]) -> list[str]:
    """Return the addresses that services report as published, although this client sees no publisher of them."""
    shown = set(map(str, known))
    hidden = list[str]()
    for name in _published(seen):
        vehicle, _, _ = name.partition("/")
        if name not in shown and seen.vehicle in (None, vehicle):
            hidden.append(name)
    return hidden


def _explain_hidden(seen: Observation, name: str) -> Finding:
    advice = "check that the router's access rules allow that service to write this vehicle (docs/security.md)"
    publishers = list_names(_publishers_of(seen, name))
    text = f"reported as published by {publishers}, but no message arrives"
    return Finding("vehicle", name, "wrong", text, advice)


def _missing_vehicle(seen: Observation) -> Finding:
    """Return the finding that the selected vehicle, or any, is not published."""
    vehicle = seen.vehicle
    advice = "start its source: 'nedbus serve --source ...'"
    if _has_source_findings(seen):
        advice = "see the findings on sources"
    elif seen.services:
        names = list_names(map(_name_of, seen.services))
        advice = f"no source of {names} receives it: check the name, or start its source there"
    others = sorted({address.vehicle for address in {*seen.alive, *seen.delays}})
    if others:
        advice = f"{advice}; published: {', '.join(others[: limits.SHOWN_NAMES])}"
    if vehicle is None:
        return Finding("vehicle", "", "warning", f"no vehicle found under {seen.prefix}/", advice)
    return Finding("vehicle", vehicle, "wrong", f"not found under {seen.prefix}/", advice)


def _has_source_findings(seen: Observation) -> bool:
    for source in seen.sources:
        for finding in _check_source(source):
            if finding.state != "ok":
                return True
    return False


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
    """Yield that a stream is silent, cannot be decoded, or has several publishers."""
    name = str(address)
    if not flows and _is_silent(seen, address):
        yield _explain_silence(seen, address)
    error = seen.errors.get(address)
    if error:
        advice = "check that nedbus publishes this key; a newer message layout needs a newer nedbus on this host"
        text = f"cannot decode a payload: {error[: limits.PEER_TEXT]}"
        yield Finding("vehicle", name, "wrong", text, advice)
    publishers = seen.alive[address]
    if publishers > 1:
        advice = "readers receive a mixture of their messages: stop all but one, or give each its own --vehicle"
        text = f"{publishers} publishers of this address"
        services = _publishers_of(seen, name)
        if services:
            text = f"{text}: {list_names(services)}"
        if services and publishers > len(services):
            others = publishers - len(services)
            text = f"{text}, and {others} that no service reports, such as a script"
        yield Finding("vehicle", name, "wrong", text, advice)


def _is_silent(seen: Observation, address: Address) -> bool:
    """Return whether the last message of a stream is older than its rate explains."""
    rate = get_topic(address.topic).rate
    if not rate:
        return False
    age = seen.ages.get(address)
    if age is None:
        age = seen.listened
    return age > _SILENT_PERIODS / rate


def _explain_silence(seen: Observation, address: Address) -> Finding:
    state: State = "wrong"
    age = seen.ages.get(address)
    if age is not None:
        last = f"its last message is {format_duration(age)} old"
    elif address in seen.ages:
        last = "its last message has no timestamp"
    else:
        last = "no message yet"
        state = "warning"  # topics of a replay may start later
    text = f"alive, but silent for {seen.listened:.0f} s: {last}"
    advice = "its publisher runs but sends nothing: check its input, such as a service's source or a script's loop"
    return Finding("vehicle", str(address), state, text, advice)


class _Offset(NamedTuple):
    """Offset of a clock from this host's, and its uncertainty [s]."""

    seconds: float
    error: float

    @property
    def is_wrong(self) -> bool:
        return abs(self.seconds) > _CLOCK_WARNING + self.error


def _clocks(seen: Observation) -> dict[str, _Offset]:
    """Return the clocks of services and publishers by name."""
    clocks = dict[str, _Offset]()
    for service in seen.services:
        # The comparison is false for NaN.
        if service.now is not None and abs(service.now) < _FAR_FUTURE:
            name = f"service {brief(service.service)} on {brief(service.host)}"
            clocks[name] = _Offset(service.now - seen.asked, seen.error)
    for address, delay in seen.delays.items():
        if delay is None:
            continue
        # A positive delay includes the network latency.
        if delay < 0:
            error = 0.0
        else:
            error = _CLOCK_WARNING
        clocks[f"publisher of {address}"] = _Offset(-delay, error)
    return clocks


def check_clocks(seen: Observation) -> Iterator[Finding]:
    """Yield findings on clocks that are off; if all others agree with each other, this host's clock is off."""
    clocks = _clocks(seen)
    off = {name: clock.seconds for name, clock in clocks.items() if clock.is_wrong}
    if clocks and not off:
        largest = max(abs(clock.seconds) for clock in clocks.values())
        text = f"all clocks agree with this host's within {format_duration(largest)}"
        yield Finding("clock", "", "ok", text)
        return
    are_all_off = len(off) == len(clocks)
    ordered = sorted(off.values())
    if len(off) > 1 and are_all_off and ordered[-1] - ordered[0] < _CLOCK_WARNING:
        middle = ordered[len(ordered) // 2]
        others = f"{len(off)} others, which agree with each other"
        yield _clock_finding("this host", "this host's clock", -middle, others, _SYNCHRONISE)
        return
    blame = "the other clocks agree with this host's; set this one:"
    if are_all_off:
        blame = "either clock may be off:"
    for name, offset in off.items():
        yield _clock_finding(name, "its clock", offset, "this host's", f"{blame} {_SYNCHRONISE}")


def _clock_finding(name: str, clock: str, offset: float, reference: str, advice: str) -> Finding:
    direction = "behind"
    if offset > 0:
        direction = "ahead of"
    text = f"{clock} is {format_duration(abs(offset))} {direction} {reference}"
    state: State = "warning"
    if abs(offset) > _CLOCK_WRONG:
        state = "wrong"
    return Finding("clock", name, state, text, advice)


def check_other_keys(seen: Observation) -> Iterator[Finding]:
    """Yield other prefixes and ROS 2 topics, which readers of this prefix do not receive."""
    prefixes = {prefix_of(key) for key in seen.elsewhere}
    for prefix in sorted(prefixes - {""})[:_OTHER_PREFIXES]:
        advice = f"use --prefix {prefix} or NEDBUS_PREFIX={prefix} to read them, or correct the publisher's prefix"
        text = f"messages are published under {prefix}/, but the prefix here is {seen.prefix}/"
        yield Finding("prefix", prefix, "warning", text, advice)
    is_bridged = any(source.source.startswith("px4-zenoh:") for source in seen.sources)
    if seen.ros2 and not is_bridged:
        topics = list_names(sorted({f"/{token.key.topic}" for token in seen.ros2}))
        text = f"ROS 2 or PX4 publishes {topics}, but no service bridges it"
        advice = "run 'nedbus serve --source px4-zenoh:' to bridge them"
        yield Finding("ros2", "", "warning", text, advice)


NETWORK_CHECKS: Final = (
    check_routers, check_permissions, check_services, check_vehicles, check_clocks, check_other_keys,
)  # fmt: skip
