"""Follow README.md literally in a fresh clone: `python -m tests.release.follow_readme`.

Each command of "Start", "Your vehicle", "Everyday commands" and "Other hosts" runs in the environment that the page
has made so far. A block, or a command in the text, without a handler here is an error. The ports of the page must be
free: 7447, 8420 and 9464.
"""

from __future__ import annotations

import os
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import Final

from tests.documents import ROOT, Block, blocks_of

SECTIONS: Final = ("Start", "Your vehicle", "Everyday commands", "Other hosts, and containers")
_INSTALL: Final = 600.0  # s for pip, which may download 200 MB
_WAIT: Final = 60.0  # s for a line of output
_ENDED: Final = frozenset({0, 130, -signal.SIGINT})  # exit codes after Ctrl-C
_COMMAND: Final = re.compile(r"`((?:nedbus|pip|make|docker) [^`]+)`")
# In the text: run below, or by other tests.
_IN_TEXT: Final = {
    "make run": "run by the first block",
    'pip install -e ".[mavlink]"': "run by `_your_vehicle`",
    "docker compose --profile demo up": "run by tests/compose",
    "make wheel": "run by .ci/run",
}
_POSITION: Final = re.compile(r"1 -?[0-9.]+ m north, -?[0-9.]+ m east, -?[0-9.]+ m up")


class Clone:
    """A clone of this checkout; commands run in it, with the environment of a user who has just logged in."""

    def __init__(self, folder: Path) -> None:
        self.path = folder / "nedbus"
        self._output = folder / "output"
        self._number = 0
        kept = (
            "HOME",
            "PATH",
            "LANG",
            "TMPDIR",
            "PIP_CONFIG_FILE",
            "PIP_INDEX_URL",
            "PIP_CERT",
            "SSL_CERT_FILE",
        )
        self._environment = {name: value for name, value in os.environ.items() if name in kept}
        self._environment["PATH"] = os.pathsep.join(
            each
            for each in self._environment["PATH"].split(os.pathsep)
            if not each.startswith(str(ROOT))
        )
        subprocess.run(["git", "clone", "-q", ROOT, self.path], check=True)

    def run(
        self, command: str, *, codes: frozenset[int] = frozenset({0}), seconds: float = _WAIT
    ) -> str:
        """Run a command to its end; return its output."""
        with self.start(command) as (process, read):
            try:
                code = process.wait(seconds)
            except subprocess.TimeoutExpired:
                raise AssertionError(f"{command}: does not end\n{read()}") from None
            check(code in codes and "Traceback" not in read(), f"{command}: exit {code}\n{read()}")
            return read()

    def run_until(self, command: str, text: str, *, seconds: float = _WAIT) -> None:
        """Run a command until its output matches a regular expression, then press Ctrl-C."""
        with self.running(command, text, seconds=seconds):
            pass

    @contextmanager
    def running(self, command: str, text: str, *, seconds: float = _WAIT) -> Iterator[None]:
        """Run a command whose output soon matches `text`; press Ctrl-C at the end of the block."""
        with self.start(command) as (process, read):
            end = time.monotonic() + seconds
            while not re.search(text, read()):
                check(process.poll() is None, f"{command}: exit {process.returncode}\n{read()}")
                check(time.monotonic() < end, f"{command}: no {text!r} in its output\n{read()}")
                time.sleep(0.05)
            yield
            os.killpg(process.pid, signal.SIGINT)
            code = process.wait(_WAIT)
            check(
                code in _ENDED and "Traceback" not in read(),
                f"{command}: exit {code} after Ctrl-C\n{read()}",
            )

    @contextmanager
    def start(self, command: str) -> Iterator[tuple[subprocess.Popen[bytes], Callable[[], str]]]:
        """Start a command in bash; the second value reads its output so far."""
        print(f"$ {command}", flush=True)
        self._number += 1
        log = Path(f"{self._output}-{self._number}")
        with log.open("wb") as written:
            process = subprocess.Popen(
                ["bash", "-c", command], cwd=self.path, env=self._environment, stdin=subprocess.DEVNULL,
                stdout=written, stderr=written, start_new_session=True,
            )  # fmt: skip
        try:
            yield process, lambda: log.read_text(errors="replace")
        finally:
            with suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def check(holds: bool, text: str) -> None:
    """Raise AssertionError with this text unless `holds`."""
    if not holds:
        raise AssertionError(text)


def activated(command: str) -> str:
    """Return a command for a terminal in which the virtual environment of the page is active."""
    return f"source .venv/bin/activate && {command}"


