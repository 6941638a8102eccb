"""State of one vehicle: the detectors for its streams, the position in use, the primary EKF, and reboots."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from functools import partial
from statistics import median
from typing import Final

from nedbus import limits
from nedbus.fusion import AID_TOPICS, FusionTracker
from nedbus.timeline import REORDER_WINDOW, RebootDetector, RebootSign
from nedbus_msgs import BY_TOPIC, TOPICS, Address, FieldReader

from . import detectors, rules
from .conditions import Conditions
from .contradictions import AIR_DATA, REFERENCES, Comparison, ReferenceDetector
from .detectors import AidDetector, ChangeDetector, Fields, Finding, VisionDetector
from .event import Event
from .kinds import KINDS
from .position import PositionDetector

MAGNETOMETER: Final = "vehicle_magnetometer"
EVENT_TOPICS: Final = (*TOPICS, detectors.EKF_SELECTOR, AIR_DATA, MAGNETOMETER, *rules.AID_SOURCES)
"""Topics from which events are derived: all built-in ones, and others that PX4 logs."""

_EKF: Final = "estimator_status_flags"
# us between positions, after which missing EVIDENCE is timed anew
_POSITION_PAUSE: Final = 2_000_000
_REPLACED: Final = 1_000_000  # us for another topic to replace missing EVIDENCE, such as sensor_gps
_MIN_STEPS: Final = 3  # intervals until the usual one of EVIDENCE is known
_INTERVALS: Final = 3  # usual intervals after which EVIDENCE is late
# Groups of topics in order of preference; conditions come from the best one received.
_GROUPS: Final = (rules.POSITIONS, rules.EVIDENCE["GPS"])
_EVIDENCE_OF: Final = {topic: name for name, topics in rules.EVIDENCE.items() for topic in topics}
_SAMPLE: Final = ("timestamp_sample", "x", "y", "z")  # compared to find the primary EKF
_read_sample: Final = FieldReader(_SAMPLE)
_FUSION_TOPICS: Final = {*AID_TOPICS, *rules.VISION, _EKF}
_VISION_FLAGS: Final = ("cs_ev_pos", "cs_ev_vel", "cs_ev_hgt", "cs_ev_yaw")
# in place of the detector of a new stream
_NEW: Final = ChangeDetector((), (), detectors.detect_nothing)


class Vehicle(Conditions):
    """Events and conditions of one vehicle, from its messages.

    `on_event`: callback for each event. `common`: conditions that concern all vehicles.

    `topics`: published topics. `main`: address of the position estimate in use, vehicle_local_position if published.
    `first`: time of the first position, or without one of the first message, on the event log's clock [s].
    `last_seen`: time of the last message on the event log's clock [s], or of the last update with a live publisher.
    """

    def __init__(
        self,
        name: str,
        on_event: Callable[[Event], None],
        common: Conditions | None = None,
        *,
        first: float = 0.0,
    ) -> None:
        super().__init__(name, on_event, common)
        self.topics: set[str] = set()
        self.main: Address | None = None
        self.first = first
        self.last_seen = 0.0
        self._is_off = False  # the last time since boot was not the expected one
        self._detectors: dict[Address, ChangeDetector | None] = {}
        self._preferred: dict[tuple[str, ...], Address] = {}  # the stream in use, by group
        self._position: PositionDetector | None = None  # of `main`
        self._main_time = math.inf  # time of the last position
        self._comparison = Comparison()
        self._rebooted = -math.inf
        self._reboots = RebootDetector()
        # what a message shows that may be the first one after a reboot
        self._held: _Held | None = None
        self._ekf = 0  # instance of the primary EKF
        self._equal: dict[int, bool] = {}  # by EKF: whether its estimate equals the vehicle's
        self._fusion = FusionTracker()  # explains why vision is not fused
        # whether it fuses vision, None if unknown; since when [us]
        self._vision: tuple[bool | None, int] = (None, 0)
        self._supplies: dict[str, _Supply] = {}  # by key of EVIDENCE
        self._checked = 0  # time of the last position when they were checked [us since boot]
        self._resumed = 0  # time of the first position after the last pause [us since boot]

    def skips(self, address: Address, time: float) -> bool:
        """Note that a message without a loss before it has arrived; return whether `add` would do no more than that."""
        self.last_seen = time
        detector = self._detectors.get(address, _NEW)
        return detector is None or time < detector.resumes_at

    def add(
        self,
        address: Address,
        message: object,
        time: float,
        missing: frozenset[str],
    ) -> None:
        """Add a message."""
        self.last_seen = time
        try:
            detector = self._detectors[address]
        except KeyError:
            if len(self._detectors) >= limits.VEHICLE_STREAMS:
                return
            detector = self._detectors[address] = self._open(address)
        if detector is None or time < detector.resumes_at:
            return
        if detector.pause:
            detector.resumes_at = time + detector.pause
        if address.topic in _FUSION_TOPICS:
            self._fusion.add(address.topic, message, address.instance)
        self._before = detector.time
        detector.time = time
        before = detector.stamp
        earlier = detector.earlier
        findings: Iterable[Finding] = detector.add(message, missing) or ()
        stamp = detector.stamp
        is_queued = type(detector) is detectors.TextDetector  # a log may begin with old texts
        elapsed = time - self.time
        self._set_boot(stamp / 1e6, time, is_queued=is_queued)
        if type(detector) is PositionDetector:  # of `main`
            self._add_position(address, time)
            contradictions = self._comparison.add_estimate(stamp, message, missing)
            findings = [*findings, *contradictions]
        is_back = stamp < before - REORDER_WINDOW
        if not is_queued and (is_back or self._held is not None):
            # Only the previous message was damaged unless another one of this or another stream is later as well.
            other = earlier or self._newest_but(address)
            sign = self._reboots.add(address, stamp, before=before, other=other, elapsed=elapsed)
            if sign is RebootSign.REBOOT:
                self._begin_boot(address, time)
                findings = detector.add(message, missing) or ()
            else:
                findings = self._hold(sign, address, [*findings])
        self._emit_all(findings, address, time)

    def _add_position(self, address: Address, time: float) -> None:
        """Note that a message of the estimate in use has arrived."""
        if math.isinf(self._main_time):
            self.first = time
        self._main_time = time
        if self.conditions:
            for kind in ("silent", "gone"):
                if (kind, "") in self.conditions:
                    finding = Finding(kind, "end", f"{address.stream} resumed")
                    self.emit(finding, address.topic, time)

    def add_dropout(self, seconds: float, time: float) -> None:
        """Record a logging dropout that starts at `time`; it does not count as silence of the vehicle."""
        self.last_seen = time
        self._count("dropout", time, round(1e3 * seconds))
        self._main_time = max(self._main_time, time + seconds)

    def reject(self, topic: str, reason: str, time: float) -> None:
        """Record a rejected message."""
        self.last_seen = time
        if "rejected" not in self._bursts:
            text = f"{topic} rejected: {reason}"
            finding = Finding("rejected", "begin", text, (topic, reason))
            self.emit(finding, topic, time)
        self._count("rejected", time, 1, topic)

    def update(self, time: float, state: str | None, *, is_connected: bool) -> None:
        """Update from the state of the position stream ("stale", "gone", "duplicate", ...), None if not observed."""
        self.settle(time)
        self._check_supplies()
        self._check_aids()
        if self.main is None:
            return
        if state not in (None, "unknown"):
            self._update_duplicate(self.main.stream, time, is_duplicate=state == "duplicate")
        if state == "gone":
            self._fall_silent("gone", self.main.stream, time)
            return
        is_silent = state == "stale" and time > self._main_time  # later during a logging dropout
        if state is None and is_connected:
            is_silent = time - self._main_time > rules.SILENCE
        if is_silent:
            self._fall_silent("silent", self.main.stream, time)

    def _update_duplicate(self, stream: str, time: float, *, is_duplicate: bool) -> None:
        if is_duplicate:
            text = f"several publishers of {stream}: readers receive a mixture of their messages"
            finding = Finding("duplicate", "begin", text, switch=True)
        else:
            text = f"only one publisher of {stream} left"
            finding = Finding("duplicate", "end", text, switch=True)
        self.emit(finding, stream, time)

    def _fall_silent(self, kind: str, stream: str, time: float) -> None:
        """Begin the condition that no position arrives any more, unless it is known."""
        if (kind, "") in self.conditions or ("gone", "") in self.conditions:
            return
        silent = self.conditions.pop(("silent", ""), None)
        if silent is None:
            since = self._main_time
        else:
            since = silent.since
        age = max(0.0, time - since)
        text = f"gone: no publisher of {stream}"
        if kind == "silent":
            text = f"silent: no {stream} for {age:.1f} s"
        finding = Finding(kind, "begin", text, numbers={"age": age})
        self.emit(finding, stream, time, changed=since)

    def _check_supplies(self) -> None:
        """Report EVIDENCE whose messages stopped while positions arrive, and those that resumed, by PX4's time."""
        if self._position is None:
            return
        now = min(self._position.stamp, self._position.earlier)
        if not 0 <= now - self._checked <= _POSITION_PAUSE:
            self._resumed = now  # other messages may follow the positions
        self._checked = now
        silent = dict[str, int]()  # times of the last messages
        resumed = list[str]()
        for name, supply in self._supplies.items():
            supply.update()
            age = 0
            if supply.newest:
                age = now - max(supply.newest, self._resumed)
            was_late = supply.is_late
            supply.is_late = age > supply.limit
            if ("no_messages", name) in self.conditions:
                if not supply.is_late:
                    resumed.append(name)
            elif supply.is_late and not was_late:
                self._reopen_unused()  # another topic may replace it
            elif age > supply.limit + _REPLACED:
                silent[name] = supply.newest
        kind = KINDS["no_messages"]
        if silent:
            age_of_first = (now - min(silent.values())) / 1e6
            text = kind.begin.format(", ".join(silent))
            finding = Finding(kind.name, "begin", text, tuple(silent))
            self.emit(finding, "", self._main_time - age_of_first)
        if resumed:
            text = kind.end.format(", ".join(resumed))
            finding = Finding(kind.name, "end", text, tuple(resumed))
            self.emit(finding, "", self._main_time)

    def _reopen_unused(self) -> None:
        """Decide anew on the streams that had no detector, because another one was preferred."""
        self._detectors = {
            address: detector
            for address, detector in self._detectors.items()
            if detector is not None
        }

    def _check_aids(self) -> None:
        """End the conditions of measurements that no longer arrive while positions do, by PX4's time."""
        if self._position is None:
            return
        for address, detector in self._detectors.items():
            if not isinstance(detector, AidDetector | VisionDetector) or not detector.stamp:
                continue
            silence = (self._position.stamp - detector.stamp) / 1e6
            if silence > rules.AID_PAUSE:
                for finding in detector.stop():
                    self.emit(finding, address.topic, self._main_time - silence)

    def _explain(self, topic: str) -> str:
        """Return why the measurements of a topic are not fused, as the end of a sentence; "" if it is unknown."""
        cause = self._fusion.diagnosis(topic)
        return f": {cause}" if cause else ""

    def _is_vision_fused(self) -> tuple[bool | None, int]:
        """Return whether the primary EKF fuses any vision, None if unknown, and since when [us]."""
        return self._vision

    @property
    def unknown(self) -> tuple[str, ...]:
        """Flags that the position estimate in use does not provide."""
        if self._position is None:
            return ()
        return self._position.unknown

    def _open(self, address: Address) -> ChangeDetector | None:
        """Return a detector for a new stream; None if it has no events, or a preferred stream is in use."""
        if len(self.topics) < limits.VEHICLE_STREAMS:  # streams without events may be opened again
            self.topics.add(address.topic)
        topic = address.topic
        instance = address.instance or 0
        if topic == detectors.EKF_SELECTOR:
            self._close_candidates()
            return ChangeDetector(["primary_instance"], (), detectors.detect_selection)
        is_of_ekf = topic in (*rules.POSITIONS, *rules.AID_SOURCES, _EKF)
        if instance and not is_of_ekf:  # only the first instance of sensors and batteries
            return None
        group = _group_of(topic)
        if group:
            current = self._preferred.setdefault(group, address)
            if not self._is_preferred(address, current, group):
                return self._candidate_of(address, current)
            if current != address:
                self._prefer(address, current, group)
        if group is rules.POSITIONS:
            self.main = address
            self._position = PositionDetector()
            self._comparison.reset()
            return self._position
        detector = self._detector_of(topic, instance)
        if detector is not None and topic in _EVIDENCE_OF:
            supply = self._supplies.setdefault(_EVIDENCE_OF[topic], _Supply())
            supply.detectors[address] = detector
        return detector

    def _is_preferred(self, address: Address, current: Address, group: tuple[str, ...]) -> bool:
        """Return whether a stream of a group is better than the one in use, or that one's messages are late."""
        supply = self._supplies.get(_EVIDENCE_OF.get(address.topic, ""))
        if supply is not None and supply.is_late:
            return True

        def order(stream: Address) -> tuple[int, int]:
            return group.index(stream.topic), stream.instance or 0

        return order(address) < order(current) or address == current

    def _prefer(self, address: Address, current: Address, group: tuple[str, ...]) -> None:
        """Use another stream of a group: reopen unused streams, and end conditions of the old one."""
        message = BY_TOPIC[address.topic].name
        self._preferred[group] = address
        self._reopen_unused()
        self._detectors.pop(current, None)
        self._supersede(address, lambda kind, _: KINDS[kind].message == message)

    def _candidate_of(self, address: Address, current: Address) -> ChangeDetector | None:
        """Without EKF_SELECTOR, return the detector of an EKF's own estimate, which may be that of the vehicle."""
        if detectors.EKF_SELECTOR in self.topics:
            return None
        if address.topic != rules.POSITIONS[-1] or current.topic == rules.POSITIONS[-1]:
            return None
        detect = partial(self._detect_equal, address.instance or 0)
        return ChangeDetector(_SAMPLE, (), detect)

    def _close_candidates(self) -> None:
        """Stop comparing the estimates of the EKFs with the vehicle's."""
        for address in self._detectors:
            if address.topic == rules.POSITIONS[-1] and address != self.main:
                self._detectors[address] = None

    def _detector_of(self, topic: str, instance: int) -> ChangeDetector | None:
        """Return a detector for a topic other than the positions, None if it has no events."""
        own = None
        if topic in BY_TOPIC:
            own = detectors.detection_of(BY_TOPIC[topic].name)
        explain = partial(self._explain, topic)
        if topic in rules.AID_SOURCES:
            return AidDetector(topic, lambda primary: primary == self._ekf, explain)
        if topic in rules.VISION:
            return VisionDetector(self._is_vision_fused, explain)
        if topic in REFERENCES:
            return ReferenceDetector(topic, self._comparison, own)
        if topic == MAGNETOMETER:
            return ChangeDetector((), (), detectors.detect_nothing)
        if own is None:
            return None
        if topic == _EKF:
            detect = partial(self._detect_flags, instance, own.detect)
            own = own._replace(detect=detect)
        detector = detectors.TextDetector if topic == "log_message" else ChangeDetector
        return detector(*own)

    def _detect_flags(
        self,
        instance: int,
        detect: detectors.Detect,
        before: Fields,
        after: Fields,
    ) -> Iterator[Finding]:
        if instance != self._ekf:
            return detectors.detect_unused(instance, before, after)
        flags = [after[name] for name in _VISION_FLAGS if after[name] is not None]
        is_fused = None
        if flags:
            is_fused = any(flags)
        if is_fused != self._vision[0]:
            self._vision = is_fused, after["timestamp"]
        return detect(before, after)

    def _detect_equal(self, instance: int, before: Fields, _: Fields) -> Iterator[Finding]:
        """Without EKF_SELECTOR: yield this EKF if its estimate equals the vehicle's and the primary's does not."""
        vehicle = self._sample_of_vehicle()
        if before and before["timestamp_sample"] == vehicle[0]:
            own = tuple(before[name] for name in _SAMPLE)
            self._equal[instance] = vehicle == own
        primary_is_equal = self._equal.get(self._ekf, True)
        if self._equal.get(instance) and not primary_is_equal:
            yield detectors.selected(instance, None)

    def _sample_of_vehicle(self) -> tuple[object, ...]:
        """Return the fields of _SAMPLE in the last position, None for those that were not provided."""
        if self._position is None:
            return _read_sample(None)
        missing = self._position.missing
        values = zip(_SAMPLE, _read_sample(self._position.last), strict=True)
        return tuple(None if name in missing else value for name, value in values)

    def _use_ekf(self, instance: int) -> None:
        """Switch the primary EKF; flags set in the old and new primary begin new conditions."""
        old = self._ekf
        if old == instance:
            return
        self._ekf = instance
        self._vision = (None, 0)
        self._fusion.primary = instance
        message = BY_TOPIC[_EKF].name
        prefix = f"{instance}:"  # of its faults while it was not primary

        def is_over(kind: str, flag: str) -> bool:
            return KINDS[kind].message == message or flag.startswith(prefix)

        self._supersede(Address(self.name, _EKF, instance), is_over)
        for ekf in (old, instance):
            address = Address(self.name, _EKF, ekf)
            detector = self._detectors.get(address)
            if detector is not None:
                for finding in detector.again(detectors.HEALTHY):
                    self.emit(finding, _EKF, self.time)

    def _supersede(self, new: Address, is_over: Callable[[str, str], bool]) -> None:
        """End conditions, selected by kind and flag, because a preferred stream is now in use."""
        self.usual = {key: condition for key, condition in self.usual.items() if not is_over(*key)}
        over = [condition for key, condition in self.conditions.items() if is_over(*key)]
        for condition in dict.fromkeys(over):
            finding = Finding(
                condition.kind,
                "end",
                f"{condition.text}: superseded by {new.stream}",
                condition.begin.names,
                initial=condition.initial,
            )
            self.emit(finding, new.topic, self.time)

    def _set_boot(self, boot: float, time: float, *, is_queued: bool) -> None:
        """Set the time since boot, ignoring a single one that disagrees with the last one and the time since then."""
        if self.boot is None:
            expected = boot
        else:
            expected = self.boot + time - self.time
        was_off = self._is_off
        self._is_off = is_queued or abs(boot - expected) > 1e-6 * REORDER_WINDOW
        is_single = self._is_off and not was_off and not is_queued
        self.time = time
        self.boot = expected if is_single else boot

    def _emit_all(self, findings: Iterable[Finding], address: Address, time: float) -> None:
        for finding in findings:
            if finding.kind in ("armed", "disarmed"):
                self.armed = finding.kind == "armed"
            self.emit(finding, address.topic, time - finding.age)
            if finding.kind == "ekf_changed":
                self._use_ekf(int(finding.numbers["to"]))

    def _newest_but(self, address: Address) -> int:
        """Return the newest timestamp of the other streams [us]; 0 if there are none."""
        newest = 0
        for other, detector in self._detectors.items():
            if detector is not None and other != address:
                newest = max(newest, detector.newest)
        return newest

    def _hold(self, sign: RebootSign, address: Address, findings: list[Finding]) -> list[Finding]:
        """Return the findings to report now: those of a first message after a possible reboot are held back."""
        if sign is RebootSign.FIRST:
            self._held = _Held(address, findings)
            return []
        if sign is RebootSign.DAMAGED and self._held is not None:
            held = self._held
            self._held = None
            return held.findings + findings
        return findings

    def _begin_boot(self, address: Address, time: float) -> None:
        """Reset the state after a reboot, which a message of this address has confirmed."""
        held = self._held
        self._held = None
        findings: list[Finding] = []
        if held is not None and held.address != address:
            first = self._detectors.get(held.address)
            if first is not None:
                findings += first.again({})
        self._reboot(self._reboots.before, time)
        if held is not None:
            self._emit_all(findings, held.address, time)

    def _reboot(self, before: int, time: float) -> None:
        """Reset the state; report the reboot once, even if delayed messages from before it follow."""
        for detector in self._detectors.values():
            if detector is not None:
                detector.reset()
        self.conditions = {
            key: condition
            for key, condition in self.conditions.items()
            if KINDS[condition.kind].kept_on_reboot
        }
        self.armed = None
        self._vision = (None, 0)
        self.usual.clear()
        self._invalid = -math.inf
        last = self._rebooted
        self._rebooted = time
        if time - last >= rules.PAUSE and ("duplicate", "") not in self.conditions:
            text = f"reboot (up for {self.boot or 0.0:.1f} s, before it for {before / 1e6:.1f} s)"
            self.emit(Finding("reboot", "once", text, numbers={"before": before / 1e6}), "", time)


def _group_of(topic: str) -> tuple[str, ...]:
    for group in _GROUPS:
        if topic in group:
            return group
    return ()


@dataclass(frozen=True, slots=True)
class _Held:
    """What the first message after a possible reboot shows, until the next one decides."""

    address: Address
    findings: list[Finding]


@dataclass(slots=True)
class _Supply:
    """Messages of one entry of EVIDENCE; `is_late`: another topic may replace the one in use."""

    detectors: dict[Address, ChangeDetector] = field(default_factory=dict)
    # us between two messages, sampled
    steps: deque[int] = field(default_factory=lambda: deque(maxlen=9))
    newest: int = 0
    is_late: bool = False

    def update(self) -> None:
        """Set `newest` to PX4's time of the last message, 0 if none since boot [us]."""
        last = max(self.detectors.values(), key=lambda detector: detector.newest)
        before = self.newest
        self.newest = last.newest
        if self.newest != before and last.stamp > last.earlier > 0:
            self.steps.append(last.stamp - last.earlier)

    @property
    def limit(self) -> float:
        """The time until the next message is late [us]."""
        if len(self.steps) < _MIN_STEPS:
            return math.inf
        return max(1e6 * rules.SILENCE, _INTERVALS * median(self.steps))
