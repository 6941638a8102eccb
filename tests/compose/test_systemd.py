"""The shipped units under a real systemd: installation, start, kill, hang, reload and reboot."""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from nedbus.pki import make_authority, make_bundle, make_certificate
from tests.waits import wait_for

from .machine import Machine
from .stack import ROOT

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600)]

NEDBUS = "/opt/nedbus/bin/nedbus"
CONFIG = "/etc/nedbus/nedbus.toml"
SIMULATION = 'source = ["sim:"]\n'
DIAL = "python3 -c 'import socket; socket.create_connection((\"127.0.0.1\", 7447))'"
ROUTER = "tls/127.0.0.1:7449"
ROUTER_FILE = f"""{{listen: {{endpoints: ["{ROUTER}"]}}, mode: "router", transport: {{link: {{tls: {{
    root_ca_certificate: "ca.crt", listen_certificate: "router.crt", listen_private_key: "router.key",
    enable_mtls: true}}}}}}}}"""
READER = f"-c {ROUTER} " + " ".join(
    f"--tls-{option} /root/pki/{file}"
    for option, file in (("ca", "ca.crt"), ("certificate", "reader.crt"), ("key", "reader.key"))
)
DROP_IN = "/etc/systemd/system/nedbus.service.d/test.conf"

# A vehicle with system id 7 that sends its position to a UDP port, or to a pseudo-terminal linked as /dev/ttyACM0.
VEHICLE = """
import os, socket, sys, time
from pymavlink.dialects.v20 import common as mavlink
vehicle = mavlink.MAVLink(None, srcSystem=7, srcComponent=1)
if sys.argv[1] == "serial":
    master, slave = os.openpty()
    os.chown(os.ttyname(slave), 0, 20)  # dialout
    os.chmod(os.ttyname(slave), 0o660)
    os.symlink(os.ttyname(slave), "/dev/ttyACM0")
    send = lambda data: os.write(master, data)
else:
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    send = lambda data: udp.sendto(data, ("127.0.0.1", int(sys.argv[1])))
number = 0
while True:
    number += 1
    send(vehicle.heartbeat_encode(2, 12, 0, 0, 4).pack(vehicle))
    send(vehicle.local_position_ned_encode(20 * number, 1.0, 2.0, -3.0, 0.0, 0.0, 0.0).pack(vehicle))
    time.sleep(0.02)
"""


@pytest.fixture(scope="module")
def installed(images: None) -> Iterator[Machine]:
    """Boot a machine, and install the service with the documented commands, except for pip."""
    machine = Machine()
    machine.wait_until_booted()
    machine.copy(ROOT / "packaging", "/root/packaging")
    machine.write(SIMULATION, "/root/nedbus.toml")
    block = re.search(r"```bash\n(.*?)```", (ROOT / "docs" / "systemd.md").read_text(), re.DOTALL)
    assert block is not None
    commands = block[1].replace("sudo ", "").splitlines()
    assert len(commands) == 5
    for command in commands[1:]:
        machine.run(f"cd /root && {command}")
    assert_receives(machine)  # the last command has started it
    machine.run("systemctl stop nedbus")
    machine.write(VEHICLE, "/root/vehicle.py")
    yield machine
    machine.remove()


@pytest.fixture
def machine(installed: Machine) -> Iterator[Machine]:
    """Return the machine with the service stopped, and restore its installation after the test."""
    yield installed
    installed.run(
        "systemctl stop 'nedbus*' 'vehicle*'; rm -rf /etc/systemd/system/nedbus.service.d; true"
    )
    installed.run("systemctl daemon-reload; systemctl reset-failed")
    installed.run(f"install -g nedbus -m 640 /root/nedbus.toml {CONFIG}")


def configure(machine: Machine, text: str, name: str = "nedbus") -> None:
    """Write the configuration of a service."""
    machine.write(text, f"/etc/nedbus/{name}.toml")
    machine.run(f"chown root:nedbus /etc/nedbus/{name}.toml; chmod 640 /etc/nedbus/{name}.toml")


def extend(machine: Machine, text: str) -> None:
    """Extend the unit with a drop-in, like `systemctl edit`."""
    machine.run(f"mkdir -p {Path(DROP_IN).parent}")
    machine.write(f"[Service]\n{text}", DROP_IN)
    machine.run("systemctl daemon-reload")


