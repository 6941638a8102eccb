"""Event detectors for flags, arming, flight modes, GNSS receivers, batteries and EKFs."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from typing import Any, Final, Literal, cast

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

_MAX_EKFS: Final = 9  # instances; 255 means none


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
Detection = tuple[Sequence[str], Sequence[str], Detect]
"""Fields whose changes trigger the function, other fields that it needs, and the function."""


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
        self.stamp = self.earlier = 0

    def add(self, message: object, missing: frozenset[str]) -> Iterator[Finding] | None:
        """Return the findings in a message whose `missing` fields were not provided; None if nothing has changed."""
        values = self._read(message)
        self.earlier = self.stamp
        self.stamp = values[0]
        state = values[1:]
        last, self.last = self.last, message
        if state == self._state and (missing is self.missing or missing == self.missing):
            return None
        before = {} if last is None else self._by_name(last, self.missing)
        self._state, self.missing = state, missing
        return self._detect(before, self._by_name(message, missing))

    def reset(self) -> None:
        """Discard the state after a reboot of the vehicle."""
        self.last, self._state = None, ()
        self.stamp = self.earlier = 0

    def again(self, before: Fields) -> Iterator[Finding]:
        """Return the findings in the last message as if it followed one with these fields."""
        return (
            iter(())
            if self.last is None
            else self._detect(before, self._by_name(self.last, self.missing))
        )

    def _by_name(self, message: object, missing: frozenset[str]) -> Fields:
        values = zip(self._read_all.names, self._read_all(message), strict=True)
        return {name: None if name in missing else value for name, value in values}


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
        self.topic, self.kind = topic, ""  # of the condition that it began
        self._is_primary, self._explain = is_primary, explain
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
        if is_fused != self._is_fused or self.stamp - self.earlier > 1e6 * rules.AID_PAUSE:
            self._is_first = self._is_fused is None and self._is_first
            self._start_run(is_fused=is_fused)
        self._count += 1
        self._rejected += bool(rejected)
        if self._count < rules.AID_COUNT or self.stamp - self._since < 1e6 * rules.AID_HOLD:
            return iter(())
        if is_fused:
            return self._change_to("", "")
        is_rejected = self.kind == "aid_rejected" or 2 * self._rejected > self._count
        return self._change_to("aid_rejected" if is_rejected else "aid_unused", "")

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

    def _change_to(self, kind: str, text: str) -> Iterator[Finding]:
        before, self.kind = self.kind, kind
        is_new_run = not (before and kind)
        age = (self.stamp - self._since) / 1e6 if is_new_run else 0.0
        if before and before != kind:
            yield Finding(
                before, "end", text or KINDS[before].end.format(self._label), (self.topic,), age=age
            )
        if kind and before != kind:
            severity: Severity | None = "info" if self.topic in KINDS[kind].minor else None
            initial = kind == "aid_unused" and self._is_first
            text = KINDS[kind].begin.format(self._label) + self._explain()
            yield Finding(
                kind, "begin", text, (self.topic,), severity=severity, initial=initial, age=age
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
        self._is_fused, self._explain = is_fused, explain
        self.is_unused = False
        self.is_missing = False
        self._arriving = 0  # first message after a pause [us]
        self._refused = 0  # first flags that say that no vision is fused [us]

    def reset(self) -> None:
        """Discard the state after a reboot of the vehicle."""
        super().reset()
        self.is_unused = self.is_missing = False
        self._arriving = self._refused = 0

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
    kinds = flagged(message)
    fields, context, further = _FURTHER.get(message, ((), (), None))
    compared = *fields, *(flag for kind in kinds for flag in kind.flags)

    def detect(before: Fields, after: Fields) -> Iterator[Finding]:
        yield from detect_flags(kinds, before, after)
        if further is not None:
            yield from further(before, after)

    return (compared, context, detect) if compared and message != "VehicleLocalPosition" else None


def detect_flags(kinds: Sequence[Kind], before: Fields, after: Fields) -> Iterator[Finding]:
    """Yield conditions that begin or end; a change from or to an unknown value is not an event."""
    for kind in kinds:
        found: dict[tuple[bool, Change], list[str]] = {}  # flags by (is an event, change)
        for name in kind.flags:
            was, now = before.get(name), after.get(name)
            if was is None and now == kind.bad and kind.initial:
                found.setdefault((False, "begin"), []).append(name)
            elif now is None and was == kind.bad:
                found.setdefault((False, "end"), []).append(name)
            elif was is not None and now is not None and was != now:
                found.setdefault((True, "begin" if now == kind.bad else "end"), []).append(name)
        for (is_event, change), flags in sorted(found.items()):
            severity: Severity | None = "info" if kind.minor.issuperset(flags) else None
            text = (kind.begin if change == "begin" else kind.end).format(
                ", ".join(map(kind.flags.__getitem__, flags))
            )
            yield Finding(
                kind.name, change, text, tuple(flags), severity=severity, initial=not is_event
            )


def _detect_text(_: Fields, after: Fields) -> Iterator[Finding]:
    level, text = after["severity"], after["text"]
    if level is not None and text:
        is_bad, is_watch = level <= LogMessage.CRITICAL, level <= LogMessage.WARNING
        severity: Severity = "bad" if is_bad else "watch" if is_watch else "info"
        yield Finding(
            "text", "once", text, (rules.LEVELS[level],), {"level": level}, severity=severity
        )


def _detect_gps(before: Fields, after: Fields) -> Iterator[Finding]:
    fix, was = after["fix_type"], before.get("fix_type")
    satellites, earlier = after["satellites_used"], before.get("satellites_used")
    if was is None and fix is not None and fix < rules.MIN_FIX_TYPE:
        text = (
            f"no GPS fix, {satellites} satellites"
            if satellites in range(_UNKNOWN_SATELLITES)
            else "no GPS fix"
        )
        yield Finding("gps_fix_lost", "begin", text, initial=True)
    elif was is not None and fix is not None and was != fix:
        names = rules.FIXES.get(was, str(was)), rules.FIXES.get(fix, str(fix))
        numbers = {"fix_before": was, "fix": fix}
        change = f"{names[0]} to {names[1]}"
        if satellites is not None and earlier is not None and satellites != earlier:
            numbers |= {"satellites_before": earlier, "satellites": satellites}
            change += f", satellites {earlier} to {satellites}"
        if was >= rules.MIN_FIX_TYPE > fix:
            yield Finding("gps_fix_lost", "begin", f"GPS fix lost: {change}", names, numbers)
        elif was < rules.MIN_FIX_TYPE <= fix:
            yield Finding("gps_fix_lost", "end", f"GPS fix regained: {change}", names, numbers)
        elif names[0] != names[1]:
            yield Finding("gps_fix", "once", f"GPS fix changed: {change}", names, numbers)
    last = _gps_levels(before)
    for kind, (level, begin, end, numbers) in _gps_levels(after).items():
        if level in (0, 2) and level != last[kind][0]:
            initial = level == 2 and (last[kind][0] is None or not before)
            is_info = initial and kind == "few_satellites"  # a vehicle may have no GNSS receiver
            severity: Severity | None = "info" if is_info else None
            found = Finding(
                kind, "begin", begin, (), numbers, severity=severity, initial=initial, switch=True
            )
            yield found if level else Finding(kind, "end", end, (), numbers, switch=True)


def _gps_levels(gps: Fields) -> dict[str, tuple[int | None, str, str, Fields]]:
    """Return level (None if unknown), texts and numbers by kind; a condition begins at level 2 and ends at level 0."""
    satellites, few = gps.get("satellites_used"), None
    if satellites is not None and satellites != _UNKNOWN_SATELLITES:
        few = (satellites < rules.FEW_SATELLITES) + (satellites < rules.ENOUGH_SATELLITES)
    indicator, jammed, spoofed = (gps.get(name) or 0 for name in _INTERFERENCE)
    jamming = (
        2 if jammed > 1 else (indicator >= rules.JAMMING_BEGIN) + (indicator >= rules.JAMMING_END)
    )
    state = f", state {jammed}" if jammed > 1 else ""
    count, jam = f"{satellites} satellites", f"GNSS jamming: indicator {indicator}"
    spoof = f"GNSS spoofing: state {spoofed}"
    return {
        "few_satellites": (few, f"only {count}", count, {"satellites": satellites}),
        "jamming": (
            jamming,
            f"{jam}{state}",
            "GNSS jamming ended",
            {"indicator": indicator, "state": jammed},
        ),
        "spoofing": (2 if spoofed > 1 else 0, spoof, "GNSS spoofing ended", {"state": spoofed}),
    }


def _detect_aiding(before: Fields, after: Fields) -> Iterator[Finding]:
    """Yield the end of fake position fusion in an EstimatorStatusFlags if no other horizontal aiding replaces it."""
    was, now = ([name for name in rules.AIDING if fields.get(name)] for fields in (before, after))
    if was and not now and rules.FAKE_AIDING.keys() >= set(was):
        text = f"no horizontal aiding: EKF stopped fusing {', '.join(map(rules.AIDING.__getitem__, was))}"
        yield Finding("not_aided", "once", text)


def _detect_status(before: Fields, after: Fields) -> Iterator[Finding]:
    was, now = before.get("arming_state"), after["arming_state"]
    if now is not None and (was is None or (was == _ARMED) != (now == _ARMED)):
        kind = "armed" if now == _ARMED else "disarmed"
        yield Finding(kind, "once", kind, initial=was is None)
    was, now = before.get("nav_state"), after["nav_state"]
    if was is not None and now is not None and was != now:
        names = rules.MODES.get(was, str(was)), rules.MODES.get(now, str(now))
        yield Finding(
            "mode",
            "once",
            f"mode changed from {names[0]} to {names[1]}",
            names,
            {"from": was, "to": now},
        )

    yield from _detect_transition(before, after)


def _detect_transition(before: Fields, after: Fields) -> Iterator[Finding]:
    """Yield the begin and end of a VTOL's transition, and the vehicle type that it changes."""
    was, now = before.get("in_transition_mode"), after["in_transition_mode"]
    if now and not was:
        aim = {True: " to fixed wing", False: " to rotary wing"}.get(
            after["in_transition_to_fw"], ""
        )
        yield Finding("transition", "begin", f"VTOL transition{aim}", initial=was is None)
    elif was and now is False:
        yield Finding("transition", "end", "VTOL transition ended")
    old, new = before.get("vehicle_type"), after["vehicle_type"]
    if old is not None and new is not None and old != new:
        names = rules.VEHICLE_TYPES.get(old, str(old)), rules.VEHICLE_TYPES.get(new, str(new))
        text = f"vehicle type changed from {names[0]} to {names[1]}"
        yield Finding("vehicle_type", "once", text, names, {"from": old, "to": new})


