"""The units under a real systemd: installed as documented, started, killed, hung, reloaded, rebooted."""

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

# A vehicle with system id 7 that sends its position to a UDP port, or to the other end of a terminal, which it prints.
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
    """Boot a machine, and install the service with the documented commands; pip has been there already."""
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
    assert_reads(machine)  # the last command has started it
    machine.run("systemctl stop nedbus")
    machine.write(VEHICLE, "/root/vehicle.py")
    yield machine
    machine.remove()


@pytest.fixture
def machine(installed: Machine) -> Iterator[Machine]:
    """Give each test the service as it was installed, stopped."""
    yield installed
    installed.run("systemctl stop 'nedbus*' 'vehicle*'; rm -rf /etc/systemd/system/nedbus.service.d; true")
    installed.run("systemctl daemon-reload; systemctl reset-failed")
    installed.run(f"install -g nedbus -m 640 /root/nedbus.toml {CONFIG}")


def configure(machine: Machine, text: str, name: str = "nedbus") -> None:
    """Write the configuration of a service."""
    machine.write(text, f"/etc/nedbus/{name}.toml")
    machine.run(f"chown root:nedbus /etc/nedbus/{name}.toml; chmod 640 /etc/nedbus/{name}.toml")


def extend(machine: Machine, text: str) -> None:
    """Add to the unit, as `systemctl edit` does."""
    machine.run(f"mkdir -p {Path(DROP_IN).parent}")
    machine.write(f"[Service]\n{text}", DROP_IN)
    machine.run("systemctl daemon-reload")


def assert_reads(machine: Machine, vehicle: str = "1", options: str = "") -> None:
    """Hold that a reader gets messages of a vehicle."""
    assert f'"{vehicle}"' in machine.run(f"{NEDBUS} echo -v {vehicle} -n 1 --json --wait {options}")


def wait_for_restart(machine: Machine, process: str) -> None:
    """Wait until the service works again, in another process."""
    wait_for(
        lambda: machine.property("MainPID") not in {"0", process} and machine.property("ActiveState") == "active",
        what="another process",
    )


def test_start_returns_when_ready(machine: Machine) -> None:
    """When `systemctl start` returns, the router answers; the status says what is published."""
    for _ in range(3):
        machine.run(f"systemctl stop nedbus && systemctl start nedbus && {DIAL}")
    assert_reads(machine)
    assert "1 source, " in machine.property("StatusText")
    assert machine.run("ps -o user= -p $(systemctl show --value -p MainPID nedbus)").strip() == "nedbus"


def test_boot(machine: Machine) -> None:
    """An enabled service is there after a boot."""
    machine.run("touch /run/before")
    machine.reboot()
    machine.wait_until_booted()
    assert machine.call("ls /run/before").returncode != 0
    assert machine.property("ActiveState") == "active"
    assert_reads(machine)


def test_kill(machine: Machine) -> None:
    """A service that is killed comes back by itself."""
    machine.run("systemctl start nedbus")
    process = machine.property("MainPID")
    machine.run("systemctl kill --kill-who=main --signal=KILL nedbus")
    wait_for_restart(machine, process)
    assert_reads(machine)


def test_hang(machine: Machine) -> None:
    """A service that works outlives the watchdog; one that hangs is ended by it, shows its threads, and comes back."""
    extend(machine, "WatchdogSec=3s\n")
    machine.run("systemctl start nedbus")
    process = machine.property("MainPID")
    machine.run(f"{NEDBUS} echo --every -v 1 -n 1000 --json")  # 10 s at 100 Hz
    assert machine.property("MainPID") == process
    machine.run(f"kill -STOP {process}")
    wait_for_restart(machine, process)
    journal = machine.journal()
    assert "Watchdog timeout" in journal
    assert "most recent call first" in journal
    assert_reads(machine)


def test_reload(machine: Machine) -> None:
    """`systemctl reload` starts a new source, and ends one; it fails for a broken file; the process stays the same."""
    machine.run("systemctl start nedbus")
    process = machine.property("MainPID")
    configure(machine, 'source = ["sim:", "sim:?vehicle=wing"]\n')
    machine.run("systemctl reload nedbus")
    assert machine.property("ActiveState") == "active"
    wait_for(lambda: machine.property("StatusText").startswith("2 sources, "), what="two sources")
    assert_reads(machine, "wing")
    assert_reads(machine, "1")
    configure(machine, "source = [")
    assert machine.call("systemctl reload nedbus").returncode != 0
    assert f"{CONFIG}, line 1, column " in machine.journal()
    machine.run("systemctl kill --kill-who=main --signal=HUP nedbus")
    wait_for(lambda: "configuration rejected" in machine.property("StatusText"), what="the reason in the status")
    assert CONFIG in machine.property("StatusText")
    assert machine.property("ActiveState") == "active"
    assert_reads(machine, "wing")
    configure(machine, SIMULATION)
    machine.run("systemctl reload nedbus")
    wait_for(lambda: machine.property("StatusText").startswith("1 source, "), what="one source")
    assert machine.property("MainPID") == process


