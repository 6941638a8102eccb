"""What was seen of the processes of a soak: a table, a picture, and JSON."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import matplotlib.pyplot as plt

SETTLED: Final = 600  # s after which a process has what it needs
GROWTH: Final = 1.05  # of the memory then, at the end


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


def print_table(looks: Sequence[Look], found: Mapping[str, object]) -> None:
    """Print each process at ten minutes (or the half of a shorter run) and at the end, and the account."""
    for name in dict.fromkeys(look.name for look in looks):
        mine = [look for look in looks if look.name == name]
        lives = {look.pid for look in mine}
        last = [look for look in mine if look.pid == mine[-1].pid]
        begin = next((look for look in last if look.time >= last[0].time + SETTLED), last[len(last) // 2])
        final = last[-1]
        holds = (
            final.memory <= GROWTH * begin.memory
            and final.threads <= begin.threads
            and final.descriptors <= begin.descriptors
        )
        seconds = max(1, final.time - last[0].time)
        text = (
            f"{name:9} memory {begin.memory:6.1f} -> {final.memory:6.1f} MB, threads {begin.threads} -> {final.threads}"
            f", descriptors {begin.descriptors} -> {final.descriptors}, processor {final.cpu / seconds:.1%}"
            f" ({'holds' if holds else 'MISSED'})"
        )
        print(text + (f", {len(lives)} lives, the last one of {seconds} s" if len(lives) > 1 else ""))
    for name, value in found.items():
        print(f"{name}: {value:,}" if isinstance(value, int) else f"{name}: {value}")


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
