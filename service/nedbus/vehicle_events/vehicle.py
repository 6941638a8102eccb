"""State of one vehicle: detectors for its streams, active conditions and recent events."""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from statistics import median
from typing import Final

from nedbus.clock import format_duration
from nedbus.fusion import AID_TOPICS, FusionTracker
from nedbus.timeline import REORDERING, RebootDetector, RebootSign
from nedbus_msgs import BY_TOPIC, TOPICS, Address, FieldReader
from nedbus_msgs.text import counted

from . import detectors, rules
from .contradictions import AIR_DATA, REFERENCES, Comparison, ReferenceDetector
from .detectors import AidDetector, ChangeDetector, Fields, Finding, VisionDetector
from .event import (
    ALONE,
    SUPPRESSED,
    WINDOW,
    Author,
    Condition,
    Event,
    State,
    explain,
    state_of,
    without_wild,
)
from .kinds import KINDS, Severity
from .position import PositionDetector

MAGNETOMETER: Final = "vehicle_magnetometer"
EVENT_TOPICS: Final = (*TOPICS, detectors.EKF_SELECTOR, AIR_DATA, MAGNETOMETER, *rules.AID_SOURCES)
"""Topics from which events are derived: all built-in ones, and others that PX4 logs."""

_EKF: Final = "estimator_status_flags"
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
_FUSION_TOPICS: Final = {*AID_TOPICS, *rules.VISION, _EKF}
_VISION_FLAGS: Final = ("cs_ev_pos", "cs_ev_vel", "cs_ev_hgt", "cs_ev_yaw")
# in place of the detector of a new stream
_NEW: Final = ChangeDetector((), (), detectors.detect_nothing)


