"""Programs in other languages: built in a temporary folder, then run."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final, NamedTuple

import pytest

HERE: Final = Path(__file__).parent
_CARGO: Final = (
    '[package]\nname = "program"\nversion = "0.0.0"\nedition = "2021"\n'
    '[[bin]]\nname = "program"\npath = "{}"\n'
)
_OFFLINE: Final = (
    "network",
    "registry",
    "No such file",
    "ENOTFOUND",
    "not available",
    "onnection",
    "Could not transfer",
)


class _Toolchain(NamedTuple):
    """Commands in a shell; `$source` is the program's file, `$stem` its name, `$@` are the packages."""

    tools: Sequence[str]
    build: str
    run: str


_TOOLCHAINS: Final = {
    ".cpp": _Toolchain(["g++"], 'g++ -std=c++17 -O0 "$source" -o program', "./program"),
    ".go": _Toolchain(
        ["go"], 'go mod init example && go get "$@" && go build -o program .', "./program"
    ),
    ".java": _Toolchain(
        ["mvn", "javac"],
        'mvn -B -q dependency:copy -Dartifact="$1" -DoutputDirectory=. && javac -cp "*" *.java',
        "java -cp '*:.' $stem",
    ),
    ".mjs": _Toolchain(["node", "npm"], 'npm install --no-audit --no-fund "$@"', "node $source"),
    ".py": _Toolchain(
        [],
        f'{sys.executable} -m pip install -q --target packages "$@"',
        f"{sys.executable} $source",
    ),
    ".rs": _Toolchain(
        ["cargo"],
        'printf "%s\\n" "[dependencies]" "$@" >>Cargo.toml && cargo build -q',
        "cargo run -q --",
    ),
}


def run_program(
    source: str,
    packages: Sequence[str],
    arguments: Sequence[str],
    folder: Path,
    files: Mapping[str, str] | None = None,
) -> str:
    """Return the output of a program of this folder; skip the test if its tools or packages cannot be had here.

    `packages`: as the package manager of its language names them. `files`: further source files, by name.
    """
    toolchain, path = _TOOLCHAINS[Path(source).suffix], folder / source
    if absent := [each for each in toolchain.tools if shutil.which(each) is None]:
        pytest.skip(f"no {absent[0]}")
    shutil.copy(HERE / source, path)
    (folder / "Cargo.toml").write_text(_CARGO.format(source))
    for name, text in (files or {}).items():
        (folder / name).write_text(text)
    environment = f"source={source}; stem={path.stem}; export PYTHONPATH=packages; "
    try:
        done = _run(environment + toolchain.build, packages, folder, 300)
    except subprocess.TimeoutExpired:
        pytest.skip("cannot be built here in 300 s")
    if done.returncode and any(each in done.stdout + done.stderr for each in _OFFLINE):
        pytest.skip(f"cannot be built here: {(done.stdout + done.stderr)[-200:]}")
    assert done.returncode == 0, done.stdout + done.stderr
    done = _run(f'{environment}{toolchain.run} "$@"', arguments, folder, 60)
    assert done.returncode == 0, done.stderr
    return done.stdout


def _run(
    command: str, arguments: Sequence[str], folder: Path, seconds: float
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        ["sh", "-c", command, "sh", *arguments],
        cwd=folder,
        capture_output=True,
        text=True,
        timeout=seconds,
        check=False,
    )
