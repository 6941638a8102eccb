"""What a change of status, landing, receiver or battery means, and what follows each kind of message."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final, cast

from .event import Severity
from .rules import ARMED, FEW, FIX, FIXES, JAMMED, MODES, RULES, WARNINGS
from .watches import Change, Fields, Finding, Watch, judge_flags

_UNKNOWN: Final = 255  # satellites, where a receiver does not tell


def judge_status(before: Fields | None, after: Fields) -> Iterator[Finding]:
    """Yield what a VehicleStatus tells: armed and disarmed, mode, failsafe, link."""
    was, now = None if before is None else before["arming_state"], after["arming_state"]
    if now is not None and (was is None or (was == ARMED) != (now == ARMED)):
        kind = "armed" if now == ARMED else "disarmed"
        yield Finding(kind, "once", "info", kind, initial=was is None)
    yield from judge_flags(RULES["VehicleStatus"], before, after)
    if before is not None:
        was, now = before["nav_state"], after["nav_state"]
        if was != now and was is not None and now is not None:
            names = MODES.get(was, str(was)), MODES.get(now, str(now))
            numbers = {"from": was, "to": now}
            yield Finding("mode", "once", "info", f"mode {names[0]} to {names[1]}", names, numbers)


def judge_landed(before: Fields | None, after: Fields) -> Iterator[Finding]:
    """Yield what a VehicleLandDetected tells."""
    if before is not None and None not in (before["landed"], after["landed"]) and before["landed"] != after["landed"]:
        kind, text = ("landed", "landed") if after["landed"] else ("takeoff", "took off")
        yield Finding(kind, "once", "info", text)


class Level:
    """Follow a value between two thresholds: a condition begins beyond the first, and ends beyond the other."""

    def __init__(self) -> None:
        self.held: bool | None = None

    def add(self, *, begins: bool, ends: bool) -> Change | None:
        """Return what changes; at the first value what holds begins."""
        held = self.held
        self.held = begins or (bool(held) and not ends)
        if bool(held) == self.held:
            return None
        return "begin" if self.held else "end"


class GpsJudge:
    """Judge what a GNSS receiver says: its fix, satellites, jamming and spoofing."""

    NAMES: Final = ("fix_type", "satellites_used", "jamming_state", "jamming_indicator", "spoofing_state")

    _LEVELS: Final = ("few_satellites", "jamming", "spoofing")

    def __init__(self) -> None:
        self._levels = {name: Level() for name in self._LEVELS}

    def __call__(self, before: Fields | None, after: Fields) -> Iterator[Finding]:
        """Yield what changes between two messages."""
        if before is None:  # the first one, also after a reboot
            self._levels = {name: Level() for name in self._LEVELS}
        fix = after["fix_type"]
        was = None if before is None else before["fix_type"]
        satellites, earlier = after["satellites_used"], None if before is None else before["satellites_used"]
        if was is None and fix is not None and fix < FIX:
            yield Finding("gps_fix_lost", "begin", "info", "no GPS fix", initial=True)
        elif was is not None and fix is not None and was != fix:
            names = FIXES.get(was, str(was)), FIXES.get(fix, str(fix))
            numbers = {"fix_before": was, "fix": fix}
            text = f"GPS fix {names[0]} to {names[1]}"
            if satellites is not None and earlier is not None and satellites != earlier:
                numbers |= {"satellites_before": earlier, "satellites": satellites}
                text += f", {earlier} satellites to {satellites}"
            if (was >= FIX) != (fix >= FIX):
                change: Change = "end" if fix >= FIX else "begin"
                yield Finding("gps_fix_lost", change, "watch" if fix < FIX else "info", text, names, numbers)
            elif names[0] != names[1]:
                yield Finding("gps_fix", "once", "info", text, names, numbers)
        if satellites is not None and satellites != _UNKNOWN:
            few, enough = FEW
            text = f"{'only ' * (satellites < few)}{satellites} satellites"
            numbers = {"satellites": satellites}
            yield from self._level("few_satellites", satellites < few, satellites >= enough, text, numbers)
        indicator, state = after["jamming_indicator"] or 0, after["jamming_state"] or 0
        yield from self._level(
            "jamming", state > 1 or indicator >= JAMMED[0], state <= 1 and indicator < JAMMED[1],
            f"GNSS jamming: indicator {indicator}" + (f", state {state}" if state > 1 else ""),
            {"indicator": indicator, "state": state},
        )  # fmt: skip
        spoofed = after["spoofing_state"] or 0
        yield from self._level(
            "spoofing", spoofed > 1, spoofed <= 1, f"GNSS spoofing: state {spoofed}", {"state": spoofed}
        )

    def _level(self, kind: str, begins: bool, ends: bool, text: str, numbers: Fields) -> Iterator[Finding]:
        level = self._levels[kind]
        initial = level.held is None
        change = level.add(begins=begins, ends=ends)
        if change is not None:
            text = text if change == "begin" or kind == "few_satellites" else f"{text}: over"
            calm = change == "end" or (initial and kind == "few_satellites")  # a vehicle without GNSS has none
            yield Finding(kind, change, "info" if calm else "watch", text, numbers=numbers, initial=initial)


def judge_battery(before: Fields | None, after: Fields) -> Iterator[Finding]:
    """Yield the warnings that a BatteryStatus tells; their severity grows with them."""
    warning, was = _warning_of(after), 0 if before is None else _warning_of(before)
    remaining = after["remaining"]
    if warning is None or was is None or was == warning:
        return
    severity: Severity = "watch" if warning in (1, 7) else "bad"
    left = f", {100 * remaining:.0f} % left" if remaining is not None and 0 <= remaining <= 1 else ""
    numbers = {"warning": warning} | ({"remaining": remaining} if left else {})
    if warning:
        text = f"battery {WARNINGS.get(warning, warning)}{left}"
        yield Finding("battery", "begin", severity, text, numbers=numbers, initial=before is None)
    else:
        yield Finding("battery", "end", "info", f"battery no longer {WARNINGS.get(was, was)}{left}", numbers=numbers)


def _warning_of(battery: Fields) -> int | None:
    return 0 if battery["connected"] is False else cast("int | None", battery["warning"])


def make_watch(message: str) -> Watch | None:
    """Return what follows a stream of a message, None for one of which no change is an event."""
    rules = RULES.get(message, ())
    flags = tuple(flag for rule in rules for flag in rule.flags)
    match message:
        case "VehicleStatus":
            return Watch(("arming_state", "nav_state", *flags), judge_status)
        case "EstimatorStatusFlags" | "FailsafeFlags":
            return Watch(flags, lambda before, after: judge_flags(rules, before, after))
        case "SensorGps":
            return Watch(GpsJudge.NAMES, GpsJudge())
        case "BatteryStatus":
            return Watch(("warning", "connected"), judge_battery, beside="remaining")
        case "VehicleLandDetected":
            return Watch(("landed",), judge_landed)
    return None
