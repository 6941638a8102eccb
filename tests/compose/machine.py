"""A container that boots a real systemd, with nedbus installed as in docs/systemd.md."""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path

import pytest

from tests.waits import wait_for

from .stack import DEADLINE, ENVIRONMENT, ROOT, docker

IMAGE = "nedbus-systemd"
# Privileges that systemd needs to create namespaces for services; devices and processes of the host stay hidden.
PRIVILEGES = (
    *(
        "--cgroupns=private",
        "--cap-add=SYS_ADMIN",
        "--cap-add=SYS_PTRACE",
        "--security-opt=seccomp=unconfined",
    ),
    *("--security-opt=apparmor=unconfined", "--security-opt=systempaths=unconfined"),
    *("--tmpfs=/run", "--tmpfs=/run/lock", "--tmpfs=/tmp"),
)


class Machine:
    """A container with systemd, based on the image of nedbus, which must exist; `remove` deletes it."""

    def __init__(self) -> None:
        base = ENVIRONMENT.get("NEDBUS_BASE_IMAGE")
        build_arg = ("--build-arg", f"NEDBUS_BASE_IMAGE={base}") if base else ()
        docker(
            "build",
            "--quiet",
            "--tag",
            IMAGE,
            *build_arg,
            str(ROOT / "tests" / "compose" / "systemd"),
        )
        self.name = f"nedbus-test-{os.getpid()}-systemd"
        docker("run", "--detach", "--name", self.name, *PRIVILEGES, IMAGE)

    def wait_until_booted(self) -> None:
        """Wait for the end of the boot; skip the test if systemd cannot run here, or fail if Docker is required."""
        try:
            wait_for(
                lambda: self.call("systemctl is-system-running").stdout.strip() == "running",
                what="the boot",
            )
        except AssertionError as exc:
            failed = self.call("systemctl list-units --failed --no-pager")
            reason = f"systemd does not run in a container here: {exc}: {failed.stdout}{failed.stderr}{self._logs()}"
            if ENVIRONMENT.get("NEDBUS_REQUIRE_DOCKER") == "1":
                pytest.fail(reason)
            pytest.skip(reason)

    def call(self, command: str) -> subprocess.CompletedProcess[str]:
        """Run a shell command as root and return the completed process."""
        full = ["docker", "exec", self.name, "sh", "-c", command]
        return subprocess.run(
            full, capture_output=True, text=True, timeout=DEADLINE, env=ENVIRONMENT, check=False
        )

    def run(self, command: str) -> str:
        """Run a shell command as root and return its stdout; fail with its output and the journal."""
        done = self.call(command)
        assert done.returncode == 0, (
            f"{command}\n{done.stdout}{done.stderr}{self.call('journalctl -n 30').stdout}"
        )
        return done.stdout

    def copy(self, file: Path, where: str) -> None:
        """Copy a file or a folder from the host."""
        docker("cp", str(file), f"{self.name}:{where}")

    def write(self, text: str, where: str) -> None:
        """Write a file owned by root and readable by all."""
        with tempfile.NamedTemporaryFile("w") as file:
            file.write(text)
            file.flush()
            Path(file.name).chmod(0o644)
            self.copy(Path(file.name), where)

    def property(self, name: str, unit: str = "nedbus") -> str:
        """Return a property of a unit."""
        return self.run(f"systemctl show --value --property {name} {unit}").strip()

    def journal(self, unit: str = "nedbus") -> str:
        """Return the journal of a unit."""
        return self.run(f"journalctl --no-pager --unit {unit}")

    def reboot(self) -> None:
        """Restart the container, which shuts systemd down and boots it again."""
        docker("restart", self.name)

    def remove(self) -> None:
        """Remove the container."""
        docker("rm", "--force", "--volumes", self.name)

    def _logs(self) -> str:
        done = subprocess.run(
            ["docker", "logs", self.name],
            capture_output=True,
            text=True,
            env=ENVIRONMENT,
            check=False,
        )
        return done.stdout + done.stderr
