"""Event detectors for flags, arming, flight modes, GNSS receivers, batteries and EKFs."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, Final, Literal, NamedTuple

from nedbus_msgs import FieldReader
from nedbus_msgs.messages import LogMessage, VehicleStatus

from . import rules
from .kinds import KINDS, Kind, Severity, flagged

Change = Literal["begin", "end", "once"]
Fields = dict[str, Any]
_UNKNOWN_SATELLITES: Final = 255
_ARMED: Final = VehicleStatus.ARMING_STATE_ARMED
_INTERFERENCE: Final = ("jamming_indicator", "jamming_state", "spoofing_state")

EKF_SELECTOR: Final = "estimator_selector_status"
"""Topic that names the primary EKF."""

_EKF_FAULTS: Final = [kind for kind in flagged("EstimatorStatusFlags") if kind.name != "not_fused"]
HEALTHY: Final[Fields] = {flag: not kind.bad for kind in _EKF_FAULTS for flag in kind.flags}
"""Flags of an EKF without faults."""

_EKFS: Final = range(9)  # instances; 255 means none


@dataclass(frozen=True, slots=True)
class Finding:
    """A change detected in one message; Vehicle turns it into an event.

    `severity`: None for the default of its kind.
    `initial`: True if it was active in the first message, so its condition begins without an event.
    `age`: time since it began [s].
    `switch`: True to ignore it unless it begins an inactive condition or ends an active one.
    `is_large`: True for a correction of the estimate that is bad while the vehicle is armed.
    """

    kind: str
    change: Change
    text: str
    names: tuple[str, ...] = ()
    numbers: Mapping[str, float] = field(default_factory=dict)
    severity: Severity | None = None
    initial: bool = False
    age: float = 0.0
    switch: bool = False
    is_large: bool = False


Detect = Callable[[Fields, Fields], Iterator[Finding]]
"""Yield findings from the fields of the previous message ({} for the first one) and of the current message."""


class Detection(NamedTuple):
    """Fields whose changes trigger the function, other fields that it needs, and the function."""

    compared: Sequence[str]
    context: Sequence[str]
    detect: Detect


read_fields: Final = cache(FieldReader)
"""Return the reader of these fields, one for the streams of all vehicles; the names must be a tuple."""


class ChangeDetector:
    """Detector for one stream; calls `detect` only when one of the `compared` fields or `missing` changes.

    `detect` receives None for fields that were not provided. `context`: other fields passed to it.
    `last`, `missing`: the last message, and the names of its fields that were not provided.
    `stamp`, `earlier`: timestamps of the last message and of the one before [us].
    `time`: time of the last message on the event log's clock [s], set by Vehicle.
    `pause`: minimum interval between messages [s]; those before `resumes_at`, on the event log's clock, are skipped.
    """

    pause = 0.0
    resumes_at = time = -math.inf

    def __init__(self, compared: Sequence[str], context: Sequence[str], detect: Detect) -> None:
        self._read = read_fields(("timestamp", *compared))
        self._read_all = read_fields(("timestamp", *compared, *context))
        self._detect = detect
        self.last: object = None
        self._state: tuple[Any, ...] = ()
        self.missing = frozenset[str]()
        self.stamp = 0
        self.earlier = 0

    def add(self, message: object, missing: frozenset[str]) -> Iterator[Finding] | None:
        """Return the findings in a message whose `missing` fields were not provided; None if nothing has changed."""
        values = self._read(message)
        self.earlier = self.stamp
        self.stamp = values[0]
        state = values[1:]
        last = self.last
        self.last = message
        # most messages provide the same object
        is_same = missing is self.missing or missing == self.missing
        if is_same and state == self._state:
            return None
        if last is None:
            before = {}
        else:
            before = self._by_name(last, self.missing)
        self._state = state
        self.missing = missing
        return self._detect(before, self._by_name(message, missing))

    @property
    def newest(self) -> int:
        """The newer timestamp of the last two messages, one of which may be late or damaged [us]."""
        return max(self.stamp, self.earlier)

    def reset(self) -> None:
        """Discard the state after a reboot of the vehicle."""
        self.last = None
        self._state = ()
        self.stamp = 0
        self.earlier = 0

    def again(self, before: Fields) -> Iterator[Finding]:
        """Return the findings in the last message as if it followed one with these fields."""
        if self.last is None:
            return iter(())
        return self._detect(before, self._by_name(self.last, self.missing))

    def _by_name(self, message: object, missing: frozenset[str]) -> Fields:
        values = zip(self._read_all.names, self._read_all(message), strict=True)
        fields: Fields = dict(values)
        for name in missing.intersection(fields):
            fields[name] = None
        return fields


class TextDetector(ChangeDetector):
    """Detector for PX4's own log messages; each is an event, even if it repeats the previous one."""

    def add(self, message: object, missing: frozenset[str]) -> Iterator[Finding] | None:
        """Return the finding in a message."""
        self._state = ()
        return super().add(message, missing)