class Vehicle:
    """Events and conditions of one vehicle.

    `on_event`: callback for each event. `common`: pseudo-vehicle whose conditions concern all vehicles.

    `conditions`: active conditions by kind and flag. `initial`: conditions active in the first messages.
    `usual`: those of `usual` kinds, active since the first messages; they belong to the flight and affect no state.
    `topics`: published topics. `main`: address of the position estimate in use, vehicle_local_position if published.
    `first`: time of the first position, or without one of the first message, on the event log's clock [s].
    `last_seen`: time of the last message on the event log's clock [s], or of the last update with a live publisher.
    `time`: time of the last message with a detector [s]. `boot`: the time since boot in it [s].
    `recent`: recent events, searched for evidence.
    """

    def __init__(
        self,
        name: str,
        on_event: Callable[[Event], None],
        common: Vehicle | None = None,
        *,
        first: float = 0.0,
    ) -> None:
        self.name = name
        self.conditions: dict[tuple[str, str], Condition] = {}
        self.initial: list[Condition] = []
        self.usual: dict[tuple[str, str], Condition] = {}
        self.topics: set[str] = set()
        self.main: Address | None = None
        self.armed: bool | None = None
        self.time = self.last_seen = 0.0
        self.first = first
        self.author: Author = "PX4"  # of its log messages
        self.boot: float | None = None
        self._before = -math.inf  # time of the message before the last one in its stream
        self._is_off = False  # the last time since boot was not the expected one
        self._on_event = on_event
        self._common = common
        self.recent: deque[Event] = deque(maxlen=_MAX_RECENT)
        self._detectors: dict[Address, ChangeDetector | None] = {}
        self._preferred: dict[tuple[str, ...], Address] = {}  # the stream in use, by group
        self._main_time = math.inf  # time of the last position
        self._invalid = -math.inf  # last time when a quantity of the estimate was invalid
        self._rebooted = -math.inf
        self._reboots = RebootDetector()
        # what a message shows that may be the first one after a reboot
        self._held: _Held | None = None
        # by condition or likeness, and by kind
        self._changes: dict[tuple[str, object], deque[Event]] = {}
        # number of suppressed events, by the same keys
        self._suppressed: Counter[tuple[str, object]] = Counter()
        # lost and rejected messages and dropouts [ms], by kind
        self._bursts: dict[str, _Burst] = {}
        self._ekf = 0  # instance of the primary EKF
        self._fusion = FusionTracker()  # explains why vision is not fused
        # whether it fuses vision, None if unknown; since when [us]
        self._vision: tuple[bool | None, int] = (None, 0)
        self._position: PositionDetector | None = None  # of `main`
        self._comparison = Comparison()
        self._supplies: dict[str, _Supply] = {}  # by key of EVIDENCE
        # time of the last position then, and after its last pause [us since boot]
        self._checked = self._resumed = 0
        self._equal: dict[int, bool] = {}  # by EKF: whether its estimate equals the vehicle's

    def skips(self, address: Address, time: float) -> bool:
        """Note that a message without a loss before it has arrived; return whether `add` would do no more than that."""
        self.last_seen = time
        detector = self._detectors.get(address, _NEW)
        return detector is None or time < detector.resumes_at

    def add(self, address: Address, message: object, time: float, missing: frozenset[str]) -> None:
        """Add a message."""
        self.last_seen = time
        try:
            detector = self._detectors[address]
        except KeyError:
            if len(self._detectors) >= _MAX_STREAMS:
                return
            detector = self._detectors[address] = self._open(address)
        if detector is None or time < detector.resumes_at:
            return
        if detector.pause:
            detector.resumes_at = time + detector.pause
        if address.topic in _FUSION_TOPICS:
            self._fusion.add(address.topic, message, address.instance)
        self._before, detector.time = detector.time, time
        before, earlier = detector.stamp, detector.earlier
        found = detector.add(message, missing)
        stamp = detector.stamp
        is_queued = type(detector) is detectors.TextDetector  # a log may begin with old texts
        elapsed = time - self.time
        self._set_boot(stamp / 1e6, time, is_queued=is_queued)
        if type(detector) is PositionDetector:  # of `main`
            if math.isinf(self._main_time):
                self.first = time
            self._main_time = time
            for kind in ("silent", "gone") if self.conditions else ():
                if (kind, "") in self.conditions:
                    self.emit(
                        Finding(kind, "end", f"{address.stream} resumed"), address.topic, time
                    )
            found = iter([*(found or ()), *self._comparison.add_estimate(stamp, message, missing)])
        if not is_queued and (stamp < before - REORDERING or self._held is not None):
            # Only the previous message was damaged unless another one of this or another stream is later as well.
            other = earlier or self._newest_but(address)
            sign = self._reboots.add(address, stamp, before=before, other=other, elapsed=elapsed)
            if sign is RebootSign.REBOOT:
                self._begin_boot(address, time)
                found = detector.add(message, missing)
            else:
                found = self._hold(sign, address, [*(found or ())])
        self._emit_all(found or (), address, time)

    def count_lost(self, count: int, stream: str, time: float) -> None:
        """Count lost messages of a stream, "" for an estimate of those of all topics of the vehicle's ULog stream."""
        self._count("lost", time, count, stream)

    def add_dropout(self, seconds: float, time: float) -> None:
        """Record a logging dropout that starts at `time`; it does not count as silence of the vehicle."""
        self.last_seen = time
        self._count("dropout", time, round(1e3 * seconds))
        self._main_time = max(self._main_time, time + seconds)

    def reject(self, topic: str, reason: str, time: float) -> None:
        """Record a rejected message."""
        self.last_seen = time
        if "rejected" not in self._bursts:
            self.emit(
                Finding("rejected", "begin", f"{topic} rejected: {reason}", names=(topic, reason)),
                topic,
                time,
            )
        self._count("rejected", time, 1, topic)

    def settle(self, time: float) -> None:
        """Report bursts and flapping that have ended."""
        for kind, burst in list(self._bursts.items()):
            if time - burst.end <= rules.PAUSE and (
                kind != "lost" or time - burst.begin <= rules.LOSS_PERIOD
            ):
                continue
            del self._bursts[kind]
            messages = counted(burst.count, "message")
            numbers: dict[str, float] = {"messages": burst.count}
            if kind == "lost":
                names = tuple(sorted(burst.topics - {""}))
                streams = ", ".join(names)
                if "" in burst.topics:
                    messages = f"about {messages}"
                    streams = f"{streams} and the ULog stream" if streams else "the ULog stream"
                duration = burst.end - burst.begin
                within = f" in {format_duration(duration)}" if duration >= 1 else ""
                text = f"{messages} lost{within} ({streams})"
                self.emit(
                    Finding(kind, "once", text, names, numbers | {"duration": duration}),
                    "",
                    burst.begin,
                )
            elif kind == "rejected":
                self.emit(
                    Finding(kind, "end", f"rejections stopped ({messages})", (), numbers),
                    "",
                    burst.end,
                )
            else:
                duration = burst.count / 1e3
                text = f"logging dropout of {format_duration(duration)}"
                self.emit(
                    Finding(kind, "once", text, numbers={"duration": duration}), "", burst.begin
                )
        for key, events in list(self._changes.items()):
            last = events[-1]
            if key in self._suppressed and time - last.time > rules.PAUSE:
                self._report(_summary(last, self._suppressed.pop(key)))
            if time - last.time > WINDOW:
                del self._changes[key]

    def update(self, time: float, state: str | None, *, is_connected: bool) -> None:
        """Update from the state of the position stream ("stale", "gone", "duplicate", ...), None if not observed."""
        self.settle(time)
        self._check_supplies()
        self._check_aids()
        if self.main is not None and state not in (None, "unknown"):
            stream = self.main.stream
            several = f"several publishers of {stream}: readers receive a mixture of their messages"
            begin = Finding("duplicate", "begin", several, switch=True)
            end = Finding("duplicate", "end", f"only one publisher of {stream} left", switch=True)
            self.emit(begin if state == "duplicate" else end, stream, time)
        silent = {"stale": "silent", "gone": "gone"}.get(state or "")
        if state is None and is_connected and time - self._main_time > rules.SILENCE:
            silent = "silent"
        if (
            silent is None
            or self.main is None
            or {(silent, ""), ("gone", "")} & self.conditions.keys()
        ):
            return
        known = self.conditions.pop(("silent", ""), None)
        since, stream = known.since if known is not None else self._main_time, self.main.stream
        age = max(0.0, time - since)
        text = (
            f"silent: no {stream} for {age:.1f} s"
            if silent == "silent"
            else f"gone: no publisher of {stream}"
        )
        self.emit(Finding(silent, "begin", text, numbers={"age": age}), stream, time, changed=since)

    def _check_supplies(self) -> None:
        """Report EVIDENCE whose messages stopped while positions arrive, and those that resumed, by PX4's time."""
        if self._position is None:
            return
        now = min(self._position.stamp, self._position.earlier)
        silent = dict[str, int]()
        resumed = list[str]()
        # positions resume: other messages may follow them
        if not 0 <= now - self._checked <= _MAX_PAUSE:
            self._resumed = now
        self._checked = now
        for name, supply in self._supplies.items():
            newest, limit = supply.update()
            age, was_late = now - max(newest, self._resumed) if newest else 0, supply.is_late
            supply.is_late = age > limit
            if ("no_messages", name) in self.conditions:
                if not supply.is_late:
                    resumed.append(name)
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

    def _check_aids(self) -> None:
        """End the conditions of measurements that no longer arrive while positions do, by PX4's time."""
        if self._position is None:
            return
        for address, detector in self._detectors.items():
            if isinstance(detector, AidDetector | VisionDetector) and detector.stamp:
                silence = (self._position.stamp - detector.stamp) / 1e6
                if silence > rules.AID_PAUSE:
                    for found in detector.stop():
                        self.emit(found, address.topic, self._main_time - silence)

    def _explain(self, topic: str) -> str:
        """Return why the measurements of a topic are not fused, as the end of a sentence; "" if it is unknown."""
        return f": {cause}" if (cause := self._fusion.diagnosis(topic)) else ""

    def _is_vision_fused(self) -> tuple[bool | None, int]:
        """Return whether the primary EKF fuses any vision, None if unknown, and since when [us]."""
        return self._vision

    def state(self, time: float) -> State:
        """Return the current state, set by active and flapping conditions and single events of the last minute."""
        is_flying = self.armed is not False
        found = [
            each
            for each in self.conditions.values()
            if is_flying or KINDS[each.kind].on_ground != "info"
        ]
        kinds = {each.kind for each in found}
        for event in reversed(without_wild(self.recent)):
            if event.change == "once" and time - rules.RECENT < event.time:
                found.append(Condition(event.kind, event.severity, event.text, event.time, event))
                continue
            keys = {(event.kind, event.names), (event.kind, None)}
            if (
                event.change == "begin"
                and event.kind not in kinds
                and not keys.isdisjoint(self._suppressed)
            ):
                kinds.add(event.kind)
                found.append(
                    Condition(
                        event.kind, event.severity, f"{event.text} (flapping)", event.time, event
                    )
                )
        return state_of(dict.fromkeys(found))  # a condition with several flags appears once

    def emit(
        self, found: Finding, topic: str, time: float, *, changed: float | None = None
    ) -> None:
        """Begin or end the conditions of a finding, or report a single event.

        `changed`: time when the condition began or ended, if earlier than `time`.
        """
        changed = time if changed is None else changed
        if found.change == "begin":
            self.begin(found, topic, time, changed)
        elif found.change == "end":
            self.end(found, topic, time, changed)
        else:
            self._report_unless_frequent(found, self._event(found, topic, time))

    def begin(self, found: Finding, topic: str, time: float, since: float) -> None:
        """Begin the conditions of a finding, active `since`; report an event unless they are initial or flapping."""
        keys, kind = _keys_of(found), KINDS[found.kind]
        if found.switch and keys[0] in self.conditions:
            return
        event = self._event(found, topic, time, is_alone=self._is_alone(found))
        condition = Condition(
            found.kind, found.severity or kind.severity, found.text, since, event, found.initial
        )
        for key in keys:
            self.usual.pop(key, None)
        if found.initial and kind.usual:
            self.usual |= dict.fromkeys(keys, condition)
            return
        self.conditions |= dict.fromkeys(keys, condition)
        if kind.validity:
            self._invalid = math.inf
        if found.initial and len(self.initial) < _MAX_RECENT:
            self.initial.append(condition)
        self._report_unless_frequent(found, event)

    def end(self, found: Finding, topic: str, time: float, until: float) -> None:
        """End the conditions of a finding, active `until`; report an event unless they were initial or are flapping."""
        keys = _keys_of(found)
        if found.switch and keys[0] not in self.conditions:
            return
        is_alone = self._is_alone(found)
        for key in keys:
            self.usual.pop(key, None)
        ended = [self.conditions.pop(key) for key in keys if key in self.conditions]
        if KINDS[found.kind].validity and not any(
            KINDS[kind].validity for kind, _ in self.conditions
        ):
            self._invalid = until
        starts = [condition.since for condition in ended if not condition.initial]
        text, lasted = found.text, None
        if starts:
            lasted = max(0.0, until - min(starts))
            text = f"{text} after {format_duration(lasted)}"
        elif KINDS[found.kind].first:
            text = KINDS[found.kind].first
        event = self._event(
            replace(found, text=text), topic, time, lasted=lasted, is_alone=is_alone
        )
        self._report_unless_frequent(found, event)

    def _event(
        self,
        found: Finding,
        topic: str,
        time: float,
        *,
        lasted: float | None = None,
        is_alone: bool = False,
    ) -> Event:
        boot = None if self.boot is None else round(self.boot + time - self.time, 6)
        numbers = dict(found.numbers)
        if self.armed and found.kind == "text":
            numbers["armed"] = 1
        if is_alone:
            numbers[ALONE] = 1
        author = self.author if found.kind == "text" else None
        return Event(
            self.name, found.kind, found.change, self._severity(found, time), found.text, time, boot, topic, numbers,
            found.names, lasted, author=author,
        )  # fmt: skip

    def _severity(self, found: Finding, time: float) -> Severity:
        """Return the severity of an event: of its kind, unless the finding or the ground changes it."""
        kind = KINDS[found.kind]
        if found.change == "end":
            return found.severity or "info"
        severity = found.severity or kind.severity
        if self.armed is False and kind.on_ground is not None and severity != "info":
            return kind.on_ground
        if self.armed and found.is_large and time - self._invalid >= rules.RECOVERY:
            return "bad"
        return severity

    def _is_alone(self, found: Finding) -> bool:
        """Return whether the value that changes now began with the message just before, of a PERIODIC stream."""
        if KINDS[found.kind].message not in rules.PERIODIC or self.time - self._before > rules.WILD:
            return False
        held = [self.conditions[key] for key in _keys_of(found) if key in self.conditions]
        return any(
            condition.begin.time == self._before and not condition.initial for condition in held
        )

    def _report_unless_frequent(self, found: Finding, event: Event) -> None:
        if not found.initial and not self._is_frequent(event):
            self._report(event)

    @property
    def unknown(self) -> tuple[str, ...]:
        """Flags that the position estimate in use does not provide."""
        return () if self._position is None else self._position.unknown

    @property
    def held(self) -> list[Condition]:
        """Conditions active since the first messages or now, including the usual ones."""
        return [*dict.fromkeys([*self.initial, *self.conditions.values(), *self.usual.values()])]

    @property
    def held_from_start(self) -> str:
        """Bad and watch conditions active since the first message, as text; "" if none."""
        active = self.conditions.values()
        held = [
            condition.text
            for condition in active
            if condition.initial and condition.severity != "info"
        ]
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
            unused = [
                each
                for each in self._detectors
                if each.topic == rules.POSITIONS[-1] and each != self.main
            ]
            self._detectors |= dict.fromkeys(unused)
            return ChangeDetector(["primary_instance"], (), detectors.detect_selection)
        is_of_ekf = topic in (*rules.POSITIONS, *rules.AID_SOURCES, _EKF)
        if instance and not is_of_ekf:  # only the first instance of sensors and batteries
            return None
        group = next((each for each in _GROUPS if topic in each), ())
        if group:
            current = self._preferred.setdefault(group, address)
            best = min(
                current, address, key=lambda each: (group.index(each.topic), each.instance or 0)
            )
            supply = self._supplies.get(_EVIDENCE_OF.get(topic, ""))
            if best != address and not (supply and supply.is_late):
                is_sought = (
                    topic == rules.POSITIONS[-1] != current.topic
                    and detectors.EKF_SELECTOR not in self.topics
                )
                detect = partial(self._detect_equal, instance)
                return ChangeDetector(_SAMPLE, (), detect) if is_sought else None
            if current != address:  # reopen unused streams, and end conditions of the old one
                self._preferred[group], message = address, BY_TOPIC[topic].name
                self._detectors = {
                    each: found
                    for each, found in self._detectors.items()
                    if found and each != current
                }
                self._end(address, lambda kind, _: KINDS[kind].message == message)
        if group is rules.POSITIONS:
            self.main, self._position = address, PositionDetector()
            self._comparison.reset()
            return self._position
        found = self._detector_of(topic, instance)
        if found is not None and topic in _EVIDENCE_OF:
            self._supplies.setdefault(_EVIDENCE_OF[topic], _Supply()).detectors[address] = found
        return found

    def _detector_of(self, topic: str, instance: int) -> ChangeDetector | None:
        """Return a detector for a topic other than the positions, None if it has no events."""
        own = detectors.detection_of(BY_TOPIC[topic].name) if topic in BY_TOPIC else None
        if topic in rules.AID_SOURCES:
            return AidDetector(
                topic, lambda primary: primary == self._ekf, partial(self._explain, topic)
            )
        if topic in rules.VISION:
            return VisionDetector(self._is_vision_fused, partial(self._explain, topic))
        if topic in REFERENCES:
            return ReferenceDetector(topic, self._comparison, own)
        if topic == MAGNETOMETER:
            return ChangeDetector((), (), detectors.detect_nothing)
        if own is None:
            return None
        if topic == _EKF:
            own = *own[:2], partial(self._detect_flags, instance, own[2])
        return detectors.TextDetector(*own) if topic == "log_message" else ChangeDetector(*own)

    def _detect_flags(
        self, instance: int, detect: detectors.Detect, before: Fields, after: Fields
    ) -> Iterator[Finding]:
        if instance != self._ekf:
            return detectors.detect_unused(instance, before, after)
        flags = [after[name] for name in _VISION_FLAGS if after[name] is not None]
        is_fused = any(flags) if flags else None
        if is_fused != self._vision[0]:
            self._vision = is_fused, after["timestamp"]
        return detect(before, after)

    def _detect_equal(self, instance: int, before: Fields, _: Fields) -> Iterator[Finding]:
        """Without EKF_SELECTOR: yield this EKF if its estimate equals the vehicle's and the primary's does not."""
        last, absent = (
            (None, ()) if self._position is None else (self._position.last, self._position.missing)
        )
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
        self._vision, self._fusion.primary = (None, 0), instance
        stream, message = Address(self.name, _EKF, instance), BY_TOPIC[_EKF].name
        self._end(
            stream,
            lambda kind, flag: KINDS[kind].message == message or flag.startswith(f"{instance}:"),
        )
        for each in (old, instance):
            detector = self._detectors.get(replace(stream, instance=each))
            for found in () if detector is None else detector.again(detectors.HEALTHY):
                self.emit(found, _EKF, self.time)

    def _end(self, new: Address, is_over: Callable[[str, str], bool]) -> None:
        """End conditions, selected by kind and flag, because a preferred stream is now in use."""
        self.usual = {key: condition for key, condition in self.usual.items() if not is_over(*key)}
        for each in dict.fromkeys(each for key, each in self.conditions.items() if is_over(*key)):
            text = f"{each.text}: superseded by {new.stream}"
            self.emit(
                Finding(each.kind, "end", text, each.begin.names, initial=each.initial),
                new.topic,
                self.time,
            )

    def _set_boot(self, boot: float, time: float, *, is_queued: bool) -> None:
        """Set the time since boot, ignoring a single one that disagrees with the last one and the time since then."""
        expected = boot if self.boot is None else self.boot + time - self.time
        was_off = self._is_off
        self._is_off = is_queued or abs(boot - expected) > 1e-6 * REORDERING
        self.time, self.boot = time, boot if was_off or is_queued or not self._is_off else expected

    def _emit_all(self, found: Iterable[Finding], address: Address, time: float) -> None:
        for each in found:
            if each.kind in ("armed", "disarmed"):
                self.armed = each.kind == "armed"
            self.emit(each, address.topic, time - each.age)
            if each.kind == "ekf_changed":
                self._use_ekf(int(each.numbers["to"]))

    def _newest_but(self, address: Address) -> int:
        """Return the newest timestamp of the other streams [us]; 0 if there are none."""
        newest = 0
        for other, detector in self._detectors.items():
            if detector is not None and other != address:
                newest = max(newest, detector.stamp, detector.earlier)
        return newest

    def _hold(self, sign: RebootSign, address: Address, found: list[Finding]) -> Iterator[Finding]:
        """Return the findings to report now: those of a first message after a possible reboot are held back."""
        held = self._held
        if sign is RebootSign.FIRST:
            self._held = _Held(address, found)
            return iter(())
        if sign is RebootSign.DAMAGED and held is not None:
            self._held = None
            return iter(held.found + found)
        return iter(found)

    def _begin_boot(self, address: Address, time: float) -> None:
        """Reset the state after a reboot, which a message of this address has confirmed."""
        held, self._held = self._held, None
        first = (
            None if held is None or held.address == address else self._detectors.get(held.address)
        )
        initial = [] if first is None else [*first.again({})]
        self._reboot(self._reboots.before, time)
        if held is not None:
            self._emit_all(initial, held.address, time)

    def _reboot(self, before: int, time: float) -> None:
        """Reset the state; report the reboot once, even if delayed messages from before it follow."""
        for detector in filter(None, self._detectors.values()):
            detector.reset()
        self.conditions = {
            key: each for key, each in self.conditions.items() if KINDS[key[0]].kept_on_reboot
        }
        self.armed = None
        self._vision = None, 0
        self.usual.clear()
        self._invalid = -math.inf
        last, self._rebooted = self._rebooted, time
        if time - last >= rules.PAUSE and ("duplicate", "") not in self.conditions:
            text = f"reboot (up for {self.boot or 0.0:.1f} s, before it for {before / 1e6:.1f} s)"
            self.emit(Finding("reboot", "once", text, numbers={"before": before / 1e6}), "", time)

    def _report(self, event: Event) -> None:
        common = () if self._common is None else (self._common,)
        recent = [earlier for each in (*common, self) for earlier in each.recent]
        conditions = [*self.conditions.values(), *self.usual.values()]
        if self._common is not None:
            conditions += self._common.conditions.values()
        self.recent.append(event)
        held = [condition for condition in conditions if condition.begin is not event]
        self._on_event(replace(event, evidence=tuple(explain(event, recent, held))))

    def _is_frequent(self, event: Event) -> bool:
        """Count an event; return True if there are too many like it to report each; `settle` reports the last one."""
        if event.change == "once":
            alike = event.text if event.kind == "text" else (event.names, event.severity)
            limits: dict[tuple[str, object], int] = {
                (event.kind, alike): rules.EQUAL_EVENTS,
                (event.kind, None): rules.SINGLE_EVENTS,
            }
        else:  # flags of a kind may change in any combination
            limits = {
                (event.kind, event.names): rules.CONDITION_CHANGES,
                (event.kind, None): rules.KIND_CHANGES,
            }
            if (event.kind, None) in self._suppressed:
                del limits[event.kind, event.names]
        for key, limit in limits.items():
            events = self._changes.setdefault(key, deque(maxlen=limit))
            is_fast = len(events) == limit and event.time - events[0].time < WINDOW
            events.append(event)
            if is_fast:
                self._suppressed[key] += 1
                return True
        return False