def _detect_landing(before: Fields, after: Fields) -> Iterator[Finding]:
    was, now = before.get("landed"), after["landed"]
    if was is not None and now is not None and was != now:
        kind, text = ("landed", "landing detected") if now else ("takeoff", "takeoff detected")
        yield Finding(kind, "once", text)


def _detect_battery(before: Fields, after: Fields) -> Iterator[Finding]:
    known = ({"connected": True, "warning": 0} | before, after)
    was, warning = (
        0 if each["connected"] is False else cast("int | None", each["warning"]) for each in known
    )
    if warning is None or was is None or was == warning:
        return
    remaining = after["remaining"]
    numbers = {"warning": warning}
    left = ""
    if remaining is not None and 0 <= remaining <= 1:
        numbers = {"warning": warning, "remaining": remaining}
        left = f", {100 * remaining:.0f} % left"
    if warning:
        severity: Severity | None = "watch" if warning in (1, 7) else None
        text = f"battery {rules.WARNINGS.get(warning, warning)}{left}"
        yield Finding(
            "battery", "begin", text, numbers=numbers, severity=severity, initial=not before
        )
    else:
        yield Finding(
            "battery",
            "end",
            f"battery no longer {rules.WARNINGS.get(was, was)}{left}",
            numbers=numbers,
        )


