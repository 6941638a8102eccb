"""The vehicles: which are alive and silent, published twice, not to be decoded, or not well as services tell."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from nedbus.events import merge_vehicles
from nedbus_msgs import Address, get_topic

from .finding import Finding, State, format_seconds
from .observation import Observation
from .services import reported

_MAX_TEXT: Final = 300  # characters of what a peer says
_PERIODS: Final = 3.0  # of a topic without a message, from which on it is silent


def check_vehicles(seen: Observation, vehicle: str | None, *, writes_only: bool) -> Iterator[Finding]:
    """Yield what is found of the addresses of all vehicles, or of one.

    `writes_only`: this client may write that vehicle at a router with certificates, and not read, perhaps.
    """
    arrived = {stream.address for stream in seen.streams.values() if stream.address is not None and stream.count}
    known = sorted({*seen.alive, *arrived})
    if vehicle is not None:
        known = [address for address in known if address.vehicle == vehicle]
    flowing = [address for address in known if address in arrived]
    for address in known:
        yield from _judge(seen, address, flows=address in arrived)
    yield from _check_states(seen, vehicle)
    hidden = sorted({each for service in seen.services for each in reported(service.status)} - set(map(str, known)))
    if vehicle is not None:
        hidden = [each for each in hidden if each.partition("/")[0] == vehicle]
    for each in hidden if seen.streams or seen.ages else ():  # else nothing at all may be read
        advice = "may that service write this vehicle? a router drops what its rules do not allow: docs/security.md"
        yield Finding("vehicle", each, "wrong", "a service says that it publishes it, and nothing arrives", advice)
    if flowing:
        vehicles = {address.vehicle for address in flowing}
        yield Finding("vehicle", "", "ok", f"messages arrive; vehicles: {len(vehicles)}, topics: {len(flowing)}")
    if not known and not hidden:
        blind = writes_only and not (seen.alive or seen.streams or seen.ages)
        yield _absent(seen, vehicle, blind=blind)


def _absent(seen: Observation, vehicle: str | None, *, blind: bool) -> Finding:
    if blind:
        advice = "a vehicle's certificate is for writing: look with that of a reader"
        return Finding("vehicle", vehicle or "", "unknown", "this client sees no vehicle at all", advice)
    advice = "start its source: 'nedbus serve --source ...'"
    if seen.services:
        advice = "a service answers: what is said of its sources is the reason, or they publish other vehicles"
    if vehicle is None:
        return Finding("vehicle", "", "warning", f"no vehicle is seen under {seen.prefix}/", advice)
    return Finding("vehicle", vehicle, "wrong", f"it is not seen under {seen.prefix}/", advice)


def _check_states(seen: Observation, vehicle: str | None) -> Iterator[Finding]:
    """Yield what services remember of vehicles that is bad, or to be watched."""
    for name, (now, told) in sorted(merge_vehicles(seen.accounts).items()):
        if vehicle not in (None, name) or told.severity == "info" or told.is_forgotten(now):
            continue
        state: State = "wrong" if told.severity == "bad" else "warning"
        advice = f"'nedbus why --vehicle {name}' says what preceded it"
        yield Finding("vehicle", name, state, f"{told.text[:_MAX_TEXT]}{told.since_text(now)}", advice)


def _judge(seen: Observation, address: Address, *, flows: bool) -> Iterator[Finding]:
    name, key = str(address), address.key(prefix=seen.prefix)
    stream = seen.streams.get(key)
    age, rate = seen.ages.get(address), get_topic(address.topic).rate
    if not flows and rate and (seen.listened if age is None else age) > _PERIODS / rate:
        last = "it has sent nothing yet" if address not in seen.ages else "its last message has no timestamp"
        if age is not None:
            last = f"its last message is {format_seconds(age)} old"
        advice = "its publisher runs: look at what it reads, the source of a service or the loop of a script"
        state: State = "wrong" if address in seen.ages else "warning"  # of a replay some begin later
        yield Finding("vehicle", name, state, f"alive, but silent for {seen.listened:.0f} s: {last}", advice)
    if stream is not None and stream.error:
        advice = "who publishes this key, and is it nedbus? a newer layout needs a newer nedbus here"
        yield Finding("vehicle", name, "wrong", f"a payload that cannot be decoded: {stream.error[:_MAX_TEXT]}", advice)
    beating = len(seen.publishers.get(key, ()))
    sending = max(len(stream.publishers), len(stream.clocks)) if stream is not None else 0
    if max(beating, sending) > 1:
        advice = "their messages alternate for every reader: give one of the two another --vehicle, or stop it"
        seen_text = f"{max(beating, sending)} publishers of this address"
        yield Finding("vehicle", name, "wrong", seen_text, advice)
