"""Plot docs/explanation/performance.json: python -m benchmarks.compare.picture."""

from __future__ import annotations

import json

import matplotlib.pyplot as plt

from .peers import title
from .report import RESULTS
from .results import FULL


def main() -> None:
    """Plot the throughput of each form, with nedbus highlighted."""
    about = json.loads(RESULTS.read_text())
    rows = sorted(
        about["results"][about["flight"]][FULL.name].items(), key=lambda item: item[1]["rate"]
    )
    names = [
        ("nedbus " if title(name).startswith("nedbus") else "") + name.replace("_", " ")
        for name, _ in rows
    ]
    rates = [row["rate"] for _, row in rows]
    colours = ["tab:blue" if name.startswith("nedbus") else "silver" for name in names]
    figure, axes = plt.subplots(figsize=(9, 0.36 * len(rows) + 1.2))
    bars = axes.barh(names, rates, color=colours)
    axes.bar_label(bars, [f"{rate:,.0f}" for rate in rates], padding=3)
    axes.set_xscale("log")
    axes.set_xlim(right=max(rates) * 2.5)
    axes.set_xlabel("messages per second, two processes on two cores (logarithmic)")
    axes.set_title(
        f"The same 53 fields, publisher to reader: {about['date']}, {about['machine']}", fontsize=10
    )
    axes.spines[["top", "right"]].set_visible(False)
    figure.tight_layout()
    figure.savefig(RESULTS.with_suffix(".png"), dpi=110)


if __name__ == "__main__":
    main()
