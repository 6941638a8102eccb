"""nedbus beside its peers, in one run: python -m benchmarks.compare [ROUNDS].

Each form of benchmarks/forms sends the same 53 fields from one process to another, through one router where it uses
Zenoh: as fast as it can without losing any, then at 1 kHz and at 100 Hz. Rounds are interleaved, and medians taken, as
machines are shared and noisy; only the ratios of one run mean something.
Peers are installed in environments of their own under build/bench; one that cannot be is named as such.
The results are written to docs/performance.json and, as a table, into the README.
"""

from __future__ import annotations

import ast
import datetime as dt
import json
import os
import platform
import re
import select
import statistics
import subprocess
import sys
import time
import venv
from contextlib import suppress
from pathlib import Path
from typing import Final

ROOT = Path(__file__).parents[1]
FORMS = ROOT / "benchmarks" / "forms"
RESULTS = ROOT / "docs" / "performance.json"
ENDPOINT: Final = "tcp/127.0.0.1:17777"
FIRST: Final = ("raw", "batches", "rows", "models", "straightforward")  # then the peers, by name
LASTS: Final = 2.5  # s that a run at full speed should last
PACED: Final = {1000: 4000, 100: 600}  # messages at these rates
PATIENCE: Final = 120.0  # s that one run may take
HEAD: Final = (
    "| what | bytes | messages/s | of raw | CPU µs/message at full speed, publisher / reader"
    " | one-way p50 / p99 at 1 kHz, µs | at 100 Hz, µs | CPU µs/message at 1 kHz |"
)

BYTES: Final = {  # of a payload, without what the transport adds
    "raw": 244, "batches": 244, "rows": 244, "models": 244, "straightforward": 916, "msgspec_array": 352,
    "pyzmq": 912, "rose": 949, "zrm": 249, "zenoh_ros2": 220, "cyclonedds": 220, "lcm": 200,
}  # fmt: skip

Measured = dict[str, float]


def main() -> None:
    """Measure all forms and write the results."""
    rounds = int(sys.argv[1]) if len(sys.argv) > 1 else 5
    names = sorted(path.stem for path in FORMS.glob("*.py") if "def publish(" in path.read_text())
    pythons: dict[str, str] = {}
    failed: dict[str, str] = {}
    for name in [*FIRST, *(name for name in names if name not in FIRST)]:
        try:
            pythons[name] = prepare(name)
        except subprocess.CalledProcessError as exc:
            failed[name] = f"cannot be installed: {exc.stderr.decode()[-200:].strip()}"
    router = subprocess.Popen(
        [sys.executable, "-m", "nedbus", "router", "--listen", ENDPOINT], stderr=subprocess.DEVNULL
    )
    try:
        time.sleep(1.0)
        results = measure_all(pythons, failed, rounds)
    finally:
        router.terminate()
        router.wait()
    write(results, failed, rounds)


def prepare(name: str) -> str:
    """Return the Python that has what a form needs, installed if it is a peer's."""
    packages = find_packages(name)
    if not packages:
        return sys.executable
    folder = ROOT / "build" / "bench" / name
    python = folder / "bin" / "python"
    if not python.exists():
        print(f"installing {' '.join(packages)}", flush=True)
        venv.create(folder, with_pip=True)
    subprocess.run([python, "-m", "pip", "install", "-q", *packages], check=True, capture_output=True)
    return str(python)


def find_packages(name: str) -> list[str]:
    """Return what a form's PACKAGES says, without importing it."""
    for node in ast.parse((FORMS / f"{name}.py").read_text()).body:
        if isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "PACKAGES":
            found: list[str] = ast.literal_eval(node.value)
            return found
    return []


def measure_all(pythons: dict[str, str], failed: dict[str, str], rounds: int) -> dict[str, Measured]:
    """Return the medians of all forms that work."""
    counts: dict[str, int] = {}
    for name, python in pythons.items():
        try:
            trial = run(name, python, 5000, 0)
        except (RuntimeError, subprocess.SubprocessError, ValueError) as exc:
            failed[name] = f"does not work here: {exc}"
            continue
        counts[name] = min(1_000_000, max(5000, round(trial["rate"] * LASTS)))
    rows: dict[str, list[Measured]] = {name: [] for name in counts}
    for number in range(rounds):
        for name, count in counts.items():
            row = run(name, pythons[name], count, 0)
            for rate, messages in PACED.items():
                paced = run(name, pythons[name], messages, rate)
                row |= {f"{key}_{rate}": paced[key] for key in ("p50", "p99", "publish_cpu", "receive_cpu", "kept")}
            rows[name].append(row)
            print(f"round {number + 1}: {name}: {row['rate']:.0f}/s", flush=True)
    return {name: {key: statistics.median(row[key] for row in each) for key in each[0]} for name, each in rows.items()}


