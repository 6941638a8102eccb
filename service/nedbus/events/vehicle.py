"""State of one vehicle: detectors for its streams, active conditions and recent events."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import median
from typing import Final

from nedbus.timeline import is_boot_possible
from nedbus_msgs import BY_TOPIC, Address, FieldReader

from . import detectors, rules
from .contradictions import REFERENCES, Comparison, ReferenceDetector
from .detectors import ChangeDetector, Fields, Finding
from .event import ALONE, WINDOW, Condition, Event, State, explain, state_of, without_wild
from .kinds import KINDS
from .position import PositionDetector
from .times import format_duration

_EKF: Final = "estimator_status_flags"
_REBOOT: Final = 1_000_000  # us; a larger step back in time is a reboot, a smaller one is reordering
_MAX_PAUSE: Final = 2_000_000  # us between positions, after which missing EVIDENCE is timed anew
_REPLACED: Final = 1_000_000  # us for another topic to replace missing EVIDENCE, such as sensor_gps
_MIN_STEPS: Final = 3  # intervals until the usual one of EVIDENCE is known
_INTERVALS: Final = 3  # usual intervals after which EVIDENCE is late
_MAX_RECENT: Final = 100
_MAX_STREAMS: Final = 1000  # per vehicle; bounds the memory that a peer can use
_MAX_TOPICS: Final = 20  # named in one event
# Groups of topics in order of preference; conditions come from the best one received.
_GROUPS: Final = (rules.POSITIONS, rules.EVIDENCE["GPS"])
_EVIDENCE_OF: Final = {topic: name for name, topics in rules.EVIDENCE.items() for topic in topics}
_SAMPLE: Final = ("timestamp_sample", "x", "y", "z")  # compared to find the primary EKF
_read_sample: Final = FieldReader(_SAMPLE)
_NEW: Final = ChangeDetector((), (), lambda _, __: iter(()))  # in place of the detector of a new stream


class Vehicle:
    """Events and conditions of one vehicle.

    `on_event`: callback for each event. `common`: pseudo-vehicle whose conditions concern all vehicles.

    `conditions`: active conditions by kind and flag. `initial`: conditions active in the first messages.
    `topics`: published topics. `main`: address of the position estimate in use, vehicle_local_position if published.
    `last_seen`: time of the last message on the event log's clock [s], or of the last update with a live publisher.
    `time`: time of the last message with a detector [s]. `boot`: the time since boot in it [s].
    `recent`: recent events, searched for evidence.
    """

    def __init__(self, name: str, on_event: Callable[[Event], None], common: Vehicle | None = None) -> None:
        self.name = name
        self.conditions: dict[tuple[str, str], Condition] = {}
        self.initial: list[Condition] = []
        self._on_ground: dict[tuple[str, str], Condition] = {}  # from the first messages; take effect once armed
        self._armed_at = math.inf
        self.topics: set[str] = set()
        self.main: Address | None = None
        self.armed: bool | None = None
        self.time = self.last_seen = 0.0
        self.boot: float | None = None
        self._before = -math.inf  # time of the message before the last one in its stream
        self._is_off = False  # the last time since boot was not the expected one
        self._on_event = on_event
        self._common = common
        self.recent: deque[Event] = deque(maxlen=_MAX_RECENT)
        self._detectors: dict[Address, ChangeDetector | None] = {}
        self._preferred: dict[tuple[str, ...], Address] = {}  # the stream in use, by group
        self._main_time = math.inf  # time of the last position
        self._rebooted = -math.inf
        self._suspect: _Suspect | None = None
        self._changes: dict[tuple[str, tuple[str, ...] | None], deque[Event]] = {}  # by condition, and by kind
        self._suppressed: Counter[tuple[str, tuple[str, ...] | None]] = Counter()  # changes of flapping conditions
        self._bursts: dict[str, _Burst] = {}  # lost and rejected messages and dropouts [ms], by kind
        self._ekf = 0  # instance of the primary EKF
        self._position: PositionDetector | None = None  # of `main`
        self._comparison = Comparison(lambda: self._position)
        self._supplies: dict[str, _Supply] = {}  # by key of EVIDENCE
        self._checked = self._resumed = 0  # time of the last position then, and after its last pause [us since boot]
        self._equal: dict[int, bool] = {}  # by EKF: whether its estimate equals the vehicle's

    def skips(self, address: Address, time: float) -> bool:
        """Note that a message without a loss before it has arrived; return whether `add` would do no more than that."""
        self.last_seen = time
        detector = self._detectors.get(address, _NEW)
        return detector is None or time < detector.due

    def add(self, address: Address, message: object, time: float, missing: frozenset[str], lost: int) -> None:
        """Add a message; `lost`: number of messages lost before it."""
        self.last_seen = time
        if lost:
            self._count("lost", time, lost, address.stream)
        try:
            detector = self._detectors[address]
        except KeyError:
            if len(self._detectors) >= _MAX_STREAMS:
                return
            detector = self._detectors[address] = self._open(address)
        if detector is None or time < detector.due:
            return
        if detector.pause:
            detector.due = time + detector.pause
        self._before, detector.time = detector.time, time
        before, earlier = detector.stamp, detector.earlier
        found = detector.add(message, missing)
        stamp = detector.stamp
        is_queued = type(detector) is detectors.TextDetector  # a log may begin with old texts
        elapsed = time - self.time
        self._set_boot(stamp / 1e6, time, is_queued=is_queued)
        if type(detector) is PositionDetector:  # of `main`
            self._main_time = time
            for kind in ("silent", "gone") if self.conditions else ():
                if (kind, "") in self.conditions:
                    self.emit(Finding(kind, "end", f"{address.stream} resumed"), address.topic, time)
        if not is_queued and (stamp < before - _REBOOT or self._suspect is not None):
            suspect = _Suspect(address, before, [*(found or ())])
            known = self._check_reboot(suspect, stamp, earlier, time, elapsed)
            found = detector.add(message, missing) if known is None else iter(known)
        self._emit_all(found or (), address, time)

    def add_dropout(self, seconds: float, time: float) -> None:
        """Record a logging dropout that starts at `time`; it does not count as silence of the vehicle."""
        self.last_seen = time
        self._count("dropout", time, round(1e3 * seconds))
        self._main_time = max(self._main_time, time + seconds)

    def reject(self, topic: str, reason: str, time: float) -> None:
        """Record a rejected message."""
        self.last_seen = time
        if "rejected" not in self._bursts:
            self.emit(Finding("rejected", "begin", f"{topic} rejected: {reason}", names=(topic, reason)), topic, time)
        self._count("rejected", time, 1, topic)

    def settle(self, time: float) -> None:
        """Report bursts and flapping that have ended; activate initial conditions once armed for PAUSE."""
        for kind, burst in list(self._bursts.items()):
            if time - burst.end <= rules.PAUSE and (kind != "lost" or time - burst.begin <= rules.MAX_BURST):
                continue
            del self._bursts[kind]
            messages, numbers = f"{burst.count} message{'s' * (burst.count > 1)}", {"messages": burst.count}
            if kind == "lost":
                names = tuple(sorted(burst.topics))
                text = f"{messages} lost ({', '.join(names)})"
                self.emit(Finding(kind, "once", text, names, numbers), "", burst.begin)
            elif kind == "rejected":
                self.emit(Finding(kind, "end", f"rejections stopped ({messages})", (), numbers), "", burst.end)
            else:
                duration = burst.count / 1e3
                text = f"logging dropout of {format_duration(duration)}"
                self.emit(Finding(kind, "once", text, numbers={"duration": duration}), "", burst.begin)
        if self._on_ground and time - self._armed_at >= rules.PAUSE:
            self.conditions |= self._on_ground
            self.initial += [*dict.fromkeys(self._on_ground.values())][: _MAX_RECENT - len(self.initial)]
            self._on_ground.clear()
        for key, events in list(self._changes.items()):
            last = events[-1]
            if key in self._suppressed and time - last.time > rules.PAUSE:
                count = self._suppressed.pop(key)
                self._report(replace(last, text=f"{last.text}, the last of {count} suppressed changes"))
            if time - last.time > WINDOW:
                del self._changes[key]

    def update(self, time: float, state: str | None, *, is_connected: bool) -> None:
        """Update from the state of the position stream ("stale", "gone", "duplicate", ...), None if not observed."""
        self.settle(time)
        self._check_supplies()
        if self.main is not None and state not in (None, "unknown"):
            stream = self.main.stream
            several = f"several publishers of {stream}: readers receive a mixture of their messages"
            begin = Finding("duplicate", "begin", several, switch=True)
            end = Finding("duplicate", "end", f"only one publisher of {stream} left", switch=True)
            self.emit(begin if state == "duplicate" else end, stream, time)
        silent = {"stale": "silent", "gone": "gone"}.get(state or "")
        if state is None and is_connected and time - self._main_time > rules.MAX_SILENCE:
            silent = "silent"
        if silent is None or self.main is None or {(silent, ""), ("gone", "")} & self.conditions.keys():
            return
        known = self.conditions.pop(("silent", ""), None)
        since, stream = known.since if known is not None else self._main_time, self.main.stream
        age = max(0.0, time - since)
        text = f"silent: no {stream} for {age:.1f} s" if silent == "silent" else f"gone: no publisher of {stream}"
        self.emit(Finding(silent, "begin", text, numbers={"age": age}), stream, time, changed=since)

    def _check_supplies(self) -> None:
        """Report EVIDENCE whose messages stopped while positions arrive, and those that resumed, by PX4's time."""
        if self._position is None:
            return
        now, silent, resumed = min(self._position.stamp, self._position.earlier), dict[str, int](), list[str]()
        if not 0 <= now - self._checked <= _MAX_PAUSE:  # positions resume: other messages may follow them
            self._resumed = now
        self._checked = now
        for name, supply in self._supplies.items():
            newest, limit = supply.update()
            age, was_late = now - max(newest, self._resumed) if newest else 0, supply.is_late
            supply.is_late = age > limit
            if ("no_messages", name) in self.conditions:
                resumed += [name] * (not supply.is_late)
            elif supply.is_late and not was_late:  # another topic may replace it
                self._detectors = {each: found for each, found in self._detectors.items() if found}
            elif age > limit + _REPLACED:
                silent[name] = newest
        since = self._main_time - (now - min(silent.values(), default=now)) / 1e6
        changes: dict[detectors.Change, Collection[str]] = {"begin": silent, "end": resumed}
        for change, names in changes.items():
            if names:
                text = getattr(KINDS["no_messages"], change).format(", ".join(names))
                time = self._main_time if change == "end" else since
                self.emit(Finding("no_messages", change, text, tuple(names)), "", time)

    def state(self, time: float) -> State:
        """Return the current state, set by active and flapping conditions and single events of the last minute."""
        is_flying = self.armed is not False
        found = [each for each in self.conditions.values() if is_flying or KINDS[each.kind].on_ground != "info"]
        kinds = {each.kind for each in found}
        for event in reversed(without_wild(self.recent)):
            if event.change == "once" and time - rules.RECENT < event.time:
                found.append(Condition(event.kind, event.severity, event.text, event.time, event))
                continue
            keys = {(event.kind, event.names), (event.kind, None)}
            if event.change == "begin" and event.kind not in kinds and not keys.isdisjoint(self._suppressed):
                kinds.add(event.kind)
                found.append(Condition(event.kind, event.severity, f"{event.text} (flapping)", event.time, event))
        return state_of(dict.fromkeys(found))  # a condition with several flags appears once

    def emit(self, found: Finding, topic: str, time: float, *, changed: float | None = None) -> None:
        """Begin or end the conditions of a finding; report its event unless it is initial or flapping.

        `changed`: time when the condition began or ended, if earlier than `time`.
        """
        changed = time if changed is None else changed
        kind, text, lasted = KINDS[found.kind], found.text, None
        in_air = found.severity or ("info" if found.change == "end" else kind.severity)
        is_on_ground = kind.on_ground is not None and self.armed is False and in_air != "info"
        severity = (kind.on_ground if is_on_ground else None) or in_air
        keys = [(found.kind, flag) for flag in kind.conditions(found.names)]
        if found.switch and (found.change == "begin") == (keys[0] in self.conditions):
            return
        for key in keys:
            self._on_ground.pop(key, None)
        held = {key: self.conditions[key] for key in keys if key in self.conditions}
        if found.change == "end":
            for key in held:
                del self.conditions[key]
            if known := [each.since for each in held.values() if not each.initial]:
                lasted = max(0.0, changed - min(known))
                text = f"{text} after {format_duration(lasted)}"
            elif kind.first:
                text = kind.first
        boot = None if self.boot is None else round(self.boot + time - self.time, 6)
        is_alone = any(each.begin.time == self._before and not each.initial for each in held.values())
        is_alone &= kind.message in rules.PERIODIC and time - self._before <= rules.MAX_ALONE
        marks = {"armed": self.armed and found.kind == "text", ALONE: is_alone}
        numbers = {**found.numbers, **{name: 1 for name, is_set in marks.items() if is_set}}
        event = Event(
            self.name, found.kind, found.change, severity, text, time, boot, topic, numbers, found.names, lasted
        )
        if found.change == "begin":
            condition = Condition(found.kind, in_air, text, changed, event, found.initial)
            is_waiting = found.initial and kind.once_armed
            (self._on_ground if is_waiting else self.conditions).update(dict.fromkeys(keys, condition))
            if found.initial and not is_waiting and len(self.initial) < _MAX_RECENT:
                self.initial.append(condition)
        if not found.initial and not self._is_flapping(event):
            self._report(event)

    @property
    def unknown(self) -> tuple[str, ...]:
        """Flags that the position estimate in use does not provide."""
        return () if self._position is None else self._position.unknown

    @property
    def held_from_start(self) -> str:
        """Bad and watch conditions active since the first message, as text; "" if none."""
        held = [each.text for each in self.conditions.values() if each.initial and each.severity != "info"]
        return ", ".join(dict.fromkeys(held))

    def _count(self, kind: str, time: float, count: int, topic: str = "") -> None:
        burst = self._bursts.setdefault(kind, _Burst(time, time))
        burst.end, burst.count = time, burst.count + count
        if len(burst.topics) < _MAX_TOPICS:
            burst.topics.add(topic)

    def _open(self, address: Address) -> ChangeDetector | None:
        """Return a detector for a new stream; None if it has no events, or a preferred stream is in use."""
        if len(self.topics) < _MAX_STREAMS:  # streams without events may be opened again
            self.topics.add(address.topic)
        topic, instance = address.topic, address.instance or 0
        if topic == detectors.EKF_SELECTOR:
            unused = [each for each in self._detectors if each.topic == rules.POSITIONS[-1] and each != self.main]
            self._detectors |= dict.fromkeys(unused)
            return ChangeDetector(["primary_instance"], (), detectors.detect_selection)
        if instance and topic not in (*rules.POSITIONS, _EKF):  # only the first instance of sensors and batteries
            return None
        group = next((each for each in _GROUPS if topic in each), ())
        if group:
            current = self._preferred.setdefault(group, address)
            best = min(current, address, key=lambda each: (group.index(each.topic), each.instance or 0))
            supply = self._supplies.get(_EVIDENCE_OF.get(topic, ""))
            if best != address and not (supply and supply.is_late):
                is_sought = topic == rules.POSITIONS[-1] != current.topic and detectors.EKF_SELECTOR not in self.topics
                detect = partial(self._detect_equal, instance)
                return ChangeDetector(_SAMPLE, (), detect) if is_sought else None
            if current != address:  # reopen unused streams, and end conditions of the old one
                self._preferred[group], message = address, BY_TOPIC[topic].name
                self._detectors = {each: found for each, found in self._detectors.items() if found and each != current}
                self._end(address, lambda kind, _: KINDS[kind].message == message)
        if group is rules.POSITIONS:
            self.main, self._position = address, PositionDetector()
            return self._position
        own = detectors.detection_of(BY_TOPIC[topic].name) if topic in BY_TOPIC else None
        if own is not None and topic == _EKF:
            own = *own[:2], partial(self._detect_flags, instance, own[2])
        kind = detectors.TextDetector if topic == "log_message" else ChangeDetector
        is_reference = topic in REFERENCES
        found = ReferenceDetector(topic, self._comparison, own) if is_reference else kind(*own) if own else None
        if found is not None and topic in _EVIDENCE_OF:
            self._supplies.setdefault(_EVIDENCE_OF[topic], _Supply()).detectors[address] = found
        return found

    def _detect_flags(self, instance: int, detect: detectors.Detect, *both: Fields) -> Iterator[Finding]:
        return detect(*both) if instance == self._ekf else detectors.detect_unused(instance, *both)

    def _detect_equal(self, instance: int, before: Fields, _: Fields) -> Iterator[Finding]:
        """Without EKF_SELECTOR: yield this EKF if its estimate equals the vehicle's and the primary's does not."""
        last, absent = (None, ()) if self._position is None else (self._position.last, self._position.missing)
        values = zip(_SAMPLE, _read_sample(last), strict=True)
        vehicle = tuple(None if name in absent else value for name, value in values)
        if before and before["timestamp_sample"] == vehicle[0]:
            self._equal[instance] = vehicle == tuple(map(before.__getitem__, _SAMPLE))
        if self._equal.get(instance) and not self._equal.get(self._ekf, True):
            yield detectors.selected(instance, None)

    def _use_ekf(self, instance: int) -> None:
        """Switch the primary EKF; flags set in the old and new primary begin new conditions."""
        old, self._ekf = self._ekf, instance
        if old == instance:
            return
        stream, message = Address(self.name, _EKF, instance), BY_TOPIC[_EKF].name
        self._end(stream, lambda kind, flag: KINDS[kind].message == message or flag.startswith(f"{instance}:"))
        for each in (old, instance):
            detector = self._detectors.get(replace(stream, instance=each))
            for found in () if detector is None else detector.again(detectors.HEALTHY):
                self.emit(found, _EKF, self.time)

    def _end(self, new: Address, is_over: Callable[[str, str], bool]) -> None:
        """End conditions, selected by kind and flag, because a preferred stream is now in use."""
        self._on_ground = {key: each for key, each in self._on_ground.items() if not is_over(*key)}
        for each in dict.fromkeys(each for key, each in self.conditions.items() if is_over(*key)):
            text = f"{each.text}: superseded by {new.stream}"
            self.emit(Finding(each.kind, "end", text, each.begin.names, initial=each.initial), new.topic, self.time)

    def _set_boot(self, boot: float, time: float, *, is_queued: bool) -> None:
        """Set the time since boot, ignoring a single one that disagrees with the last one and the time since then."""
        expected = boot if self.boot is None else self.boot + time - self.time
        was_off, self._is_off = self._is_off, is_queued or abs(boot - expected) > 1e-6 * _REBOOT
        self.time, self.boot = time, boot if was_off or is_queued or not self._is_off else expected

    def _emit_all(self, found: Iterable[Finding], address: Address, time: float) -> None:
        for each in found:
            if each.kind in ("armed", "disarmed"):
                self.armed = each.kind == "armed"
                self._armed_at = time if self.armed else math.inf
            self.emit(each, address.topic, time - each.age)
            if each.kind == "ekf_changed":
                self._use_ekf(int(each.numbers["to"]))

    def _check_reboot(
        self, new: _Suspect, stamp: int, earlier: int, time: float, elapsed: float
    ) -> list[Finding] | None:
        """Return the findings to report now; None after a reboot, which a second message must confirm.

        `elapsed`: time since the last message [s].
        """
        # Only the previous message was damaged unless another one before it, or of another stream, is later as well.
        others = (each for at, each in self._detectors.items() if each is not None and at != new.address)
        support = earlier or max((max(each.stamp, each.earlier) for each in others), default=0)
        is_earlier = min(new.before, support) > stamp + _REBOOT
        if (old := self._suspect) is None:
            is_earlier = is_earlier and is_boot_possible(stamp, elapsed)
            self._suspect = new if is_earlier else None
            return [] if is_earlier else new.found
        is_back = stamp >= old.before - _REBOOT
        if is_back and new.address == old.address:  # only the previous time was damaged
            self._suspect = None
            return old.found + new.found
        if is_back or not (is_earlier or new.address == old.address):
            return new.found
        self._suspect = None
        suspected = self._detectors.get(old.address)
        initial = [] if suspected is None or new.address == old.address else [*suspected.again({})]
        self._reboot(old.before, time)
        self._emit_all(initial, old.address, time)
        return None

    def _reboot(self, before: int, time: float) -> None:
        """Reset the state; report the reboot once, even if delayed messages from before it follow."""
        for detector in filter(None, self._detectors.values()):
            detector.reset()
        self.conditions = {key: each for key, each in self.conditions.items() if KINDS[key[0]].kept_on_reboot}
        self.armed = None
        self._armed_at = math.inf
        self._on_ground.clear()
        last, self._rebooted = self._rebooted, time
        if time - last >= rules.PAUSE and ("duplicate", "") not in self.conditions:
            text = f"reboot: time since boot is {self.boot or 0.0:.1f} s, was {before / 1e6:.1f} s"
            self.emit(Finding("reboot", "once", text, numbers={"before": before / 1e6}), "", time)

    def _report(self, event: Event) -> None:
        common = () if self._common is None else (self._common,)
        recent = [earlier for each in (*common, self) for earlier in each.recent]
        conditions = [known for each in (self, *common) for known in each.conditions.values()]
        self.recent.append(event)
        held = [each for each in conditions if each.begin is not event]
        self._on_event(replace(event, evidence=tuple(explain(event, recent, held))))

    def _is_flapping(self, event: Event) -> bool:
        """Count an event; return True if its kind is too frequent to report each one; `settle` reports the last one."""
        keys = ((event.kind, event.names), (event.kind, None))  # flags of a kind may change in any combination
        limits = [*zip(keys, rules.FLAPPING_CHANGES, strict=True)][keys[1] in self._suppressed :]
        for key, limit in [(keys[1], rules.MAX_SINGLE)] if event.change == "once" else limits:
            events = self._changes.setdefault(key, deque(maxlen=limit))
            is_fast = len(events) == limit and event.time - events[0].time < WINDOW
            events.append(event)
            if is_fast:
                self._suppressed[key] += 1
                return True
        return False