def test_mistake_in_configuration(machine: Machine) -> None:
    """`systemctl start` fails at once, with the reason in the journal, and it is not tried again."""
    configure(machine, "sorce = []\n")
    assert machine.call("systemctl start nedbus").returncode != 0
    assert machine.property("ActiveState") == "failed"
    assert machine.property("NRestarts") == "0"
    assert f"{CONFIG}, line 1, column 1" in machine.journal()


def test_port_that_is_taken(machine: Machine) -> None:
    """`systemctl start` fails when the router cannot listen; it is tried again, until it can."""
    taker = 'import socket,time; s=socket.create_server(("127.0.0.1", 7447)); time.sleep(1000)'
    machine.run(f"systemd-run --unit=vehicle-taker python3 -c '{taker}'")
    wait_for(lambda: machine.call(DIAL).returncode == 0, what="the taker")
    assert machine.call("systemctl start nedbus").returncode != 0
    machine.run("systemctl stop vehicle-taker")
    wait_for(lambda: machine.property("ActiveState") == "active", what="another try")


def test_several_services(machine: Machine) -> None:
    """The template runs services of their own, each with its file."""
    configure(machine, SIMULATION + 'vehicle = "wing"\nlisten = ["tcp/127.0.0.1:7448"]\n', "wing")
    configure(machine, SIMULATION + 'vehicle = "tail"\nconnect = ["tcp/127.0.0.1:7448"]\n', "tail")
    machine.run("systemctl start nedbus@wing nedbus@tail")
    for vehicle in ("wing", "tail"):
        assert_reads(machine, vehicle, "--connect tcp/127.0.0.1:7448")


def test_mavlink_over_udp(machine: Machine) -> None:
    """The unit's permissions suffice for MAVLink over UDP; the service is started before anything arrives."""
    configure(machine, 'source = ["mavlink:udpin:127.0.0.1:14540"]\n')
    machine.run("systemctl start nedbus")
    wait_for(lambda: "nothing arrives" in machine.property("StatusText"), what="the status")
    machine.run("systemd-run --unit=vehicle-udp /opt/nedbus/bin/python3 /root/vehicle.py 14540")
    assert_reads(machine, "7")


def test_mavlink_over_serial_port(machine: Machine) -> None:
    """With the documented addition it reads a serial port; the other end of a terminal stands in for one."""
    addition = (ROOT / "docs" / "systemd.md").read_text().split("```ini\n[Service]\n")[1].split("```")[0]
    configure(machine, 'source = ["mavlink:serial:/dev/ttyACM0"]\n')
    extend(machine, addition)
    machine.run("systemctl start nedbus")
    machine.run("systemd-run --unit=vehicle-serial /opt/nedbus/bin/python3 /root/vehicle.py serial")
    assert_reads(machine, "7")
    machine.run("systemctl stop vehicle-serial; rm /dev/ttyACM0")


def test_bundle(machine: Machine, tmp_path: Path) -> None:
    """The folder of `nedbus pki enroll`, installed as its README.txt says, beside a router that asks for certificates.

    The service can read its keys, and nobody else can.
    """
    make_authority(tmp_path)
    make_certificate(tmp_path, "router", hosts=["localhost", "127.0.0.1"])
    make_certificate(tmp_path, "reader")
    make_bundle(tmp_path, "wing", tmp_path / "bundle", routers=[ROUTER], sources=["sim:"])
    machine.run("rm -rf /root/pki")
    machine.copy(tmp_path, "/root/pki")
    machine.run("cd /root/pki && install -g nedbus -m 640 ca.crt router.crt router.key /etc/nedbus/")
    machine.write(ROUTER_FILE, "/etc/nedbus/router.json5")
    configure(machine, SIMULATION + 'router_config = "router.json5"\n', "router")
    machine.run("systemctl start nedbus@router")
    readme = (tmp_path / "bundle" / "README.txt").read_text()
    commands = re.findall(r"^ {7}sudo (.*)$", readme.split("With systemd")[1].split("\n3. ")[0], re.MULTILINE)
    assert len(commands) == 5
    for command in commands:
        machine.run(f"cd /root/pki/bundle && {command}")
    assert_reads(machine, "wing", READER)
    for key in ("router.key", "pki/vehicle-wing.key"):
        assert machine.call(f"setpriv --reuid=65534 --clear-groups cat /etc/nedbus/{key}").returncode != 0


def test_nothing_is_writable(machine: Machine) -> None:
    """The process sees no writable file system but its own /tmp, no home and no device."""
    machine.run("systemctl start nedbus")
    inside = "nsenter --mount --target $(systemctl show --value -p MainPID nedbus)"
    assert machine.call(f"{inside} touch /etc/nedbus/new /opt/nedbus/new /var/lib/new").returncode != 0
    assert machine.run(f"{inside} ls /root") == ""
    assert not {"mem", "kmsg", "ttyACM0"} & set(machine.run(f"{inside} ls /dev").split())
