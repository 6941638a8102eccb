"""The shipped compose files, run through the command line of Docker."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.peers.ports import free_endpoint
from tests.peers.processes import Process

ROOT = Path(__file__).parents[2]
ENVIRONMENT = dict(os.environ)  # before any test changes it: NEDBUS_BASE_IMAGE, NEDBUS_ROUTER_IMAGE
# router image built by the tests, if the official one cannot be pulled
SUBSTITUTE_ROUTER = "nedbus-router"
DEADLINE = 300.0  # timeout of one Docker command [s]


def find_compose() -> list[str]:
    """Return the compose command: docker-compose from this environment or the PATH, or the Docker plugin."""
    local = Path(sys.executable).with_name("docker-compose")
    if local.exists():
        return [str(local)]
    found = shutil.which("docker-compose")
    return [found] if found else ["docker", "compose"]


def require_docker() -> None:
    """Skip the test if Docker is missing; fail instead if NEDBUS_REQUIRE_DOCKER is 1."""
    try:
        for command in (["docker", "version"], [*find_compose(), "version"]):
            subprocess.run(command, check=True, capture_output=True, timeout=DEADLINE)
    except (OSError, subprocess.SubprocessError) as exc:
        reason = f"Docker with compose is not available: {exc}"
        if ENVIRONMENT.get("NEDBUS_REQUIRE_DOCKER") == "1":
            pytest.fail(reason)
        pytest.skip(reason)


def docker(*arguments: str) -> str:
    """Run docker and return its stdout."""
    return _run(["docker", *arguments], ENVIRONMENT)


class Stack:
    """A compose project with its router on a free port of loopback; `down` removes it.

    `files`: relative to the repository; paths in them are relative to `directory`.
    """

    def __init__(
        self, name: str, where: Path, *files: str, directory: Path = ROOT, **environment: str
    ) -> None:
        self.name = f"nedbus-test-{os.getpid()}-{name}"
        self.address = free_endpoint().removeprefix("tcp/")
        self._where = where
        self._runs: list[Process] = []
        self._environment = ENVIRONMENT | {"NEDBUS_PUBLISH": self.address, **environment}
        chosen = files or ("docker-compose.yml",)
        self._command = [
            *find_compose(),
            "--project-name",
            self.name,
            "--project-directory",
            str(directory),
        ]
        for file in chosen:
            self._command += ["--file", str(ROOT / file)]

    @property
    def endpoint(self) -> str:
        """Endpoint of the router on the host."""
        return f"tcp/{self.address}"

    def compose(self, *arguments: str) -> str:
        """Run a compose command and return its stdout."""
        return _run([*self._command, *arguments], self._environment)

    def up(self, *services: str) -> None:
        """Start services, by default all without a profile."""
        self.compose("up", "--detach", "--no-build", *services)

    def run(self, service: str, *arguments: str, options: tuple[str, ...] = ()) -> Process:
        """Start another container of a service with these arguments as its command."""
        where = self._where / f"{self.name}-{len(self._runs)}"
        where.mkdir()
        flags = ("--rm", "--no-deps", "--no-TTY", *options)
        self._runs.append(
            Process([*self._command, "run", *flags, service, *arguments], where, self._environment)
        )
        return self._runs[-1]

    def container(self, service: str) -> str:
        """Return the id of a service's container."""
        return self.compose("ps", "--all", "--quiet", service).strip()

    def inspect(self, service: str) -> dict[str, Any]:
        """Return the output of `docker inspect` for a service's container."""
        content: list[dict[str, Any]] = json.loads(docker("inspect", self.container(service)))
        return content[0]

    def health(self, service: str) -> str:
        """Return the health status of a service's container."""
        return str(self.inspect(service)["State"]["Health"]["Status"])

    def network(self, name: str) -> str:
        """Return the full name of one of the project's networks."""
        return f"{self.name}_{name}"

    def down(self) -> None:
        """Remove all containers and networks of this project."""
        label = f"label=com.docker.compose.project={self.name}"
        left = docker("ps", "--all", "--quiet", "--filter", label).split()
        if left:
            docker("rm", "--force", "--volumes", *left)
        networks = docker("network", "ls", "--quiet", "--filter", label).split()
        if networks:
            docker("network", "rm", *networks)
        for process in self._runs:
            process.kill()


def _run(command: list[str], environment: dict[str, str]) -> str:
    done = subprocess.run(
        command,
        capture_output=True,
        text=True,
        timeout=DEADLINE,
        env=environment,
        cwd=ROOT,
        check=False,
    )
    assert done.returncode == 0, f"{' '.join(command)}\n{done.stdout}{done.stderr}"
    return done.stdout
