"""Fuzz all parsers, which share the given time: `python -m fuzz --seconds 600 [ulog mcap ...]`.

The corpus is kept in build/fuzz/corpus, from run to run; inputs with findings are in build/fuzz/findings.
Exits with 1 for a finding: an undocumented error, more than ten seconds, or more than 512 MB of memory for one input.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Final

from .parsers import PARSERS
from .seeds import SEEDS

ROOT: Final = Path(__file__).parents[1]
BUILD: Final = ROOT / "build" / "fuzz"
_HANG: Final = 10  # s for one input
_MEMORY: Final = 512  # MB of the process
# maximum input size [bytes]; others 4096
_MAX_LENGTH: Final = {"mcap": 20_000, "ulog": 10_000, "mavlink": 8_000}
# s; a harness is killed this long after its time; on a busy machine it starts slowly
_GRACE: Final = 600
_LEAST_EDGES: Final = 100
_SHOWN: Final = 25  # lines of output for a finding


def main() -> int:
    """Run the harnesses, as many at once as there are processors, and print a line for each."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("parsers", nargs="*", choices=[*PARSERS, []], help="default: all")
    parser.add_argument(
        "--seconds", type=float, default=600, help="total duration for all parsers [s]"
    )
    options = parser.parse_args()
    chosen = options.parsers or [*PARSERS]
    if find_spec("atheris") is None:
        print("skipped: Atheris has no wheel for this machine or Python")
        return 0
    seconds = max(1, round(options.seconds / len(chosen)))
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        results = [*pool.map(lambda name: fuzz(name, seconds), chosen)]
    return int(not all(results))


def fuzz(name: str, seconds: int) -> bool:
    """Fuzz one parser, print the numbers of inputs and of reached edges, and return True if nothing was found."""
    corpus, findings = BUILD / "corpus" / name, BUILD / "findings"
    corpus.mkdir(parents=True, exist_ok=True)
    findings.mkdir(parents=True, exist_ok=True)
    for seed in SEEDS[name]():
        (corpus / f"seed-{hashlib.sha1(seed, usedforsecurity=False).hexdigest()}").write_bytes(seed)
    flags = [
        f"-max_total_time={seconds}", f"-max_len={_MAX_LENGTH.get(name, 4096)}", f"-timeout={_HANG}",
        f"-rss_limit_mb={_MEMORY}", f"-artifact_prefix={findings}/{name}-", "-print_final_stats=1",
    ]  # fmt: skip
    command = [sys.executable, "-m", "fuzz.harness", name, *flags, str(corpus)]
    limit = seconds + _GRACE
    try:
        done = subprocess.run(
            command, cwd=ROOT, text=True, capture_output=True, timeout=limit, check=False
        )
        error, output, code = done.stdout, done.stderr, done.returncode
    except subprocess.TimeoutExpired as exc:
        error, output, code = str(exc), "", -1
    runs = re.findall(r"^(?:stat::number_of_executed_units: |#)(\d+)", output, re.MULTILINE)
    edges = re.findall(r"cov: (\d+)", output)
    # If few edges are reached, nedbus is not instrumented, and the inputs are random.
    passed = code == 0 and bool(edges) and int(edges[-1]) > _LEAST_EDGES
    line = f"{name:8} {(runs or '0')[-1]:>9} inputs {(edges or '0')[-1]:>6} edges"
    print(line if passed else f"{line}  FINDING")
    if not passed:
        summary = re.findall(r"^(?:==.*|.*Error: .*|.*written to.*)$", output, re.MULTILINE)
        print("\n".join([*error.splitlines()[-_SHOWN:], *summary]))
        print(f"to reproduce: python -m fuzz.harness {name} <that file>")
    sys.stdout.flush()
    return passed


if __name__ == "__main__":
    sys.exit(main())