def assert_receives(machine: Machine, vehicle: str = "1", options: str = "") -> None:
    """Assert that messages of a vehicle can be received."""
    assert f'"{vehicle}"' in machine.run(f"{NEDBUS} echo -v {vehicle} -n 1 --json --wait {options}")


def wait_for_restart(machine: Machine, process: str) -> None:
    """Wait until the service is active again in a new process."""
    wait_for(
        lambda: (
            machine.property("MainPID") not in {"0", process}
            and machine.property("ActiveState") == "active"
        ),
        what="a new process",
    )


def test_start_returns_when_ready(machine: Machine) -> None:
    """When `systemctl start` returns, the router accepts connections; the status text includes counts."""
    for _ in range(3):
        machine.run(f"systemctl stop nedbus && systemctl start nedbus && {DIAL}")
    assert_receives(machine)
    assert "1 source, " in machine.property("StatusText")
    assert (
        machine.run("ps -o user= -p $(systemctl show --value -p MainPID nedbus)").strip()
        == "nedbus"
    )


def test_enabled_service_starts_at_boot(machine: Machine) -> None:
    """An enabled service is active after a reboot."""
    machine.run("touch /run/before")
    machine.reboot()
    machine.wait_until_booted()
    assert machine.call("ls /run/before").returncode != 0
    assert machine.property("ActiveState") == "active"
    assert_receives(machine)


def test_killed_service_is_restarted(machine: Machine) -> None:
    """A killed service is restarted."""
    machine.run("systemctl start nedbus")
    process = machine.property("MainPID")
    machine.run("systemctl kill --kill-who=main --signal=KILL nedbus")
    wait_for_restart(machine, process)
    assert_receives(machine)


def test_watchdog_restarts_hanging_service(machine: Machine) -> None:
    """The watchdog kills only a hanging service, which writes the stacks of its threads and is restarted."""
    extend(machine, "WatchdogSec=8s\n")
    machine.run("systemctl start nedbus")
    process = machine.property("MainPID")
    machine.run(f"{NEDBUS} echo --every -v 1 -n 1000 --json")  # 10 s at 100 Hz
    assert machine.property("MainPID") == process
    machine.run(f"kill -STOP {process}")
    wait_for_restart(machine, process)
    journal = machine.journal()
    assert "Watchdog timeout" in journal
    assert "most recent call first" in journal
    assert_receives(machine)


def test_reload_starts_and_stops_sources(machine: Machine) -> None:
    """`systemctl reload` starts and stops sources in the same process, and fails for an invalid file."""
    machine.run("systemctl start nedbus")
    process = machine.property("MainPID")
    configure(machine, 'source = ["sim:", "sim:?vehicle=wing"]\n')
    machine.run("systemctl reload nedbus")
    assert machine.property("ActiveState") == "active"
    wait_for(lambda: machine.property("StatusText").startswith("2 sources, "), what="two sources")
    assert_receives(machine, "wing")
    assert_receives(machine, "1")
    configure(machine, "source = [")
    assert machine.call("systemctl reload nedbus").returncode != 0
    assert f"{CONFIG}: Invalid value (at end of document)" in machine.journal()
    machine.run("systemctl kill --kill-who=main --signal=HUP nedbus")
    wait_for(
        lambda: "configuration rejected" in machine.property("StatusText"),
        what="the reason in the status",
    )
    assert CONFIG in machine.property("StatusText")
    assert machine.property("ActiveState") == "active"
    assert_receives(machine, "wing")
    configure(machine, SIMULATION)
    machine.run("systemctl reload nedbus")
    wait_for(lambda: machine.property("StatusText").startswith("1 source, "), what="one source")
    assert machine.property("MainPID") == process


def test_invalid_configuration_is_not_retried(machine: Machine) -> None:
    """With invalid settings `systemctl start` fails with the reason in the journal, and is not retried."""
    configure(machine, "sorce = []\n")
    assert machine.call("systemctl start nedbus").returncode != 0
    assert machine.property("ActiveState") == "failed"
    assert machine.property("NRestarts") == "0"
    assert f"{CONFIG}, line 1, column 1" in machine.journal()


def test_port_in_use_is_retried(machine: Machine) -> None:
    """`systemctl start` fails if the router's port is in use, and is retried until the port is free."""
    listener = 'import socket,time; s=socket.create_server(("127.0.0.1", 7447)); time.sleep(1000)'
    machine.run(f"systemd-run --unit=vehicle-listener python3 -c '{listener}'")
    wait_for(lambda: machine.call(DIAL).returncode == 0, what="the other listener")
    assert machine.call("systemctl start nedbus").returncode != 0
    machine.run("systemctl stop vehicle-listener")
    wait_for(lambda: machine.property("ActiveState") == "active", what="a restart")


