"""What was seen of the processes of a soak: a table, a picture, and JSON.

python -m benchmarks.soak_report build/soak.json prints the table of a soak again.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from statistics import median
from typing import Final

import matplotlib.pyplot as plt

SETTLED: Final = 600  # s after which a process has what it needs
WINDOW: Final = 180  # s that are compared, from then on and at the end: a single look may see a passing reader
GROWTH: Final = 1.05  # of the memory then, at the end
LEAST: Final = 60  # s of a life that can be judged


@dataclass(frozen=True)
class Look:
    """One look at a process: `time` in s, memory in MB, processor in s since its start."""

    name: str
    pid: int
    time: int
    memory: float
    threads: int
    descriptors: int
    cpu: float


def main() -> None:
    """Print the table of a file that `write_results` wrote."""
    content = json.loads(Path(sys.argv[1]).read_text())
    print_table([Look(**each) for each in content["looks"]], content["account"])


def print_table(looks: Sequence[Look], found: Mapping[str, object]) -> None:
    """Print how each process was once it had settled, and at the end; then the account."""
    print(
        f"memory: median, threads and descriptors: maximum, of {WINDOW} s from {SETTLED} s of a process's life on"
        f" -> of its last {WINDOW} s; of a life that is too short for that, of its second -> of its last third"
    )
    for name in dict.fromkeys(look.name for look in looks):
        mine = [look for look in looks if look.name == name]
        print(f"{name:9} {_compare([look for look in mine if look.pid == mine[-1].pid])}{_lives(mine)}")
    for name, value in found.items():
        print(f"{name}: {value:,}" if isinstance(value, int) else f"{name}: {value}")


def _compare(life: Sequence[Look]) -> str:
    """Compare two windows of one life, of equal length."""
    begin, end = life[0].time, life[-1].time
    if end - begin < LEAST:
        return f"too short to be judged: {end - begin} s"
    is_long = end - begin >= SETTLED + 2 * WINDOW
    start, length = (SETTLED, WINDOW) if is_long else ((end - begin) / 3, (end - begin) / 3)
    first = [look for look in life if start <= look.time - begin <= start + length]
    last = [look for look in life if end - look.time <= length]
    memory = [median(look.memory for look in window) for window in (first, last)]
    threads = [max(look.threads for look in window) for window in (first, last)]
    descriptors = [max(look.descriptors for look in window) for window in (first, last)]
    holds = memory[1] <= GROWTH * memory[0] and threads[1] <= threads[0] and descriptors[1] <= descriptors[0]
    return (
        f"memory {memory[0]:6.1f} -> {memory[1]:6.1f} MB, threads {threads[0]} -> {threads[1]}"
        f", descriptors {descriptors[0]} -> {descriptors[1]}, processor {life[-1].cpu / (end - begin):.1%}"
        f" ({'holds' if holds else 'MISSED'}{'' if is_long else f', in thirds of {length:.0f} s'})"
    )


def _lives(looks: Sequence[Look]) -> str:
    """Tell of a process that was killed and started again."""
    lives = len({look.pid for look in looks})
    last = [look.time for look in looks if look.pid == looks[-1].pid]
    return f", {lives} lives, the last one of {last[-1] - last[0]} s" if lives > 1 else ""


def write_results(folder: Path, looks: Sequence[Look], found: Mapping[str, object]) -> None:
    """Write soak.json and soak.png."""
    folder.mkdir(exist_ok=True)
    content = {"account": dict(found), "looks": [asdict(look) for look in looks]}
    (folder / "soak.json").write_text(json.dumps(content))
    figure, axes = plt.subplots(3, 1, figsize=(9, 7), sharex=True)
    for axis, value, label in zip(
        axes, ("memory", "threads", "descriptors"), ("memory [MB]", "threads", "file descriptors"), strict=True
    ):
        for name in dict.fromkeys(look.name for look in looks):
            mine = [look for look in looks if look.name == name]
            axis.plot([look.time / 60 for look in mine], [getattr(look, value) for look in mine], label=name)
        axis.set_ylabel(label)
        axis.set_ylim(bottom=0)
        axis.spines[["top", "right"]].set_visible(False)
    axes[0].legend(ncols=5, fontsize=8)
    axes[-1].set_xlabel("minutes")
    figure.tight_layout()
    figure.savefig(folder / "soak.png", dpi=110)


if __name__ == "__main__":
    main()
