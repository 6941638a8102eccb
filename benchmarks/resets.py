"""Residuals of the track at resets, in all logs: python -m benchmarks.resets [FOLDER].

A residual is the difference between how far the track moves over a reset, and how far the vehicle moved. The latter is
what the messages at full rate measure: their own steps, and over the reset itself the mean of the steps before and
after; for the heading, the step of `unaided_heading` if the log has it. Sums over all resets, in m, m/s and rad.
"""

from __future__ import annotations

import argparse
import math
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Final

from tests.flights.local_position import upgrade
from tests.flights.replays import open_replay
from tests.flights.ulogs import LOGS

from nedbus.vehicle_events.rules import POSITIONS
from nedbus_msgs import RESET_COUNTERS, Address, Quantity, jump_of
from nedbus_msgs.frames import wrap
from nedbus_msgs.resets import Point

THINNED: Final = 0.09  # s; minimum interval of the messages when thinned to 10 Hz
UNITS: Final[Mapping[Quantity, str]] = {
    "xy": "m", "z": "m", "dist_bottom": "m", "vxy": "m/s", "vz": "m/s", "heading": "rad",
}  # fmt: skip
_VALUES: Final[Mapping[Quantity, tuple[str, ...]]] = {"xy": ("x", "y"), "vxy": ("vx", "vy")}
_RATES: Final = {"x": "vx", "y": "vy", "z": "vz", "vx": "ax", "vy": "ay", "vz": "az"}
Fields = Mapping[str, Any]
Rule = Callable[[Quantity, Fields, Fields], Point | None]


@dataclass(frozen=True, slots=True)
class Reset:
    """A reset, the messages before and after it, and how far the vehicle moved in between."""

    quantity: Quantity
    before: Fields
    after: Fields
    moved: Point


def delta_alone(quantity: Quantity, before: Fields, after: Fields) -> Point | None:
    """Return the delta of the message, as other tools use it."""
    delta = after[f"delta_{quantity}"]
    return delta if isinstance(delta, tuple) else (delta,)


def step_alone(quantity: Quantity, before: Fields, after: Fields) -> Point | None:
    """Return the step between the messages minus the motion by velocity or acceleration."""
    seconds = (after["timestamp"] - before["timestamp"]) / 1e6
    steps = []
    for value in _VALUES.get(quantity, (quantity,)):
        rates = [fields[_RATES[value]] for fields in (before, after) if value in _RATES]
        rates = [rate for rate in rates if math.isfinite(rate)] or [0.0]
        steps.append(after[value] - before[value] - sum(rates) / len(rates) * seconds)
    return _wrapped(quantity, steps)


RULES: Final[Mapping[str, Rule]] = {"delta": delta_alone, "step": step_alone, "rule": jump_of}


def resets_in(path: Path, *, thinned: bool) -> Iterator[Reset]:
    """Yield the resets in all estimates of a log, at full rate or thinned to 10 Hz."""
    streams = defaultdict[Address, list[Fields]](list)
    for message in open_replay(f"ulog:{path}").messages:
        if message.address.topic in POSITIONS:
            streams[message.address].append(vars(upgrade(message.fields)))
    for messages in streams.values():
        yield from _resets_of(messages, thinned=thinned)


def _resets_of(messages: Sequence[Fields], *, thinned: bool) -> Iterator[Reset]:
    kept = [0]
    for index, fields in enumerate(messages):
        if not thinned or fields["timestamp"] - messages[kept[-1]]["timestamp"] >= THINNED * 1e6:
            kept.append(index)
    for quantity, counter in RESET_COUNTERS.items():
        moved = _motion(quantity, messages)
        for first, last in pairwise(kept):
            before, after = messages[first], messages[last]
            if before[counter] != after[counter]:
                total = [sum(parts) for parts in zip(*moved[first:last], strict=True)]
                if all(map(math.isfinite, total)):
                    yield Reset(quantity, before, after, tuple(total))


def _motion(quantity: Quantity, messages: Sequence[Fields]) -> list[Point]:
    """Return how far the vehicle moved after each message until the next one."""
    pairs = [*pairwise(messages)]
    seconds = [(after["timestamp"] - before["timestamp"]) / 1e6 for before, after in pairs]
    steps = [
        _wrapped(
            quantity, [after[value] - before[value] for value in _VALUES.get(quantity, (quantity,))]
        )
        for before, after in pairs
    ]
    counter = RESET_COUNTERS[quantity]
    is_reset = [before[counter] != after[counter] for before, after in pairs]
    moved = [*steps]
    for index in (number for number, found in enumerate(is_reset) if found):
        turned = wrap(pairs[index][1]["unaided_heading"] - pairs[index][0]["unaided_heading"])
        if quantity == "heading" and math.isfinite(turned):
            moved[index] = (turned,)
            continue
        near = [
            other
            for other in (index - 1, index + 1)
            if 0 <= other < len(pairs) and not is_reset[other]
        ]
        rates = [
            [step / seconds[other] for step in steps[other]] for other in near if seconds[other] > 0
        ]
        moved[index] = tuple(
            seconds[index] * sum(axis) / len(axis) for axis in zip(*rates, strict=True)
        )
        moved[index] = moved[index] or (math.nan,) * len(steps[index])
    return moved


def _wrapped(quantity: Quantity, steps: Sequence[float]) -> Point:
    return tuple(map(wrap, steps)) if quantity == "heading" else tuple(steps)


def residuals(folder: Path, *, thinned: bool) -> dict[Quantity, dict[str, list[float]]]:
    """Return the residuals of each rule at all resets of the logs in a folder, by quantity."""
    found: dict[Quantity, dict[str, list[float]]] = {
        name: {rule: [] for rule in RULES} for name in UNITS
    }
    for path in sorted(folder.rglob("*.ulg")):
        for reset in resets_in(path, thinned=thinned):
            for name, rule in RULES.items():
                jump = rule(reset.quantity, reset.before, reset.after)
                found[reset.quantity][name].append(
                    _residual(reset, jump or (0.0,) * len(reset.moved))
                )
    return found


def _residual(reset: Reset, jump: Point) -> float:
    values = _VALUES.get(reset.quantity, (reset.quantity,))
    steps = [reset.after[value] - reset.before[value] for value in values]
    track = [
        step - size - moved for step, size, moved in zip(steps, jump, reset.moved, strict=True)
    ]
    return math.hypot(*_wrapped(reset.quantity, track))


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "folder", nargs="?", type=Path, default=LOGS.parent, help="logs, also in its subfolders"
    )
    arguments = parser.parse_args()
    for thinned in (False, True):
        print(
            f"{'thinned to 10 Hz' if thinned else 'at full rate':<16} {'resets':>6}",
            *(f"{rule:>10}" for rule in RULES),
        )
        for quantity, by_rule in residuals(arguments.folder, thinned=thinned).items():
            sums = (f"{sum(values):>10.3f}" for values in by_rule.values())
            print(f"{quantity + ' [' + UNITS[quantity] + ']':<16} {len(by_rule['rule']):>6}", *sums)


if __name__ == "__main__":
    main()