def test_template_runs_several_services(machine: Machine) -> None:
    """Instances of the template unit run several services, each with its own settings file."""
    configure(machine, SIMULATION + 'vehicle = "wing"\nlisten = ["tcp/127.0.0.1:7448"]\n', "wing")
    configure(machine, SIMULATION + 'vehicle = "tail"\nconnect = ["tcp/127.0.0.1:7448"]\n', "tail")
    machine.run("systemctl start nedbus@wing nedbus@tail")
    for vehicle in ("wing", "tail"):
        assert_receives(machine, vehicle, "--connect tcp/127.0.0.1:7448")


def test_mavlink_over_udp_works_in_hardened_unit(machine: Machine) -> None:
    """The unit's permissions suffice for MAVLink over UDP; the service is ready before a message arrives."""
    configure(machine, 'source = ["mavlink:udpin:127.0.0.1:14540"]\n')
    machine.run("systemctl start nedbus")
    wait_for(lambda: "nothing arrives" in machine.property("StatusText"), what="the status")
    machine.run("systemd-run --unit=vehicle-udp /opt/nedbus/bin/python3 /root/vehicle.py 14540")
    assert_receives(machine, "7")


def test_mavlink_over_serial_port_works_with_drop_in(machine: Machine) -> None:
    """With the documented drop-in the service reads a serial port, here a pseudo-terminal."""
    addition = (
        (ROOT / "docs" / "systemd.md").read_text().split("```ini\n[Service]\n")[1].split("```")[0]
    )
    configure(machine, 'source = ["mavlink:serial:/dev/ttyACM0"]\n')
    extend(machine, addition)
    machine.run("systemctl start nedbus")
    machine.run("systemd-run --unit=vehicle-serial /opt/nedbus/bin/python3 /root/vehicle.py serial")
    assert_receives(machine, "7")
    machine.run("systemctl stop vehicle-serial; rm /dev/ttyACM0")


def test_bundle_is_installed_with_readme_commands(machine: Machine, tmp_path: Path) -> None:
    """A bundle of `nedbus pki enroll`, installed as in its README.txt, works with a router that requires certificates.

    Only the service can read its keys.
    """
    make_authority(tmp_path)
    make_certificate(tmp_path, "router", hosts=["localhost", "127.0.0.1"])
    make_certificate(tmp_path, "reader")
    make_bundle(tmp_path, "wing", tmp_path / "bundle", routers=[ROUTER], sources=["sim:"])
    machine.run("rm -rf /root/pki")
    machine.copy(tmp_path, "/root/pki")
    machine.run(
        "cd /root/pki && install -g nedbus -m 640 ca.crt router.crt router.key /etc/nedbus/"
    )
    machine.write(ROUTER_FILE, "/etc/nedbus/router.json5")
    configure(machine, SIMULATION + 'router_config = "router.json5"\n', "router")
    machine.run("systemctl start nedbus@router")
    readme = (tmp_path / "bundle" / "README.txt").read_text()
    commands = re.findall(
        r"^ {7}sudo (.*)$", readme.split("With systemd")[1].split("\n3. ")[0], re.MULTILINE
    )
    assert len(commands) == 5
    for command in commands:
        machine.run(f"cd /root/pki/bundle && {command}")
    assert_receives(machine, "wing", READER)
    for key in ("router.key", "pki/vehicle-wing.key"):
        assert (
            machine.call(f"setpriv --reuid=65534 --clear-groups cat /etc/nedbus/{key}").returncode
            != 0
        )


def test_service_cannot_write_files_or_see_devices(machine: Machine) -> None:
    """The service can write only to its own /tmp, and sees neither home directories nor devices."""
    machine.run("systemctl start nedbus")
    inside = "nsenter --mount --target $(systemctl show --value -p MainPID nedbus)"
    assert (
        machine.call(f"{inside} touch /etc/nedbus/new /opt/nedbus/new /var/lib/new").returncode != 0
    )
    assert machine.run(f"{inside} ls /root") == ""
    assert not {"mem", "kmsg", "ttyACM0"} & set(machine.run(f"{inside} ls /dev").split())