def detect_nothing(_: Fields, __: Fields) -> Iterator[Finding]:
    """Yield no finding: the detection of a stream of which only the times count."""
    return iter(())


class AidDetector(ChangeDetector):
    """Detector for a topic of AID_SOURCES: measurements that the primary EKF rejects, or does not use.

    Single messages vary: a state counts once all of AID_COUNT messages in AID_HOLD agree.
    `explain`: returns the cause as the end of a sentence, or "".
    """

    def __init__(
        self, topic: str, is_primary: Callable[[object], bool], explain: Callable[[], str]
    ) -> None:
        super().__init__(("fused", "innovation_rejected", "estimator_instance"), (), detect_nothing)
        self.topic = topic
        self.kind = ""  # of the condition that it began
        self._is_primary = is_primary
        self._explain = explain
        self.reset()

    def reset(self) -> None:
        """Discard the state after a reboot of the vehicle."""
        super().reset()
        self.kind = ""
        self._is_first = True
        self._start_run(is_fused=None)

    def add(self, message: object, missing: frozenset[str]) -> Iterator[Finding]:
        """Return the findings in a message."""
        super().add(message, missing)
        fused, rejected, instance = self._state
        if not self._is_primary(instance):
            self._start_run(is_fused=None)
            return self._change_to("", f"{self._label}: another EKF is primary")
        is_fused = bool(fused)
        is_after_pause = self.stamp - self.earlier > 1e6 * rules.AID_PAUSE
        if is_fused != self._is_fused or is_after_pause:
            self._is_first = self._is_fused is None and self._is_first
            self._start_run(is_fused=is_fused)
        self._count += 1
        if rejected:
            self._rejected += 1
        if self._count < rules.AID_COUNT or self.stamp - self._since < 1e6 * rules.AID_HOLD:
            return iter(())
        return self._change_to(self._kind_of_run(), "")

    def _kind_of_run(self) -> str:
        """Return the kind of condition that this run of messages shows, "" if they are fused."""
        if self._is_fused:
            return ""
        are_most_rejected = 2 * self._rejected > self._count
        if are_most_rejected or self.kind == "aid_rejected":
            return "aid_rejected"
        return "aid_unused"

    def stop(self) -> Iterator[Finding]:
        """Return the end of the condition when messages no longer arrive."""
        self._start_run(is_fused=None)
        return self._change_to("", f"EKF no longer receives {self._label}")

    @property
    def _label(self) -> str:
        return rules.AID_SOURCES[self.topic]

    def _start_run(self, *, is_fused: bool | None) -> None:
        self._is_fused = is_fused
        self._since = self.stamp
        self._count = 0
        self._rejected = 0

    def _change_to(self, kind: str, end: str) -> Iterator[Finding]:
        """End the condition that it began, and begin one of this kind, "" for none; `end`: why it ends."""
        before = self.kind
        self.kind = kind
        if kind == before:
            return
        # one condition replaces the other at once
        if before and kind:
            age = 0.0
        else:
            age = (self.stamp - self._since) / 1e6
        if before:
            text = end or KINDS[before].end.format(self._label)
            yield Finding(before, "end", text, (self.topic,), age=age)
        if kind:
            severity: Severity | None = None
            if self.topic in KINDS[kind].minor:
                severity = "info"
            initial = kind == "aid_unused" and self._is_first
            text = KINDS[kind].begin.format(self._label) + self._explain()
            yield Finding(
                kind,
                "begin",
                text,
                (self.topic,),
                severity=severity,
                initial=initial,
                age=age,
            )


