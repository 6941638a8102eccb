"""Run every command in an environment without optional packages: `python tests/release/every_command.py [EXTRA ...]`.

`--block` blocks the import of all packages that nedbus with these extras does not install: for environments that have
more, such as that of the tests. Without it the environment is taken as it is: `make wheel` runs this in clean ones.
"""

from __future__ import annotations

import os
import re
import sys
import tempfile
import time
import tomllib
import traceback
from collections.abc import Iterable, Iterator, Sequence
from importlib import metadata
from importlib.abc import MetaPathFinder
from pathlib import Path
from typing import Any, Final, NamedTuple

ROOT: Final = Path(__file__).parents[2]
_CLOSED: Final = "tcp/127.0.0.1:9"  # the discard port: nothing answers
_LINK: Final = "mavlink:udpin:127.0.0.1:0"

# Arguments for a run of each command, and the extra that it needs. None of the files exists.
RUNS: Final[dict[str, tuple[tuple[str, ...], str]]] = {
    "serve": (("-s", _LINK, "-l", "tcp/127.0.0.1:0"), "mavlink"),
    "router": (("-l", "nowhere"), ""),
    "list": (("-c", _CLOSED), ""),
    "echo": (("-c", _CLOSED), ""),
    "hz": (("-c", _CLOSED), ""),
    "get": (("-c", _CLOSED), ""),
    "info": (("-c", _CLOSED), ""),
    "events": (("none.ulg",), ""),
    "why": (("none.mcap",), "mcap"),
    "fusion": (("none.ulg",), ""),
    "health": (("-c", _CLOSED), ""),
    "doctor": (("-c", _CLOSED), ""),
    "check": ((), ""),
    "export": (("-c", _CLOSED), "metrics"),
    "schema": ((), ""),
    "ros2": (("-c", _CLOSED), ""),
    "foxglove": (("-c", _CLOSED), "foxglove"),
    "web": (("-c", _CLOSED), "web"),
    "record": (("-c", _CLOSED, "-o", "new.mcap"), "mcap"),
    "convert": (("none.ulg", "new.mcap"), "mcap"),
    "plot": (("none.ulg",), "plot"),
    "pki ca": (("keys",), "pki"),
    "pki cert": (("keys", "reader"), "pki"),
    "pki enroll": (("keys", "1", "-r", "tls/127.0.0.1:7447"), "pki"),
    "pki list": (("keys",), "pki"),
    "pki renew": (("keys",), "pki"),
    "pki rules": (("--help",), ""),
}  # fmt: skip


class Case(NamedTuple):
    """Arguments, the expected exit codes, and the extra that the one line on stderr names; "" for none."""

    arguments: tuple[str, ...]
    codes: frozenset[int]
    extra: str = ""


def command_names() -> list[str]:
    """Return all commands of the application, those of groups with the name of the group."""
    import typer

    from nedbus.cli.app import make_app

    group: Any = typer.main.get_command(make_app())
    names = []
    for name, command in group.commands.items():
        inner = getattr(command, "commands", None)
        names += [name] if inner is None else [f"{name} {each}" for each in inner]
    return names


def cases(names: Iterable[str], extras: Sequence[str]) -> Iterator[Case]:
    """Yield what is run: help, a misspelt command, and each command with and without --help."""
    yield Case((), frozenset({0, 2}))
    yield Case(("--help",), frozenset({0}))
    yield Case(("lits",), frozenset({2}))
    yield Case(("pki", "--help"), frozenset({0}))
    for name in names:
        yield Case((*name.split(), "--help"), frozenset({0}))
        arguments, extra = RUNS[name]
        if extra and extra not in extras:
            yield Case((*name.split(), *arguments), frozenset({2}), extra)
        else:
            yield Case((*name.split(), *arguments), frozenset({0, 1, 2}))


