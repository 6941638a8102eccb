"""The picture of a fleet's day: what arrived at the reader of all, how late, and what the routers took."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt


def draw(found: Mapping[str, Any], path: Path) -> None:
    """Draw messages, latency, processor and memory over time, with a line at each event."""
    seconds = {int(second): values for second, values in found["readers"]["all"]["seconds"].items()}
    begin = min(seconds)
    times = range(begin, max(seconds) + 1)
    received, late, missing, age = (
        [seconds.get(second, [0, 0, 0, 0])[column] for second in times] for column in range(4)
    )
    x = [second - begin for second in times]
    figure, axes = plt.subplots(4, 1, figsize=(10, 9), sharex=True)
    axes[0].plot(x, received, label="received")
    axes[0].plot(x, late, label="of these more than 1 s late")
    axes[0].plot(x, missing, label="missing before these", color="tab:red")
    axes[0].set_ylabel("messages / s")
    axes[0].set_yscale("symlog", linthresh=10)
    axes[1].plot(x, [each / 1000 for each in age])
    axes[1].set_ylabel("largest latency [ms]")
    axes[1].set_yscale("log")
    names = [name for name in dict.fromkeys(look["name"] for look in found["looks"]) if name not in ("link", "one")]
    # Both clocks: the reader's second is the epoch's, that of a look is since the fleet was made.
    shift = found["epoch"] - begin
    for name in names:
        looks = [look for look in found["looks"] if look["name"] == name]
        steps = [
            (two["time"] + shift, (two["cpu"] - one["cpu"]) / max(1, two["time"] - one["time"]))
            for one, two in zip(looks[:-2:2], looks[2::2], strict=False)
            if two["time"] > one["time"]
        ]
        axes[2].plot(*zip(*steps, strict=True), label=name) if steps else None
        axes[3].plot([look["time"] + shift for look in looks], [look["memory"] for look in looks], label=name)
    axes[2].set_ylabel("processor [cores]")
    axes[3].set_ylabel("memory [MB]")
    axes[3].set_xlabel("seconds")
    for axis in axes:
        axis.spines[["top", "right"]].set_visible(False)
        for event in found["events"]:
            axis.axvspan(
                event["begin"] - begin, max(event["over"], event["begin"] + 0.3) - begin, alpha=0.2, color="gray"
            )
    for event in found["events"]:
        axes[0].annotate(event["name"], (event["begin"] - begin, 1.0), xycoords=("data", "axes fraction"), fontsize=8)
    axes[0].legend(fontsize=8)
    axes[3].legend(fontsize=8, ncols=4)
    axes[3].set_xlim(left=-2)
    plan = found["plan"]
    figure.suptitle(
        f"{plan['sessions']} sessions, {plan['vehicles'] * plan['topics']} streams at {plan['rate']:g} Hz"
        f", {plan['routers']} x {plan['router']}, on two cores",
        fontsize=10,
    )
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)