class VisionDetector(ChangeDetector):
    """Detector for positions sent into the vehicle: none arrives any more, or the EKF fuses none of them.

    It depends on PX4's timestamps alone.
    `is_fused`: returns whether the EKF fuses any vision, None if unknown, and PX4's time of this state [us].
    `explain`: returns the cause as the end of a sentence, or "".
    """

    def __init__(
        self, is_fused: Callable[[], tuple[bool | None, int]], explain: Callable[[], str]
    ) -> None:
        super().__init__((), (), detect_nothing)
        self._is_fused = is_fused
        self._explain = explain
        self.is_unused = False
        self.is_missing = False
        self._arriving = 0  # first message after a pause [us]
        self._refused = 0  # first flags that say that no vision is fused [us]

    def reset(self) -> None:
        """Discard the state after a reboot of the vehicle."""
        super().reset()
        self.is_unused = False
        self.is_missing = False
        self._arriving = 0
        self._refused = 0

    def add(self, message: object, missing: frozenset[str]) -> Iterator[Finding]:
        """Yield the findings in a message."""
        super().add(message, missing)
        if self.is_missing:
            self.is_missing = False
            yield Finding("no_vision", "end", "vision messages resumed")
        yield from self._check_use()

    def _check_use(self) -> Iterator[Finding]:
        """Return the begin or end of vision that arrives without being fused."""
        if not self._arriving or self.stamp - self.earlier > 1e6 * rules.AID_PAUSE:
            self._arriving = self.stamp
        is_fused, stamp = self._is_fused()
        if is_fused is None:
            return self._end("unknown whether the EKF fuses vision")
        if is_fused and stamp <= self.stamp:  # otherwise the flags are ahead of the vision
            return self._end("the EKF fuses vision", age=(self.stamp - stamp) / 1e6)
        if not is_fused and not self._refused:
            self._refused = stamp
        if not self._refused:
            return iter(())
        return self._begin((self.stamp - max(self._arriving, self._refused)) / 1e6)

    def stop(self) -> Iterator[Finding]:
        """Yield the findings when messages no longer arrive."""
        yield from self._end("vision no longer arrives")
        if not self.is_missing:
            self.is_missing = True
            yield Finding("no_vision", "begin", "no vision message")

    def _begin(self, age: float) -> Iterator[Finding]:
        if not self.is_unused and age >= rules.VISION_HOLD:
            self.is_unused = True
            text = f"vision arrives, but the EKF does not fuse it{self._explain()}"
            yield Finding("vision_unused", "begin", text, age=age)

    def _end(self, text: str, *, age: float = 0.0) -> Iterator[Finding]:
        self._refused = 0
        if self.is_unused:
            self.is_unused = False
            yield Finding("vision_unused", "end", text, age=age)


def detection_of(message: str) -> Detection | None:
    """Return the detection for a message type, None if it has no events; positions use PositionDetector."""
    if message == "VehicleLocalPosition":
        return None
    kinds = flagged(message)
    flags = [flag for kind in kinds for flag in kind.flags]
    further = _FURTHER.get(message)
    if further is None:
        if not flags:
            return None
        return Detection(flags, (), lambda before, after: detect_flags(kinds, before, after))

    def detect(before: Fields, after: Fields) -> Iterator[Finding]:
        yield from detect_flags(kinds, before, after)
        yield from further.detect(before, after)

    return Detection([*further.compared, *flags], further.context, detect)


class _FlagChange(NamedTuple):
    """The change of a flag; `is_event`: False for a condition that is active in the first message, or unknown now."""

    is_event: bool
    change: Change