def problem_of(case: Case, code: int, out: str, err: str) -> str:
    """Return what is wrong with the result of a run; "" if nothing is."""
    shown = f"nedbus {' '.join(case.arguments)}: exit {code}\n{out}{err}"
    if "Traceback" in out + err or code not in case.codes:
        return shown
    if case.extra and (len(err.splitlines()) != 1 or f".[{case.extra}]" not in err):
        return f"{shown}expected one line that names the extra {case.extra}"
    if not case.extra and "not installed" in out + err:
        return f"{shown}expected no word about a package"
    return ""


class _Blocked(MetaPathFinder):
    """Reject the import of installed packages that are not among the allowed ones."""

    def __init__(self, allowed: frozenset[str]) -> None:
        self._blocked = frozenset(metadata.packages_distributions()) - allowed

    def find_spec(self, name: str, path: object = None, target: object = None) -> None:
        if name.partition(".")[0] in self._blocked:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)


def allowed_packages(extras: Iterable[str]) -> frozenset[str]:
    """Return the names that can be imported after `pip install nedbus[extras]`, from the metadata of the packages."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    waiting = [*project["dependencies"]]
    for extra in extras:
        waiting += project["optional-dependencies"][extra]
    distributions = set[str]()
    while waiting:
        requirement = waiting.pop()
        name = re.match(r"[A-Za-z0-9._-]+", requirement)
        if name is None or "extra ==" in requirement or _normalized(name[0]) in distributions:
            continue
        distributions.add(_normalized(name[0]))
        try:
            waiting += metadata.requires(name[0]) or []
        except metadata.PackageNotFoundError:  # for another platform
            continue
    names = metadata.packages_distributions()
    return frozenset(
        name for name, owners in names.items() if distributions & set(map(_normalized, owners))
    )


def _normalized(distribution: str) -> str:
    return re.sub(r"[-_.]+", "-", distribution).lower()


def _start(case: Case, folder: Path) -> int:
    """Run a command in a forked process, in `folder`; its output goes to files there."""
    folder.mkdir()
    pid = os.fork()
    if pid:
        return pid
    code = 99
    try:
        os.chdir(folder)
        for number, name in ((1, "out"), (2, "err")):
            os.dup2(os.open(name, os.O_WRONLY | os.O_CREAT), number)
        sys.argv = ["nedbus", *case.arguments]
        from nedbus.cli import main

        try:
            main()
            code = 0
        except SystemExit as exc:
            code = exc.code if isinstance(exc.code, int) else int(exc.code is not None)
    except BaseException:  # noqa: BLE001 - the forked process must end here
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            stream.flush()
        os._exit(code)


def problems(extras: Sequence[str]) -> list[str]:
    """Run all commands at the same time; return what is wrong."""
    import nedbus.client
    import nedbus.settings  # noqa: F401 - loaded once, before the fork

    names = command_names()
    if unknown := set(names) ^ set(RUNS):
        return [f"RUNS does not have the commands of nedbus: {', '.join(sorted(unknown))}"]
    found = []
    with tempfile.TemporaryDirectory() as temporary:
        started = []
        for number, case in enumerate(cases(names, extras)):
            folder = Path(temporary, str(number))
            started.append((case, folder, _start(case, folder)))
        for case, folder, pid in started:
            code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
            found.append(
                problem_of(case, code, (folder / "out").read_text(), (folder / "err").read_text())
            )
    return [problem for problem in found if problem]


def main() -> int:
    """Run all commands; print what is wrong, and return the exit code."""
    arguments = sys.argv[1:]
    extras = [each for each in arguments if not each.startswith("-")]
    if "--block" in arguments:
        sys.meta_path.insert(0, _Blocked(allowed_packages(extras) | {"nedbus", "nedbus_msgs"}))
    start = time.monotonic()
    wrong = problems(extras)
    for problem in wrong:
        print(problem, file=sys.stderr)
    print(
        f"{len(RUNS)} commands with extras {extras}: {len(wrong)} problems, {time.monotonic() - start:.1f} s"
    )
    return 1 if wrong else 0


if __name__ == "__main__":
    raise SystemExit(main())