def _summary(last: Event, count: int) -> Event:
    """Return the event that stands for `count` suppressed ones; PX4's own words stay as they are."""
    if last.kind == "text":
        return replace(last, numbers={**last.numbers, SUPPRESSED: count})
    return replace(last, text=f"{last.text}, the last of {count} suppressed changes")


def _keys_of(found: Finding) -> list[tuple[str, str]]:
    """Return the keys of the conditions of a finding: its kind, and each of its flags."""
    return [(found.kind, flag) for flag in KINDS[found.kind].conditions(found.names)]


@dataclass(frozen=True, slots=True)
class _Held:
    """What the first message after a possible reboot shows, until the next one decides."""

    address: Address
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
    # us between two messages, sampled
    steps: deque[int] = field(default_factory=lambda: deque(maxlen=9))
    newest: int = 0
    is_late: bool = False

    def update(self) -> tuple[int, float]:
        """Return PX4's time of the last message, 0 if none since boot, and the time until the next is late [us]."""
        last = max(self.detectors.values(), key=lambda each: max(each.stamp, each.earlier))
        before, self.newest = self.newest, max(last.stamp, last.earlier)
        if self.newest != before and last.stamp > last.earlier > 0:
            self.steps.append(last.stamp - last.earlier)
        is_known = len(self.steps) >= _MIN_STEPS
        return self.newest, max(
            1e6 * rules.SILENCE, _INTERVALS * median(self.steps)
        ) if is_known else math.inf