def detect_flags(kinds: Sequence[Kind], before: Fields, after: Fields) -> Iterator[Finding]:
    """Yield conditions that begin or end; a change from or to an unknown value is not an event."""
    for kind in kinds:
        changed: dict[_FlagChange, list[str]] = {}
        for name in kind.flags:
            change = _change_of_flag(kind, before.get(name), after.get(name))
            if change is not None:
                changed.setdefault(change, []).append(name)
        for (is_event, change_name), flags in sorted(changed.items()):
            labels = ", ".join(kind.flags[flag] for flag in flags)
            if change_name == "begin":
                text = kind.begin
            else:
                text = kind.end
            severity: Severity | None = None
            if kind.minor.issuperset(flags):
                severity = "info"
            yield Finding(
                kind.name,
                change_name,
                text.format(labels),
                tuple(flags),
                severity=severity,
                initial=not is_event,
            )


def _change_of_flag(kind: Kind, was: object, now: object) -> _FlagChange | None:
    """Return how the condition of a flag changes; None for an unknown value."""
    if was is None:
        is_initial = now == kind.bad and kind.initial
        if is_initial:
            return _FlagChange(is_event=False, change="begin")
        return None
    if now is None:
        if was == kind.bad:
            return _FlagChange(is_event=False, change="end")
        return None
    if was == now:
        return None
    return _FlagChange(is_event=True, change="begin" if now == kind.bad else "end")


def _detect_text(_: Fields, after: Fields) -> Iterator[Finding]:
    level = after["severity"]
    text = after["text"]
    if level is None or not text:
        return
    severity: Severity = "info"
    if level <= LogMessage.CRITICAL:
        severity = "bad"
    elif level <= LogMessage.WARNING:
        severity = "watch"
    yield Finding(
        "text",
        "once",
        text,
        (rules.LEVELS[level],),
        {"level": level},
        severity=severity,
    )


def _detect_gps(before: Fields, after: Fields) -> Iterator[Finding]:
    yield from _detect_fix(before, after)
    earlier = _gps_levels(before)
    for kind, level in _gps_levels(after).items():
        was = earlier[kind].value
        if level.value == was:
            continue
        if level.value == 0:
            yield Finding(
                kind,
                "end",
                level.end,
                (),
                level.numbers,
                switch=True,
            )
        elif level.value == 2:
            initial = was is None or not before
            # a vehicle may have no GNSS receiver
            is_info = initial and kind == "few_satellites"
            severity: Severity | None = None
            if is_info:
                severity = "info"
            yield Finding(
                kind,
                "begin",
                level.begin,
                (),
                level.numbers,
                severity=severity,
                initial=initial,
                switch=True,
            )


def _detect_fix(before: Fields, after: Fields) -> Iterator[Finding]:
    fix = after["fix_type"]
    was = before.get("fix_type")
    if fix is None or fix == was:
        return
    if was is None:
        if fix < rules.MIN_FIX_TYPE:
            yield Finding("gps_fix_lost", "begin", _text_without_fix(after), initial=True)
        return
    names = (rules.FIXES.get(was, str(was)), rules.FIXES.get(fix, str(fix)))
    numbers = {"fix_before": was, "fix": fix}
    change = f"{names[0]} to {names[1]}"
    satellites = after["satellites_used"]
    earlier = before.get("satellites_used")
    if satellites is not None and earlier is not None and satellites != earlier:
        numbers |= {"satellites_before": earlier, "satellites": satellites}
        change += f", satellites {earlier} to {satellites}"
    if was >= rules.MIN_FIX_TYPE > fix:
        yield Finding("gps_fix_lost", "begin", f"GPS fix lost: {change}", names, numbers)
    elif was < rules.MIN_FIX_TYPE <= fix:
        yield Finding("gps_fix_lost", "end", f"GPS fix regained: {change}", names, numbers)
    elif names[0] != names[1]:
        yield Finding("gps_fix", "once", f"GPS fix changed: {change}", names, numbers)


