"""The events of one vehicle: what its messages mean, what holds now, and what precedes what."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import replace
from typing import Final

from nedbus_msgs import BY_TOPIC, DEFAULT_TOPIC, Address

from .event import KINDS, WINDOW, Condition, Event, Severity, State, state_of, to_age
from .judges import make_watch
from .rules import RULES
from .watches import REBOOT, Finding, PositionWatch, Watch

RECENT: Final = 60.0
"""Seconds for which something that happened once is a reason to watch a vehicle."""

SILENT: Final = 3.0
"""Seconds without a position after which a vehicle is silent, where nothing better is known of its stream."""

OUTLIVING: Final = ("silent", "gone", "rejected")
"""Conditions that a reboot does not end."""

_AHEAD: Final = 1.0  # s that something may be ahead of a look; more is a clock that was set back
_REMEMBERED: Final = 100  # events in which evidence is looked for
_MAX_STREAMS: Final = 1000  # that are followed; no peer can make it remember more
_MAX_TOPICS: Final = 20  # that an event names
_PAUSE: Final = 5.0  # s without another one after which what was lost, or rejected, is told as one event
_POSITIONS: Final = (DEFAULT_TOPIC, "external_ins_local_position", "estimator_local_position")
_SILENCE: Final = ("silent", "gone")
_BEST_GPS: Final = "vehicle_gps_position"
_LONG: Final = 20.0  # s after which what is lost is told, though more may be
_FLAPS: Final = 4  # changes within WINDOW from which on further ones are told when they end
_CORRECTIONS: Final = ("reset", "jump", "origin_set", "origin_moved")


class Vehicle:
    """Follow one vehicle; `tell` gets each event as it happens, `common` returns what holds for all vehicles.

    `conditions`: what holds now, by kind and flag. `initial`: what held at its first messages.
    `messages`: the names of the messages that it has sent, each with a topic.
    `main`: the position that it is judged by: vehicle_local_position, or another estimate where there is none.
    `time`: of its last message that is looked at, by the account's clock; `boot`: the same since boot [s].
    """

    def __init__(
        self, name: str, tell: Callable[[Event], None], common: Callable[[], Iterable[Condition]] = tuple
    ) -> None:
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
        self._recent: deque[Event] = deque(maxlen=_REMEMBERED)
        self._watches: dict[Address, Watch | PositionWatch | None] = {}
        self._gps: Address | None = None
        self._main_time: float | None = None
        self._booted = -math.inf
        self._changes: dict[tuple[str, tuple[str, ...]], deque[float]] = {}
        self._flapping: dict[tuple[str, tuple[str, ...]], tuple[Event, int]] = {}
        self._lost = _Burst()
        self._rejected = _Burst()

    def add(self, address: Address, message: object, time: float, *, missing: frozenset[str], lost: int) -> None:
        """Add a message of this vehicle, with how many were lost before it."""
        if lost:
            self._lost.add(time, lost, address.stream)
        try:
            watch = self._watches[address]
        except KeyError:
            if len(self._watches) >= _MAX_STREAMS:
                return
            watch = self._watches[address] = self._open(address)
        if watch is None:
            return
        before, earlier = watch.stamp, watch.earlier
        found = watch.add(message, missing)
        stamp = watch.stamp
        self.time, self.boot = time, stamp / 1e6
        if address == self.main:
            self._main_time = time
            if self.conditions:
                self._come_back(time)
        if stamp < before - REBOOT and not 0 < earlier <= stamp + REBOOT:  # else the one before was damaged
            self._reboot(before, time)
            found = watch.add(message, missing)
        if found is not None:
            for each in found:
                self._judge(each, address, time)

    def reject(self, topic: str, reason: str, time: float) -> None:
        """Note that a message was rejected."""
        if not self._rejected.count:
            self._emit(
                Finding("rejected", "begin", "watch", f"{topic} rejected: {reason}", names=(topic, reason)), topic, time
            )
        self._rejected.add(time, 1, topic)

    def settle(self, time: float) -> None:
        """Tell what was lost, rejected, or went to and fro, and does so no more."""
        if self._lost.is_over(time) or self._lost.is_long(time):
            burst = self._lost
            text = f"{burst.count} message{'s' * (burst.count > 1)} lost ({', '.join(sorted(burst.topics))})"
            names, numbers = tuple(sorted(burst.topics)), {"messages": burst.count}
            self._emit(Finding("lost", "once", "watch", text, names, numbers), "", burst.begin)
            burst.clear()
        if self._rejected.is_over(time):
            burst = self._rejected
            text = f"nothing rejected any more: {burst.count} were"
            self._emit(Finding("rejected", "end", "info", text, numbers={"messages": burst.count}), "", burst.end)
            burst.clear()
        for old in [key for key, times in self._changes.items() if time - times[-1] > WINDOW]:
            del self._changes[old]
        for key, (last, count) in list(self._flapping.items()):
            if not 0 <= time - last.time <= _PAUSE:
                del self._flapping[key]
                self._keep(replace(last, text=f"{last.text}, the last of {count} changes that are not told"))

    def look(self, time: float, *, silent: str | None) -> None:
        """Note how its position arrives now: `silent` is None while it does, else "silent" or "gone"."""
        self.settle(time)
        known = next((kind for kind in _SILENCE if (kind, "") in self.conditions), None)
        if silent is None or known in (silent, "gone") or self.main is None:
            return
        since = self._main_time if self._main_time is not None else time
        if known is not None:
            since = self.conditions.pop((known, "")).since
        self._fall_silent(silent, time, since)

    def note(self, event: Event) -> None:
        """Note an event that concerns all vehicles, and may explain what happens to this one."""
        self._recent.append(event)

    def silence(self, time: float) -> float:
        """Return the seconds since its last position; 0 before the first one."""
        return 0.0 if self._main_time is None else time - self._main_time

    def state(self, time: float) -> State:
        """Return its state now: what holds, what goes to and fro, and what happened in the last minute."""
        once = [
            Condition(event.kind, event.severity, event.text, event.time, event)
            for event in reversed(self._recent)
            if event.change == "once" and time - RECENT < event.time <= time + _AHEAD
        ]
        held = {
            (each.kind, each.since): each
            for each in self.conditions.values()
            if each.on_ground != "info" or self.armed is not False
        }
        return state_of([*held.values(), *self._on_and_off({each.kind for each in held.values()}), *once])

    def _on_and_off(self, held: Collection[str]) -> Iterator[Condition]:
        """Yield what begins and ends all the time, and does not hold at this moment."""
        for kind, names in self._flapping:
            told = (each for each in reversed(self._recent) if each.change == "begin" and each.severity != "info")
            begin = next((each for each in told if (each.kind, each.names) == (kind, names)), None)
            if begin is not None and kind not in held:
                yield Condition(kind, begin.severity, f"{begin.text} again and again", begin.time, begin)

    def _open(self, address: Address) -> Watch | PositionWatch | None:
        """Return what follows a stream, None for one that tells nothing about its vehicle."""
        definition = BY_TOPIC.get(address.topic)
        name = definition.name if definition is not None else address.topic
        self.messages.setdefault(name, address.topic)
        if address.topic in _POSITIONS:
            rank = _POSITIONS.index(address.topic), address.instance or 0
            if self.main is not None and (_POSITIONS.index(self.main.topic), self.main.instance or 0) <= rank:
                return None
            if self.main is not None:  # this one speaks for the vehicle from now on
                self._watches[self.main] = None
                self._close(_OF_POSITION, address)
            self.main = address
            return PositionWatch()
        if address.instance:  # the other sensors, batteries and EKFs do not speak for the vehicle
            return None
        if name == "SensorGps":
            if self._gps is not None and self._gps.topic == _BEST_GPS:
                return None
            if self._gps is not None:
                self._watches[self._gps] = None
                self._close(_OF_GPS, address)
            self._gps = address
        return make_watch(name)

    def _judge(self, found: Finding, address: Address, time: float) -> None:
        if found.kind in ("armed", "disarmed"):
            self.armed = found.kind == "armed"
        elif found.initial and found.change == "once":
            return
        self._emit(found, address.topic, time)

    def _reboot(self, before: int, time: float) -> None:
        """Forget what was known before a reboot; tell of it once, though late messages from before may follow it."""
        for watch in self._watches.values():
            if watch is not None:
                watch.forget()
        self._drop(lambda kind: kind not in OUTLIVING)
        self.armed = None
        booted, self._booted = self._booted, time
        if time - booted < _PAUSE:
            return
        boot = self.boot or 0.0
        text = f"rebooted: {boot:.1f} s since boot, {before / 1e6:.1f} s before"
        self._emit(Finding("reboot", "once", "bad", text, numbers={"before": before / 1e6}), "", time)

    def _come_back(self, time: float) -> None:
        for kind in _SILENCE:
            if (kind, "") in self.conditions and self.main is not None:
                self._emit(Finding(kind, "end", "info", f"{self.main.stream} is back"), self.main.topic, time)

    def _fall_silent(self, kind: str, time: float, since: float) -> None:
        stream = self.main.stream if self.main is not None else ""
        age = max(0.0, time - since)
        text = f"silent: no {stream} for {age:.1f} s" if kind == "silent" else f"gone: nobody publishes {stream}"
        self._emit(Finding(kind, "begin", "bad", text, numbers={"age": age}), stream, time, since=since)

    def _close(self, kinds: Collection[str], address: Address) -> None:
        """End what held by a stream that speaks for the vehicle no more."""
        held = {id(each): each for (kind, _), each in self.conditions.items() if kind in kinds}
        for each in held.values():
            flags = tuple(flag for (kind, flag), other in self.conditions.items() if other is each)
            text = f"{each.text}: over, {address.stream} tells from now on"
            ended = Finding(each.kind, "end", "info", text, each.begin.names, flags=flags, initial=each.initial)
            self._emit(ended, address.topic, self.time)

    def _drop(self, which: Callable[[str], bool]) -> None:
        for key in [key for key in self.conditions if which(key[0])]:
            del self.conditions[key]

    def _emit(self, found: Finding, topic: str, time: float, *, since: float | None = None) -> None:
        severity: Severity = found.severity
        if found.on_ground is not None and self.armed is False and severity != "info":
            severity = found.on_ground
        text, lasted = found.text, None
        if found.change == "end":
            held = [each for flag in found.flags if (each := self.conditions.pop((found.kind, flag), None)) is not None]
            known = [each.since for each in held if not each.initial]
            if known:
                lasted = max(0.0, time - min(known))
                text = f"{text} after {to_age(lasted)}"
            elif found.first:
                text = found.first
        event = Event(
            self.name, found.kind, found.change, severity, text, time, self._boot_at(time), topic, found.numbers,
            found.names, lasted,
        )  # fmt: skip
        if found.change == "begin":
            begin = time if since is None else since
            condition = Condition(found.kind, found.severity, text, begin, event, found.initial, found.on_ground)
            self.conditions.update({(found.kind, flag): condition for flag in found.flags})
            if found.initial and len(self.initial) < _REMEMBERED:
                self.initial.append(condition)
        if not found.initial and not self._flaps(event):
            self._keep(event)

    def _keep(self, event: Event) -> None:
        held = [each for each in (*self.conditions.values(), *self._common()) if each.begin is not event]
        self._recent.append(event)
        self._tell(replace(event, evidence=tuple(explain(event, self._recent, held))))

    def _boot_at(self, time: float) -> float | None:
        return None if self.boot is None else round(self.boot + time - self.time, 6)

    def _flaps(self, event: Event) -> bool:
        """Return whether this goes to and fro, faster than anybody wants to be told; its end is told then."""
        if event.change == "once":
            return False
        times = self._changes.setdefault((event.kind, event.names), deque(maxlen=_FLAPS))
        is_fast = len(times) == _FLAPS and event.time - times[0] < WINDOW
        times.append(event.time)
        if is_fast:
            count = self._flapping[event.kind, event.names][1] + 1 if (event.kind, event.names) in self._flapping else 1
            self._flapping[event.kind, event.names] = event, count
        return is_fast


class _Burst:
    """Things that happen in a row, and are told once."""

    def __init__(self) -> None:
        self.begin = self.end = 0.0
        self.count = 0
        self.topics: set[str] = set()

    def add(self, time: float, count: int, topic: str) -> None:
        """Add some more."""
        self.begin = time if not self.count else self.begin
        self.end, self.count = time, self.count + count
        if len(self.topics) < _MAX_TOPICS:
            self.topics.add(topic)

    def is_over(self, time: float) -> bool:
        """Return whether there was one, and none for a while."""
        return self.count > 0 and not -_AHEAD <= time - self.end <= _PAUSE

    def is_long(self, time: float) -> bool:
        """Return whether it goes on for so long that its end is not waited for."""
        return self.count > 0 and time - self.begin > _LONG

    def clear(self) -> None:
        """Begin anew: it is told."""
        self.count = 0
        self.topics.clear()


def explain(event: Event, before: Iterable[Event], conditions: Iterable[Condition] = ()) -> list[Event]:
    """Return the events that may explain one, the last of each kind: at most WINDOW before it, or begun and going on.

    What begins is explained by what went wrong, what ends by what ended; a correction of the estimate by either.
    """
    kinds, latest = KINDS[event.kind], {}
    unwanted = "begin" if event.change == "end" else "end" if event.kind not in _CORRECTIONS else ""
    for each in before:
        is_bad = each.severity != "info" or event.change == "end" or event.kind in _CORRECTIONS
        is_near = event.time - WINDOW <= each.time <= event.time
        is_link = each.kind == "link_down"  # what was lost is seen when the link is back
        if each is not event and each.kind in kinds and is_near and (is_link or (is_bad and each.change != unwanted)):
            latest[each.kind] = each
    for condition in conditions:
        is_before = condition.begin.time <= event.time  # an event may be told late
        if condition.kind in kinds and condition.severity != "info" and event.change != "end" and is_before:
            latest.setdefault(condition.kind, condition.begin)
    return sorted(latest.values(), key=lambda each: each.time)


_OF_GPS: Final = frozenset({"gps_fix_lost", "few_satellites", "jamming", "spoofing"})
_OF_POSITION: Final = frozenset(rule.kind for rule in RULES["VehicleLocalPosition"])
