"""A container that boots a real systemd, in which nedbus is installed as docs/systemd.md says."""

from __future__ import annotations

import os
import subprocess
import tempfile
from pathlib import Path

import pytest

from tests.waits import wait_for

from .stack import DEADLINE, ENVIRONMENT, ROOT, docker

IMAGE = "nedbus-systemd"
# What a systemd needs to give services namespaces of their own; of devices and other hosts' processes it sees nothing.
RIGHTS = (
    *("--cgroupns=private", "--cap-add=SYS_ADMIN", "--cap-add=SYS_PTRACE", "--security-opt=seccomp=unconfined"),
    *("--security-opt=apparmor=unconfined", "--security-opt=systempaths=unconfined"),
    *("--tmpfs=/run", "--tmpfs=/run/lock", "--tmpfs=/tmp"),
)


class Machine:
    """A machine with systemd, on top of the image of nedbus, which must be there; `remove` leaves nothing behind."""

    def __init__(self) -> None:
        base = ENVIRONMENT.get("NEDBUS_BASE_IMAGE")
        given = ("--build-arg", f"NEDBUS_BASE_IMAGE={base}") if base else ()
        docker("build", "--quiet", "--tag", IMAGE, *given, str(ROOT / "tests" / "compose" / "systemd"))
        self.name = f"nedbus-test-{os.getpid()}-systemd"
        docker("run", "--detach", "--name", self.name, *RIGHTS, IMAGE)

    def wait_until_booted(self) -> None:
        """Wait for the end of the boot; skip where a systemd cannot run, or fail where Docker is required."""
        try:
            wait_for(lambda: self.call("systemctl is-system-running").stdout.strip() == "running", what="the boot")
        except AssertionError as exc:
            said = self.call("systemctl list-units --failed --no-pager")
            reason = f"no systemd runs in a container here: {exc}: {said.stdout}{said.stderr}{self._said()}"
            if ENVIRONMENT.get("NEDBUS_REQUIRE_DOCKER") == "1":
                pytest.fail(reason)
            pytest.skip(reason)

    def call(self, command: str) -> subprocess.CompletedProcess[str]:
        """Run a command line as root and return what became of it."""
        whole = ["docker", "exec", self.name, "sh", "-c", command]
        return subprocess.run(whole, capture_output=True, text=True, timeout=DEADLINE, env=ENVIRONMENT, check=False)

    def run(self, command: str) -> str:
        """Run a command line as root, and return what it printed; fail with what it and the service said."""
        done = self.call(command)
        assert done.returncode == 0, f"{command}\n{done.stdout}{done.stderr}{self.call('journalctl -n 30').stdout}"
        return done.stdout

    def copy(self, file: Path, where: str) -> None:
        """Copy a file or a folder from the host."""
        docker("cp", str(file), f"{self.name}:{where}")

    def write(self, text: str, where: str) -> None:
        """Write a file that belongs to root, and that everybody may read."""
        with tempfile.NamedTemporaryFile("w") as file:
            file.write(text)
            file.flush()
            Path(file.name).chmod(0o644)
            self.copy(Path(file.name), where)

    def property(self, name: str, unit: str = "nedbus") -> str:
        """Return a property of a unit."""
        return self.run(f"systemctl show --value --property {name} {unit}").strip()

    def journal(self, unit: str = "nedbus") -> str:
        """Return what the journal has of a unit."""
        return self.run(f"journalctl --no-pager --unit {unit}")

    def reboot(self) -> None:
        """Shut it down and start it again."""
        docker("restart", self.name)

    def remove(self) -> None:
        """Remove the container."""
        docker("rm", "--force", "--volumes", self.name)

    def _said(self) -> str:
        done = subprocess.run(
            ["docker", "logs", self.name], capture_output=True, text=True, env=ENVIRONMENT, check=False
        )
        return done.stdout + done.stderr