def _text_without_fix(gps: Fields) -> str:
    satellites = gps["satellites_used"]
    if satellites in range(_UNKNOWN_SATELLITES):
        return f"no GPS fix, {satellites} satellites"
    return "no GPS fix"


class _Level(NamedTuple):
    """How bad the reception is: begins a condition at 2 and ends it at 0; None if unknown. Its texts and numbers."""

    value: int | None
    begin: str
    end: str
    numbers: Fields


def _gps_levels(gps: Fields) -> dict[str, _Level]:
    """Return the levels by kind of condition."""
    satellites = gps.get("satellites_used")
    count = f"{satellites} satellites"
    indicator, jammed, spoofed = (gps.get(name) or 0 for name in _INTERFERENCE)
    jamming = f"GNSS jamming: indicator {indicator}"
    if jammed > 1:
        jamming += f", state {jammed}"
    return {
        "few_satellites": _Level(
            _level_of_satellites(satellites),
            begin=f"only {count}",
            end=count,
            numbers={"satellites": satellites},
        ),
        "jamming": _Level(
            _level_of_jamming(indicator, jammed),
            begin=jamming,
            end="GNSS jamming ended",
            numbers={"indicator": indicator, "state": jammed},
        ),
        "spoofing": _Level(
            2 if spoofed > 1 else 0,
            begin=f"GNSS spoofing: state {spoofed}",
            end="GNSS spoofing ended",
            numbers={"state": spoofed},
        ),
    }


def _level_of_satellites(count: int | None) -> int | None:
    if count is None or count == _UNKNOWN_SATELLITES:
        return None
    if count < rules.FEW_SATELLITES:
        return 2
    if count < rules.ENOUGH_SATELLITES:
        return 1
    return 0


def _level_of_jamming(indicator: int, state: int) -> int:
    if state > 1 or indicator >= rules.JAMMING_BEGIN:
        return 2
    if indicator >= rules.JAMMING_END:
        return 1
    return 0


def _detect_aiding(before: Fields, after: Fields) -> Iterator[Finding]:
    """Yield the end of fake position fusion in an EstimatorStatusFlags if no other horizontal aiding replaces it."""
    was = [name for name in rules.AIDING if before.get(name)]
    now = [name for name in rules.AIDING if after.get(name)]
    is_only_fake = rules.FAKE_AIDING.keys() >= set(was)
    if was and is_only_fake and not now:
        labels = ", ".join(rules.AIDING[name] for name in was)
        text = f"no horizontal aiding: EKF stopped fusing {labels}"
        yield Finding("not_aided", "once", text)


def _detect_status(before: Fields, after: Fields) -> Iterator[Finding]:
    yield from _detect_arming(before.get("arming_state"), after["arming_state"])
    yield from _detect_mode(before.get("nav_state"), after["nav_state"])
    yield from _detect_transition(before, after)
    yield from _detect_vehicle_type(before.get("vehicle_type"), after["vehicle_type"])


def _detect_arming(was: int | None, now: int | None) -> Iterator[Finding]:
    if now is None:
        return
    is_armed = now == _ARMED
    if was is None or is_armed != (was == _ARMED):
        kind = "armed" if is_armed else "disarmed"
        yield Finding(kind, "once", kind, initial=was is None)


def _detect_mode(was: int | None, now: int | None) -> Iterator[Finding]:
    if was is None or now is None or was == now:
        return
    names = (rules.MODES.get(was, str(was)), rules.MODES.get(now, str(now)))
    text = f"mode changed from {names[0]} to {names[1]}"
    yield Finding("mode", "once", text, names, {"from": was, "to": now})


def _detect_transition(before: Fields, after: Fields) -> Iterator[Finding]:
    """Yield the begin and end of a VTOL's transition."""
    was = before.get("in_transition_mode")
    now = after["in_transition_mode"]
    if now and not was:
        aims = {True: " to fixed wing", False: " to rotary wing"}
        aim = aims.get(after["in_transition_to_fw"], "")
        yield Finding("transition", "begin", f"VTOL transition{aim}", initial=was is None)
    elif was and now is False:
        yield Finding("transition", "end", "VTOL transition ended")


