"""A night in short: python -m benchmarks.soak HOURS.

A service publishes vehicles of all four topics through a router that is killed every ten minutes and started again two
seconds later. A reader of every message, a recorder and an exporter run all the time; a passing reader comes every
20 s, takes some messages and goes.
Every process is looked at every ten seconds: memory (RSS), threads, file descriptors, processor.
At the end each message that was published is accounted for, by the reader and in the recording.

The bars: memory of each process at the end within 5 % of that after ten minutes; no thread and no descriptor more; no
message that is neither received nor counted as lost.
The results are written to build/soak.json, build/soak.png and, as a table, to the terminal.
"""

from __future__ import annotations

import argparse
import json
import re
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Final

import psutil
from mcap.reader import make_reader

from .processes import ROOT, Process, end, expect, start, tell, wait_for_router
from .soak_report import Look, print_table, write_results

PORT: Final = 17492
ENDPOINT: Final = f"tcp/127.0.0.1:{PORT}"
EVERY: Final = 10.0  # s between two looks
KILL_EVERY: Final = 600.0  # s between two deaths of the router
DOWN: Final = 2.0  # s that it is away
PASS_EVERY: Final = 20.0  # s between two passing readers
ENDS: Final = 120.0  # s that all have to end


def main() -> None:
    """Run for so many hours, and print what was found."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("hours", type=float)
    parser.add_argument("--vehicles", type=int, default=5)
    parser.add_argument("--kill-every", type=float, default=KILL_EVERY, metavar="SECONDS")
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as folder:
        soak = Soak(Path(folder), seconds=arguments.hours * 3600, vehicles=arguments.vehicles)
        try:
            soak.run(arguments.kill_every)
            found = soak.account()
        finally:
            soak.end()
    write_results(ROOT / "build", soak.looks, found)
    print_table(soak.looks, found)


class Soak:
    """The processes, and what was seen of them."""

    def __init__(self, folder: Path, *, seconds: float, vehicles: int) -> None:
        self.looks: list[Look] = []
        self._seconds = seconds
        self._folder = folder
        self._recording, self._log = folder / "soak.mcap", folder / "service.log"
        self._routers = self._passed = self._failed = 0
        self._router = self._start_router()
        self._reader = start("-m", "benchmarks.soak_reader", ENDPOINT)
        expect(self._reader)
        self._recorder = start("-m", "nedbus", "record", "-c", ENDPOINT, "-o", str(self._recording))
        self._exporter = start("-m", "nedbus", "export", "-c", ENDPOINT, "--http", "127.0.0.1:17493")
        time.sleep(3.0)
        sources = [f"sim:?vehicle={number}&duration={seconds:.0f}" for number in range(vehicles)]
        command = ["serve", "-c", ENDPOINT, "--until-done", "--http", "127.0.0.1:17494"]
        with self._log.open("w") as log:
            self._service = subprocess.Popen(
                [sys.executable, "-m", "nedbus", *command, *(part for source in sources for part in ("-s", source))],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=log,
                text=True,
            )
        self._passing: list[Process] = []

    def run(self, kill_every: float) -> None:
        """Watch until the service has published all."""
        begin = time.monotonic()
        next_look, next_kill, next_pass = begin + EVERY, begin + kill_every, begin + PASS_EVERY
        while self._service.poll() is None and time.monotonic() < begin + self._seconds + ENDS:
            time.sleep(0.2)
            now = time.monotonic()
            if now >= next_look:
                next_look += EVERY
                self._look(now - begin)
            if now >= next_pass:
                next_pass += PASS_EVERY
                self._pass_by()
            if now >= next_kill:
                next_kill += kill_every
                self._router.kill()
                end(self._router)
                time.sleep(DOWN)
                self._router = self._start_router()

    def account(self) -> dict[str, object]:
        """Return what became of all messages."""
        end(self._service, patience=ENDS)
        published = sum(map(int, re.findall(r"done, (\d+) published", self._log.read_text())))
        tell(self._reader)
        read = json.loads(expect(self._reader))
        self._recorder.send_signal(signal.SIGTERM)
        end(self._recorder, patience=ENDS)
        with self._recording.open("rb") as file:
            summary = make_reader(file).get_summary()
        recorded = summary.statistics.message_count if summary and summary.statistics else 0
        return {
            "hours": self._seconds / 3600,
            "published": published,
            "received": read["received"],
            "lost": read["lost"],
            "dropped": read["dropped"],
            "out of order": read["out of order"],
            "unaccounted": published - read["received"] - read["lost"] - read["dropped"],
            "recorded": recorded,
            "routers": self._routers,
            "passing readers": self._passed,
            "of these failed": self._failed,
        }

    def end(self) -> None:
        """End what still runs."""
        processes = [self._service, self._reader, self._recorder, self._exporter, self._router, *self._passing]
        for process in processes:
            if process.poll() is None:
                process.terminate()
        end(*processes, patience=5.0)

    def _start_router(self) -> Process:
        self._routers += 1
        process = start("-m", "nedbus", "router", "--listen", ENDPOINT)
        wait_for_router(PORT, process)
        return process

    def _pass_by(self) -> None:
        for process in [each for each in self._passing if each.poll() is not None]:
            self._passing.remove(process)
            self._failed += process.returncode != 0
        self._passed += 1
        mode = "--every" if self._passed % 2 else "--interval=0"
        self._passing.append(start("-m", "nedbus", "echo", "-c", ENDPOINT, mode, "-n", "300", "--wait"))

    def _look(self, time_: float) -> None:
        processes = {
            "router": self._router,
            "service": self._service,
            "reader": self._reader,
            "recorder": self._recorder,
            "exporter": self._exporter,
        }
        for name, process in processes.items():
            try:
                seen = psutil.Process(process.pid)
                with seen.oneshot():
                    cpu = sum(seen.cpu_times()[:2])
                    memory = seen.memory_info().rss / 2**20
                    look = Look(name, process.pid, round(time_), memory, seen.num_threads(), seen.num_fds(), cpu)
            except psutil.Error:
                continue
            self.looks.append(look)


if __name__ == "__main__":
    main()