def run(name: str, python: str, count: int, rate: float) -> Measured:
    """Run both ends once; CPU times are microseconds a message."""
    ends = []
    try:
        for role in ("receive", "publish"):
            command = [python, "-m", "benchmarks.role", name, role, ENDPOINT, str(count), str(rate)]
            end = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, cwd=ROOT)
            ends.append(end)
            if answer(end) != "ready":
                raise RuntimeError(f"{role} does not start")
        receiver, publisher = ends
        time.sleep(0.5)
        tell(publisher)
        sent = json.loads(answer(publisher))
        tell(receiver)
        got = json.loads(answer(receiver))
        tell(publisher)
        return {
            "rate": got["received"] / got["seconds"],
            "kept": got["received"] / count,
            "publish_cpu": sent["cpu"] / count * 1e6,
            "receive_cpu": got["cpu"] / max(1, got["received"]) * 1e6,
            "publish_peak": sent["peak"],
            "receive_peak": got["peak"],
            "p50": got.get("p50", 0.0),
            "p99": got.get("p99", 0.0),
        }
    finally:
        for end in ends:
            try:
                end.wait(2.0)
            except subprocess.TimeoutExpired:
                end.kill()
                end.wait()


def answer(end: subprocess.Popen[str]) -> str:
    """Return the next line of a process, which has some time for it."""
    assert end.stdout is not None
    if not select.select([end.stdout], [], [], PATIENCE)[0]:
        raise RuntimeError(f"it says nothing within {PATIENCE} s")
    line = end.stdout.readline().strip()
    if not line:
        raise RuntimeError("it ended")
    return line


def tell(end: subprocess.Popen[str]) -> None:
    """Let a process go on; one that has ended has said all."""
    assert end.stdin is not None
    with suppress(BrokenPipeError):
        end.stdin.write("\n")
        end.stdin.flush()


def title(name: str) -> str:
    """Return the first sentence of a form's description."""
    doc = ast.get_docstring(ast.parse((FORMS / f"{name}.py").read_text())) or name
    return re.split(r"[.;](?:\s|$)", doc.replace("\n", " "))[0]


def table(results: dict[str, Measured], failed: dict[str, str]) -> str:
    """Return the results as Markdown, the fastest first."""
    raw = results["raw"]
    lines = [HEAD, "|---" * HEAD.count(" |") + "|"]
    for name, row in sorted(results.items(), key=lambda item: -item[1]["rate"]):
        lost = "" if row["kept"] == 1.0 else f" ({1 - row['kept']:.1%} lost)"
        lines.append(
            f"| {title(name)} | {BYTES[name]} | {row['rate']:,.0f}{lost} | {row['rate'] / raw['rate']:.2f} |"
            f" {row['publish_cpu']:.1f} / {row['receive_cpu']:.1f} |"
            f" {row['p50_1000']:.0f} / {row['p99_1000']:.0f} | {row['p50_100']:.0f} / {row['p99_100']:.0f} |"
            f" {row['publish_cpu_1000']:.0f} / {row['receive_cpu_1000']:.0f} |"
        )
    lines += [f"| {name} | | {reason} | | | | | |" for name, reason in failed.items()]
    return "\n".join(lines)


def write(results: dict[str, Measured], failed: dict[str, str], rounds: int) -> None:
    """Write the results as JSON, and as a table into the README."""
    about = {
        "date": dt.datetime.now(dt.UTC).date().isoformat(),
        "machine": f"{os.cpu_count()} shared cores, {platform.machine()}, Python {platform.python_version()}",
        "rounds": rounds,
        "results": results,
        "failed": failed,
    }
    RESULTS.write_text(json.dumps(about, indent=2) + "\n")
    text = (
        f"Measured on {about['date']} on {about['machine']}, publisher, router and reader in processes of their own,"
        f" TCP on loopback; medians of {rounds} interleaved rounds.\n\n{table(results, failed)}"
    )
    print(text)
    readme = ROOT / "README.md"
    marks = r"(<!-- performance -->\n).*?(\n<!-- /performance -->)"
    readme.write_text(re.sub(marks, lambda found: found[1] + text + found[2], readme.read_text(), flags=re.DOTALL))


if __name__ == "__main__":
    main()