def _detect_vehicle_type(was: int | None, now: int | None) -> Iterator[Finding]:
    """Yield the vehicle type that a VTOL's transition changes."""
    if was is None or now is None or was == now:
        return
    names = (rules.VEHICLE_TYPES.get(was, str(was)), rules.VEHICLE_TYPES.get(now, str(now)))
    text = f"vehicle type changed from {names[0]} to {names[1]}"
    yield Finding("vehicle_type", "once", text, names, {"from": was, "to": now})


def _detect_landing(before: Fields, after: Fields) -> Iterator[Finding]:
    was = before.get("landed")
    now = after["landed"]
    if was is None or now is None or was == now:
        return
    if now:
        yield Finding("landed", "once", "landing detected")
    else:
        yield Finding("takeoff", "once", "takeoff detected")


def _detect_battery(before: Fields, after: Fields) -> Iterator[Finding]:
    was: int | None = 0
    if before:
        was = _warning_of(before)
    warning = _warning_of(after)
    if warning is None or was is None or was == warning:
        return
    numbers = {"warning": warning}
    left = ""
    remaining = after["remaining"]
    if remaining is not None and 0 <= remaining <= 1:
        numbers["remaining"] = remaining
        left = f", {100 * remaining:.0f} % left"
    if not warning:
        text = f"battery no longer {rules.WARNINGS.get(was, was)}{left}"
        yield Finding("battery", "end", text, numbers=numbers)
        return
    severity: Severity | None = None
    if warning in (1, 7):
        severity = "watch"
    text = f"battery {rules.WARNINGS.get(warning, warning)}{left}"
    yield Finding(
        "battery",
        "begin",
        text,
        numbers=numbers,
        severity=severity,
        initial=not before,
    )


def _warning_of(battery: Fields) -> int | None:
    """Return the warning of a battery, 0 for one that is not connected, None if unknown."""
    if battery["connected"] is False:
        return 0
    warning: int | None = battery["warning"]
    return warning


def detect_selection(before: Fields, after: Fields) -> Iterator[Finding]:
    """Yield a change of the primary EKF; fields of EKF_SELECTOR, which is not built in, may have any type."""
    now = _ekf_of(after)
    if now is not None:
        yield selected(now, _ekf_of(before))


def _ekf_of(selection: Fields) -> int | None:
    instance = selection.get("primary_instance")
    if type(instance) is int and instance in _EKFS:
        return instance
    return None


def selected(now: int, was: int | None) -> Finding:
    """Return the finding that an EKF became primary; without an event if the previous one is unknown."""
    numbers = {"to": now}
    if was is not None:
        numbers = {"from": was, "to": now}
    text = f"primary EKF changed from {was} to {now}"
    return Finding("ekf_changed", "once", text, numbers=numbers, initial=was is None)


def detect_unused(instance: int, before: Fields, after: Fields) -> Iterator[Finding]:
    """Yield the faults of an EKF that is not primary."""
    for finding in detect_flags(_EKF_FAULTS, before, after):
        names = tuple(f"{instance}:{name}" for name in finding.names)
        text = f"EKF {instance} (not primary): {finding.text.removeprefix('EKF ')}"
        yield replace(finding, kind="other_ekf", severity=None, text=text, names=names)


# Detection beyond flags, by message.
_FURTHER: Final[Mapping[str, Detection]] = {
    "EstimatorStatusFlags": Detection([*rules.FAKE_AIDING], (), _detect_aiding),
    "LogMessage": Detection(("severity", "text"), (), _detect_text),
    "SensorGps": Detection(("fix_type", "satellites_used", *_INTERFERENCE), (), _detect_gps),
    "VehicleStatus": Detection(
        ("arming_state", "nav_state", "in_transition_mode", "vehicle_type"),
        ("in_transition_to_fw",),
        _detect_status,
    ),
    "BatteryStatus": Detection(("warning", "connected"), ("remaining",), _detect_battery),
    "VehicleLandDetected": Detection(("landed",), (), _detect_landing),
}
