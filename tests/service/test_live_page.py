"""Every command of docs/live.md that needs no PX4 and no ROS 2, with other ports, against stand-ins for both."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import pytest

import nedbus
from nedbus_msgs import LAYOUTS, ROS2_TYPE, type_hash
from tests.conftest import DEADLINE, Process, Start, free_endpoint, wait_for

from .test_mavlink import Fly, fly, port
from .test_px4_zenoh import Px4
from .test_ros2 import Peer, peer

__all__ = ["fly", "peer", "port"]  # fixtures

PAGE = (Path(__file__).parents[2] / "docs" / "live.md").read_text()
BLOCKS = re.findall(r"```bash\n(.*?)```", PAGE, re.DOTALL)
COMMANDS = [line.partition("#")[0].strip() for block in BLOCKS for line in block.splitlines()]
SERVES = [command for command in COMMANDS if command.startswith("nedbus serve")]
ROS2 = [command for command in COMMANDS if command.startswith("nedbus ros2")]


def arguments_of(command: str, **others: str) -> list[str]:
    """Return the arguments of a command on the page, with other endpoints in it."""
    for shown, used in others.items():
        command = command.replace(shown, used)
    return shlex.split(command)[1:]


def test_all_commands_are_known() -> None:
    """No command on the page that no test runs, but the installation."""
    others = set(COMMANDS) - {*SERVES, *ROS2}
    assert others == {"nedbus echo vehicle_local_position", 'pip install ".[mavlink]"'}
    assert len(SERVES) == 5
    assert len(ROS2) == 6


def test_hashes_are_those_of_the_layouts() -> None:
    """The table by which a reader finds the layout of a workspace names each layout with the start of its hash."""
    rows = re.findall(r"^\| `(RIHS01_\w{8})` \| (\S+)", PAGE, re.MULTILINE)
    assert {layout: start for start, layout in rows} == {layout: type_hash(layout)[:15] for layout in LAYOUTS}


@pytest.mark.parametrize("command", SERVES)
def test_vehicle_is_echoed(run_nedbus: Start, endpoint: str, port: int, fly: Fly, command: str) -> None:
    """The service as on the page, a vehicle, and the echo of the page: a line of that vehicle."""
    endpoints = {"tcp/192.168.1.5:7447": endpoint, "0.0.0.0:14540": f"127.0.0.1:{port}"}
    where = endpoint if "--connect" in command else free_endpoint()
    arguments = [where if each == "tcp/0.0.0.0:7447" else each for each in arguments_of(command, **endpoints)]
    if "--connect" not in arguments and "--listen" not in arguments:
        arguments += ["--listen", where]  # the page's own port may be taken
    service = run_nedbus(*arguments)
    echo = run_nedbus("echo", "vehicle_local_position", "-c", where, "-n", "1", "--wait")
    wait_for(lambda: "listening" in service.err, what="the service")
    if "mavlink" in command:
        fly("--system", 1)
    else:
        with nedbus.connect(where, timeout=DEADLINE) as bus:
            px4 = Px4(bus._session)
            wait_for(lambda: _put_until_ended(px4, echo), what="the echo")
    assert echo.wait() == 0, echo.err
    assert echo.out.startswith("1/vehicle_local_position ")


def _put_until_ended(px4: Px4, process: Process) -> bool:
    px4.put(1)
    return process.popen.poll() is not None


@pytest.mark.parametrize("command", ROS2)
def test_ros_2_lists_it(run_nedbus: Start, endpoint: str, bus: nedbus.Bus, peer: Peer, command: str) -> None:
    """The bridge as on the page, and a ROS 2 node that listens: it gets a message, and lists the topic."""
    bridge = run_nedbus(*arguments_of(command, **{"tcp/192.168.1.5:7447": endpoint}), "-c", endpoint)
    layout, domain, vehicle, topic = "1.16", 0, "1", "/fmu/out/vehicle_local_position"
    if "1.14" in command:
        layout = "1.14"
    if "--domain 3" in command:
        domain = 3
    if "--vehicle 7" in command:
        vehicle, topic = "7", f"/drone{topic}"
    publisher = bus.publisher("vehicle_local_position", vehicle=vehicle)
    wait_for(lambda: f"-> {topic}" in bridge.err, what="the topic")
    hashed = {"type_hash": "TypeHashNotSupported"} if "--humble" in command else {}
    node = peer("listen", layout, **hashed, topic=topic, rows=[{"timestamp": 1}], domain_id=domain)

    def is_received() -> bool:
        publisher.publish({"timestamp": 1})
        return node.popen.poll() is not None

    wait_for(is_received, what="the node")
    message, *_, topics = [json.loads(line) for line in node.out.splitlines()]
    assert message == {"timestamp": 1}
    assert [topic, [ROS2_TYPE]] in topics