@dataclass(frozen=True, slots=True)
class _Suspect:
    """A message whose time went back: its address, the time before it [us], and its findings."""

    address: Address
    before: int
    found: list[Finding]


@dataclass(slots=True)
class _Burst:
    """Losses, rejections or dropouts in close succession, reported as one event."""

    begin: float
    end: float
    count: int = 0
    topics: set[str] = field(default_factory=set)


@dataclass(slots=True)
class _Supply:
    """Messages of one entry of EVIDENCE; `is_late`: another topic may replace the one in use."""

    detectors: dict[Address, ChangeDetector] = field(default_factory=dict)
    steps: deque[int] = field(default_factory=lambda: deque(maxlen=9))  # us between two messages, sampled
    newest: int = 0
    is_late: bool = False

    def update(self) -> tuple[int, float]:
        """Return PX4's time of the last message, 0 if none since boot, and the time until the next is late [us]."""
        last = max(self.detectors.values(), key=lambda each: max(each.stamp, each.earlier))
        before, self.newest = self.newest, max(last.stamp, last.earlier)
        if self.newest != before and last.stamp > last.earlier > 0:
            self.steps.append(last.stamp - last.earlier)
        is_known = len(self.steps) >= _MIN_STEPS
        return self.newest, max(1e6 * rules.MAX_SILENCE, _INTERVALS * median(self.steps)) if is_known else math.inf