def section(title: str) -> tuple[list[Block], str]:
    """Return the blocks and the text of a section of README.md."""
    readme = ROOT / "README.md"
    lines = readme.read_text().splitlines()
    start = lines.index(f"## {title}") + 1
    end = next(index for index in range(start, len(lines)) if lines[index].startswith("## "))
    return [block for block in blocks_of(readme) if start < block.line <= end], "\n".join(
        lines[start:end]
    )


def _start(clone: Clone, blocks: list[Block], service: ExitStack) -> None:
    make_run, position, script, output, web = blocks
    check(make_run.text == "make run\n", f"{make_run}: no handler")
    service.enter_context(clone.running("make run", "In a second terminal", seconds=_INSTALL))
    check(
        script.text == (ROOT / "examples/position.py").read_text(),
        f"{script}: differs from the example",
    )
    check(bool(_POSITION.match(output.text)), f"{output}: no position")
    (command,) = position.commands
    clone.run_until(command, _POSITION.pattern)
    (command,) = web.commands
    address = "http://127.0.0.1:8420"
    opened = clone.running(command, f"open {address}", seconds=_INSTALL)
    with opened, urllib.request.urlopen(address, timeout=_WAIT) as page:
        check(b"nedbus" in page.read(), f"{address} is not the page")


def _your_vehicle(clone: Clone, blocks: list[Block], _: ExitStack) -> None:
    (serve,) = blocks
    shutil.copy(ROOT / "tests/data/boot_time_utc_us.ulg", clone.path / "flight.ulg")
    mavlink = [command for command in serve.commands if "mavlink:" in command]
    for command in mavlink:
        shown = clone.run(activated(command), codes=frozenset({2}))
        check(
            len(shown.splitlines()) == 1 and ".[mavlink]" in shown,
            f"{command} without the extra: {shown}",
        )
    clone.run(activated('pip install -e ".[mavlink]"'), seconds=_INSTALL)
    for command in serve.commands:
        check(command.startswith("nedbus serve --source "), f"{serve}: no handler for {command!r}")
        started = "waiting|listening|flight.ulg: "
        clone.run_until(activated(command), started)


def _everyday_commands(clone: Clone, blocks: list[Block], service: ExitStack) -> None:
    check(not blocks, f"{blocks}: no handler")
    text = section("Everyday commands")[1]
    commands = re.findall(r"^\| `(nedbus [^`]+)` \|", text, re.MULTILINE)
    service.enter_context(clone.running("make run", "In a second terminal"))
    endless = {
        "nedbus echo": "vehicle_local_position|m north",
        "nedbus hz": "1/vehicle_local_position",
    }
    for command in commands:
        if command in endless:
            clone.run_until(activated(command), endless[command])
        elif command == "nedbus check":  # the settings of a host: those of `make run` are options
            clone.run(activated(command), codes=frozenset({2}))
            (clone.path / "nedbus.toml").write_text('source = ["sim:"]\n')
            clone.run(activated(command))
            (clone.path / "nedbus.toml").unlink()
        else:
            clone.run(activated(command))
    clone.run_until(activated("nedbus echo --csv"), "timestamp")


def _other_hosts(clone: Clone, blocks: list[Block], _: ExitStack) -> None:
    (block,) = blocks
    serve, echo = block.commands
    remote = re.sub(r"tcp/192\.168\.1\.5:", "tcp/127.0.0.1:", echo)
    check(remote != echo and remote.startswith("nedbus echo "), f"{block}: no handler for {echo!r}")
    check(
        "there, after pip install /path/to/the/clone" in block.text,
        f"{block}: names another install line",
    )
    other = clone.path.parent / "other"
    clone.run(f"python3 -m venv {other} && {other}/bin/pip install {clone.path}", seconds=_INSTALL)
    with clone.running(activated(serve), "router on"):
        clone.run_until(f"source {other}/bin/activate && {remote}", "vehicle_local_position|1 ")


def main() -> None:
    """Follow the page; print each command, and raise AssertionError at the first fault."""
    # Ctrl-C ends its commands also in a background job of a script, which ignores it
    signal.signal(signal.SIGINT, signal.default_int_handler)
    handlers = dict(
        zip(SECTIONS, (_start, _your_vehicle, _everyday_commands, _other_hosts), strict=True)
    )
    begin = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        clone = Clone(Path(folder))
        for title, follow in handlers.items():
            blocks, text = section(title)
            unknown = [
                each
                for each in _COMMAND.findall(text)
                if each not in _IN_TEXT and f"| `{each}` |" not in text
            ]
            check(not unknown, f"README.md, {title}: no handler for {unknown}")
            # ends with its section: the page stops it before the next one
            with ExitStack() as service:
                follow(clone, blocks, service)
    print(f"README.md: all commands of {', '.join(SECTIONS)} run, {time.monotonic() - begin:.0f} s")


if __name__ == "__main__":
    try:
        main()
    except AssertionError as exc:
        sys.exit(str(exc))
