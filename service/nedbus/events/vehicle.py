"""One vehicle: the events of its messages, the conditions that hold now, and what precedes what."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, field, replace
from typing import Final

from nedbus_msgs import BY_TOPIC, DEFAULT_TOPIC, Address

from .detectors import ChangeDetector, Finding, make_detector
from .event import WINDOW, Condition, Event, State, explain, state_of, to_age
from .position import PositionDetector
from .rules import FLAPPING_CHANGES, MAX_BURST, MAX_SILENCE, OUTLIVING, PAUSE, RECENT, RULES

_REBOOT: Final = 1_000_000  # us that PX4's time goes back when a vehicle reboots; less is disorder
_MAX_AHEAD: Final = 1.0  # s that something may be ahead of a look; more is a clock that was set back
_MAX_RECENT: Final = 100
_MAX_STREAMS: Final = 1000  # that are followed; no peer can make it remember more
_MAX_TOPICS: Final = 20  # that an event names
_POSITIONS: Final = (DEFAULT_TOPIC, "external_ins_local_position", "estimator_local_position")  # the best first
_BEST_GPS: Final = "vehicle_gps_position"
_OF_GPS: Final = frozenset({"gps_fix_lost", "few_satellites", "jamming", "spoofing"})
_OF_POSITION: Final = frozenset(rule.kind for rule in RULES["VehicleLocalPosition"])


class Vehicle:
    """Follow one vehicle; `tell` gets each event as it happens, `common` has the conditions of all vehicles.

    `conditions`: those that hold now, by kind and flag. `initial`: those that held at its first messages.
    `messages`: the names of the messages that it has sent, each with a topic.
    `main`: the position that it is judged by: vehicle_local_position, or another estimate where there is none.
    `time`: of its last message that is looked at, by the account's clock; `boot`: the same since boot [s].
    `recent`: the last events, in which evidence is looked for.
    """

    def __init__(self, name: str, tell: Callable[[Event], None], common: Vehicle | None = None) -> None:
        self.name = name
        self.conditions: dict[tuple[str, str], Condition] = {}
        self.initial: list[Condition] = []
        self.messages: dict[str, str] = {}
        self.main: Address | None = None
        self.armed: bool | None = None
        self.time = 0.0
        self.boot: float | None = None
        self._tell = tell
        self._common = common
        self.recent: deque[Event] = deque(maxlen=_MAX_RECENT)
        self._detectors: dict[Address, ChangeDetector | None] = {}
        self._gps: Address | None = None
        self._main_time = math.inf  # of the last position
        self._rebooted = -math.inf
        self._changes: dict[tuple[str, tuple[str, ...]], deque[float]] = {}
        self._flapping: dict[tuple[str, tuple[str, ...]], tuple[Event, int]] = {}
        self._lost, self._rejected = _Burst(), _Burst()

    def add(self, address: Address, message: object, time: float, *, missing: frozenset[str], lost: int) -> None:
        """Add a message of this vehicle, with the number of messages that were lost before it."""
        if lost:
            self._lost.add(time, lost, address.stream)
        try:
            detector = self._detectors[address]
        except KeyError:
            if len(self._detectors) >= _MAX_STREAMS:
                return
            detector = self._detectors[address] = self._open(address)
        if detector is None:
            return
        before, earlier = detector.stamp, detector.earlier
        found = detector.add(message, missing)
        stamp = detector.stamp
        self.time, self.boot = time, stamp / 1e6
        if address == self.main:
            self._main_time = time
            if self.conditions:
                self._come_back(address, time)
        if stamp < before - _REBOOT and not 0 < earlier <= stamp + _REBOOT:  # else the one before was damaged
            self._reboot(before, time)
            found = detector.add(message, missing)
        for each in found or ():
            if each.kind in ("armed", "disarmed"):
                self.armed = each.kind == "armed"
            self.emit(each, address.topic, time)

    def reject(self, topic: str, reason: str, time: float) -> None:
        """Note that a message was rejected."""
        if not self._rejected.count:
            text = f"{topic} rejected: {reason}"
            self.emit(Finding("rejected", "begin", "watch", text, names=(topic, reason)), topic, time)
        self._rejected.add(time, 1, topic)

    def settle(self, time: float) -> None:
        """Tell losses, rejections and flapping that are over."""
        lost, rejected = self._lost, self._rejected
        if lost.is_over(time) or (lost.count and time - lost.begin > MAX_BURST):
            names = tuple(sorted(lost.topics))
            text = f"{lost.count} message{'s' * (lost.count > 1)} lost ({', '.join(names)})"
            self.emit(Finding("lost", "once", "watch", text, names, {"messages": lost.count}), "", lost.begin)
            self._lost = _Burst()
        if rejected.is_over(time):
            text = f"nothing rejected any more: {rejected.count} were"
            self.emit(Finding("rejected", "end", "info", text, numbers={"messages": rejected.count}), "", rejected.end)
            self._rejected = _Burst()
        for old in [key for key, times in self._changes.items() if time - times[-1] > WINDOW]:
            del self._changes[old]
        for key, (last, count) in list(self._flapping.items()):
            if not 0 <= time - last.time <= PAUSE:
                del self._flapping[key]
                self._keep(replace(last, text=f"{last.text}, the last of {count} changes that are not told"))

    def look(self, time: float, state: str | None, *, is_connected: bool) -> None:
        """Note how its position arrives now: its stream is "stale", "gone" or another; None where that is not known."""
        self.settle(time)
        silent = {"stale": "silent", "gone": "gone"}.get(state or "")
        if state is None and is_connected and time - self._main_time > MAX_SILENCE:
            silent = "silent"
        known = next((kind for kind in ("silent", "gone") if (kind, "") in self.conditions), None)
        if silent is None or known in (silent, "gone") or self.main is None:
            return
        since, stream = self._main_time, self.main.stream
        if known is not None:
            since = self.conditions.pop((known, "")).since
        age = max(0.0, time - since)
        text = f"silent: no {stream} for {age:.1f} s" if silent == "silent" else f"gone: no publisher of {stream}"
        self.emit(Finding(silent, "begin", "bad", text, numbers={"age": age}), stream, time, changed=since)

    def state(self, time: float) -> State:
        """Return its state now: what holds, what flaps, and what happened in the last minute."""
        once = [
            Condition(event.kind, event.severity, event.text, event.time, event)
            for event in reversed(self.recent)
            if event.change == "once" and time - RECENT < event.time <= time + _MAX_AHEAD
        ]
        held = {
            (each.kind, each.since): each
            for each in self.conditions.values()
            if each.on_ground != "info" or self.armed is not False
        }
        return state_of([*held.values(), *self._flapping_conditions({each.kind for each in held.values()}), *once])

    def emit(self, found: Finding, topic: str, time: float, *, changed: float | None = None) -> None:
        """Make an event of a finding, and begin or end its conditions; tell it, unless it held initially or flaps.

        `changed`: when its condition began or ended, where that is earlier than `time`.
        """
        changed = time if changed is None else changed
        severity, text, lasted = found.severity, found.text, None
        if found.on_ground is not None and self.armed is False and severity != "info":
            severity = found.on_ground
        if found.change == "end":
            held = [each for flag in found.flags if (each := self.conditions.pop((found.kind, flag), None)) is not None]
            known = [each.since for each in held if not each.initial]
            if known:
                lasted = max(0.0, changed - min(known))
                text = f"{text} after {to_age(lasted)}"
            elif found.first:
                text = found.first
        boot = None if self.boot is None else round(self.boot + time - self.time, 6)
        event = Event(
            self.name, found.kind, found.change, severity, text, time, boot, topic, found.numbers, found.names, lasted
        )
        if found.change == "begin":
            condition = Condition(found.kind, found.severity, text, changed, event, found.initial, found.on_ground)
            self.conditions.update(dict.fromkeys([(found.kind, flag) for flag in found.flags], condition))
            if found.initial and len(self.initial) < _MAX_RECENT:
                self.initial.append(condition)
        if not found.initial and not self._flaps(event):
            self._keep(event)

    def _open(self, address: Address) -> ChangeDetector | None:
        """Return the detector of a stream, None for one that tells nothing about its vehicle."""
        definition = BY_TOPIC.get(address.topic)
        name = definition.name if definition is not None else address.topic
        self.messages.setdefault(name, address.topic)
        if address.topic in _POSITIONS:
            if self.main is not None and _rank(self.main) <= _rank(address):
                return None
            self._replace(self.main, address, _OF_POSITION)
            self.main = address
            return PositionDetector()
        if address.instance:  # the other sensors, batteries and EKFs do not speak for the vehicle
            return None
        if name == "SensorGps":
            if self._gps is not None and self._gps.topic == _BEST_GPS:
                return None
            self._replace(self._gps, address, _OF_GPS)
            self._gps = address
        return make_detector(name)

    def _replace(self, old: Address | None, new: Address, kinds: Collection[str]) -> None:
        """End the conditions of a stream that speaks for the vehicle no more, as a better one does."""
        if old is None:
            return
        self._detectors[old] = None
        held: dict[Condition, list[str]] = {}
        for (kind, flag), each in self.conditions.items():
            if kind in kinds:
                held.setdefault(each, []).append(flag)
        for each, flags in held.items():
            text = f"{each.text}: over, {new.stream} tells from now on"
            names = each.begin.names
            ended = Finding(each.kind, "end", "info", text, names, flags=tuple(flags), initial=each.initial)
            self.emit(ended, new.topic, self.time)

    def _reboot(self, before: int, time: float) -> None:
        """Forget what was known before a reboot; tell of it once, though late messages from before may follow it."""
        for detector in filter(None, self._detectors.values()):
            detector.forget()
        self.conditions = {key: each for key, each in self.conditions.items() if key[0] in OUTLIVING}
        self.armed = None
        last, self._rebooted = self._rebooted, time
        if time - last >= PAUSE:
            text = f"rebooted: {self.boot or 0.0:.1f} s since boot, {before / 1e6:.1f} s before"
            self.emit(Finding("reboot", "once", "bad", text, numbers={"before": before / 1e6}), "", time)

    def _come_back(self, main: Address, time: float) -> None:
        for kind in ("silent", "gone"):
            if (kind, "") in self.conditions:
                self.emit(Finding(kind, "end", "info", f"{main.stream} is back"), main.topic, time)

    def _keep(self, event: Event) -> None:
        recent, conditions = list(self.recent), list(self.conditions.values())
        if self._common is not None:
            recent, conditions = [*self._common.recent, *recent], [*conditions, *self._common.conditions.values()]
        self.recent.append(event)
        held = [each for each in conditions if each.begin is not event]
        self._tell(replace(event, evidence=tuple(explain(event, recent, held))))

    def _flaps(self, event: Event) -> bool:
        """Return whether a condition changes too fast to be told; its last change is told when it has settled."""
        if event.change == "once":
            return False
        key = event.kind, event.names
        times = self._changes.setdefault(key, deque(maxlen=FLAPPING_CHANGES))
        is_fast = len(times) == FLAPPING_CHANGES and event.time - times[0] < WINDOW
        times.append(event.time)
        if is_fast:
            _, count = self._flapping.get(key, (event, 0))
            self._flapping[key] = event, count + 1
        return is_fast

    def _flapping_conditions(self, held: Collection[str]) -> Iterator[Condition]:
        """Yield the flapping conditions that do not hold at this moment."""
        for kind, names in self._flapping:
            told = (each for each in reversed(self.recent) if each.change == "begin" and each.severity != "info")
            begin = next((each for each in told if (each.kind, each.names) == (kind, names)), None)
            if begin is not None and kind not in held:
                yield Condition(kind, begin.severity, f"{begin.text} again and again", begin.time, begin)


@dataclass(slots=True)
class _Burst:
    """Losses or rejections in a row, which are told once."""

    begin: float = 0.0
    end: float = 0.0
    count: int = 0
    topics: set[str] = field(default_factory=set)

    def add(self, time: float, count: int, topic: str) -> None:
        self.begin = self.begin if self.count else time
        self.end, self.count = time, self.count + count
        if len(self.topics) < _MAX_TOPICS:
            self.topics.add(topic)

    def is_over(self, time: float) -> bool:
        return self.count > 0 and not -_MAX_AHEAD <= time - self.end <= PAUSE


def _rank(position: Address) -> tuple[int, int]:
    return _POSITIONS.index(position.topic), position.instance or 0