def detect_selection(before: Fields, after: Fields) -> Iterator[Finding]:
    """Yield a change of the primary EKF; fields of EKF_SELECTOR, which is not built in, may have any type."""
    was, now = (each.get("primary_instance") for each in (before, after))
    if type(now) is int and now in range(_MAX_EKFS):
        yield selected(now, was if type(was) is int and was in range(_MAX_EKFS) else None)


def selected(now: int, was: int | None) -> Finding:
    """Return the finding that an EKF became primary; without an event if the previous one is unknown."""
    numbers = {"to": now} if was is None else {"from": was, "to": now}
    text = f"primary EKF changed from {was} to {now}"
    return Finding("ekf_changed", "once", text, numbers=numbers, initial=was is None)


def detect_unused(instance: int, before: Fields, after: Fields) -> Iterator[Finding]:
    """Yield the faults of an EKF that is not primary."""
    for each in detect_flags(_EKF_FAULTS, before, after):
        names = tuple(f"{instance}:{name}" for name in each.names)
        text = f"EKF {instance} (not primary): {each.text.removeprefix('EKF ')}"
        yield replace(each, kind="other_ekf", severity=None, text=text, names=names)


# Detection beyond flags, by message.
_FURTHER: Final[Mapping[str, Detection]] = {
    "EstimatorStatusFlags": ((*rules.FAKE_AIDING,), (), _detect_aiding),
    "LogMessage": (("severity", "text"), (), _detect_text),
    "SensorGps": (("fix_type", "satellites_used", *_INTERFERENCE), (), _detect_gps),
    "VehicleStatus": (
        ("arming_state", "nav_state", "in_transition_mode", "vehicle_type"),
        ("in_transition_to_fw",),
        _detect_status,
    ),
    "BatteryStatus": (("warning", "connected"), ("remaining",), _detect_battery),
    "VehicleLandDetected": (("landed",), (), _detect_landing),
}
