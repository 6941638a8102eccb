"""The processes of a fleet: routers, vehicles, a link, readers; and what may happen to them on a bad day."""

from __future__ import annotations

import contextlib
import json
import signal
import socket
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Final

import psutil

from .fleet_plan import Plan
from .processes import ROOT, Process, end, expect, start, wait_for_router
from .soak_report import Look

DOWN: Final = 2.0  # s that a router is away
CUT: Final = 10.0  # s that the link is cut, and that a reader stands still
PATIENCE: Final = 300.0  # s that a process may take to do what it is told
_LOOK: Final = 0.5  # s between two looks at all processes
# Whatever `start` starts is Python: this one becomes another program.
_BECOME: Final = "import os, sys; os.execv(sys.argv[1], sys.argv[1:])"


class Fleet:
    """All processes; `looks` is what was seen of them."""

    def __init__(self, plan: Plan, folder: Path) -> None:
        self.looks: list[Look] = []
        self.plan = plan
        self._folder = folder
        self._ports = [_free_port() for _ in range(plan.routers + 1)]
        self.endpoints = [f"tcp/127.0.0.1:{port}" for port in self._ports[:-1]]
        self.processes: dict[str, Process] = {}
        self._spent: dict[str, float] = {}  # s of processor of those that have ended
        self.epoch = time.time()
        self._begin = time.monotonic()
        self._lock = threading.Lock()
        self._ended = threading.Event()
        threading.Thread(target=self._watch, daemon=True).start()

    def open(self) -> float:
        """Start all processes, and return how long the slowest part of the vehicles took to be declared, in s."""
        for number in range(self.plan.routers):
            self._start_router(number)
        self.add_reader("all", "*", 0)
        self.add_reader("one", "v0", 1)
        recording = [sys.executable, "-m", "nedbus", "record", "-c", self.endpoints[-1], "-o", str(self.recording)]
        with self.recorder_log.open("w") as log:
            self.processes["recorder"] = subprocess.Popen(
                recording, stdin=subprocess.PIPE, stdout=log, stderr=log, text=True
            )
        while not self.recording.exists():  # nothing else tells that it has begun
            time.sleep(0.1)
        link = None
        if "link" in self.plan.events:
            link = f"tcp/127.0.0.1:{self._ports[-1]}"
            self.processes["link"] = start("-m", "benchmarks.fleet_link", *map(str, (self._ports[-1], self._ports[0])))
            expect(self.processes["link"])
        for number, part in enumerate(self.plan.parts(self.endpoints, link)):
            process = self.processes[f"vehicles {number}"] = start("-m", "benchmarks.fleet_vehicles")
            say(process, json.dumps(part.as_json()))
        return max(float(expect(process, PATIENCE)) for process in self.vehicles)

    @property
    def recording(self) -> Path:
        """The file of the recorder."""
        return self._folder / "fleet.mcap"

    @property
    def recorder_log(self) -> Path:
        """What the recorder says, at its end how many messages were lost or dropped."""
        return self._folder / "recorder.log"

    @property
    def vehicles(self) -> list[Process]:
        """The processes of the vehicles."""
        return [process for name, process in self.processes.items() if name.startswith("vehicles")]

    @property
    def readers(self) -> dict[str, Process]:
        """The readers that report, by name."""
        return {name: self.processes[name] for name in ("all", "one", "late") if name in self.processes}

    def add_reader(self, name: str, vehicle: str, router: int) -> None:
        """Start a reader that joins this router, and knows the others."""
        first = router % len(self.endpoints)
        known = [*self.endpoints[first:], *self.endpoints[:first]]
        self.processes[name] = start("-m", "benchmarks.fleet_reader", vehicle, *known)
        expect(self.processes[name])

    def happen(self, event: str) -> float:
        """Let this happen, and return when it was over, in s since the epoch."""
        match event:
            case "router" | "routers":
                numbers = range(self.plan.routers if event == "routers" else 1)
                for number in numbers:
                    self._kill(f"router {number}")
                time.sleep(DOWN)
                for number in numbers:
                    self._start_router(number)
            case "link":
                say(self.processes["link"], "cut")
                time.sleep(CUT)
                say(self.processes["link"], "join")
            case "restart":
                say(self.vehicles[-1], "restart")
            case "late":
                since = time.time()
                self.add_reader("late", "*", self.plan.routers - 1)
                return since
            case "stuck":
                reader = self.processes["late" if "late" in self.processes else "one"]
                reader.send_signal(signal.SIGSTOP)
                time.sleep(CUT)
                reader.send_signal(signal.SIGCONT)
        return time.time()

    def link_bytes(self) -> dict[str, int]:
        """Return what passed the link so far; nothing without a link."""
        if "link" not in self.processes:
            return {}
        say(self.processes["link"], "count")
        counted: dict[str, int] = json.loads(expect(self.processes["link"]))
        return counted

    def close(self) -> None:
        """End all that still runs."""
        self._ended.set()
        for process in self.processes.values():
            process.send_signal(signal.SIGCONT)
            if process.poll() is None:
                process.terminate()
        end(*self.processes.values(), patience=10.0)

    def _start_router(self, number: int) -> None:
        listen, others = self.endpoints[number], self.endpoints[:number]
        config = self.plan.router_config
        if self.plan.zenohd is None:
            joins = [part for other in others for part in ("--connect", other)]
            process = start("-m", "nedbus", "router", *([config] if config else []), "--listen", listen, *joins)
        else:
            joins = [part for other in others for part in ("-e", other)]
            path, chosen = str(Path(self.plan.zenohd).resolve()), config or str(ROOT / "config" / "router.json5")
            arguments = [path, "-c", chosen, "-l", listen, *joins]
            process = start("-c", _BECOME, *arguments, environment={"RUST_LOG": "error"})
        wait_for_router(self._ports[number], process)
        self.processes[f"router {number}"] = process

    def _kill(self, name: str) -> None:
        with self._lock:
            process = self.processes.pop(name)
            self._spent[name] = self._look(name, process)
            process.kill()
            end(process)

    def _watch(self) -> None:
        while not self._ended.wait(_LOOK):
            with self._lock:
                for name, process in self.processes.copy().items():
                    self._look(name, process)

    def _look(self, name: str, process: Process) -> float:
        """Look at a process, and return its processor time with that of its predecessors, 0 if it has ended."""
        with contextlib.suppress(psutil.Error):
            seen = psutil.Process(process.pid)
            if seen.status() == psutil.STATUS_ZOMBIE:
                return self._spent.get(name, 0.0)
            with seen.oneshot():
                cpu = sum(seen.cpu_times()[:2]) + self._spent.get(name, 0.0)
                memory = seen.memory_info().rss / 2**20
                time_ = round(time.monotonic() - self._begin)
                self.looks.append(Look(name, process.pid, time_, memory, seen.num_threads(), seen.num_fds(), cpu))
            return cpu
        return 0.0

    def cpu(self) -> dict[str, float]:
        """Return the processor time of each process so far, in s, with that of those that were killed."""
        with self._lock:
            return {name: self._look(name, process) for name, process in self.processes.items()}


def say(process: Process, line: str) -> None:
    """Write a line to a process; one that has ended hears nothing."""
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError):
        process.stdin.write(line + "\n")
        process.stdin.flush()


def _free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port: int = free.getsockname()[1]
    return port
