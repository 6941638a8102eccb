"""All commands in docs/live.md that need neither PX4 nor ROS 2, with other ports, against simulated peers."""

from __future__ import annotations

import json
import re
import shlex
from contextlib import closing
from functools import partial
from pathlib import Path

import pytest

import nedbus
from nedbus.transport import open_client
from tests.flights.local_position import LAYOUTS, ROS2_TYPE, type_hash
from tests.flights.messages import VLP
from tests.nedbus.bridges.test_ros2 import Peer, peer
from tests.nedbus.sources.mavlink.test_source import Fly, fly, port
from tests.nedbus.sources.px4.test_source import Px4
from tests.peers.ports import free_endpoint
from tests.peers.processes import Start
from tests.waits import DEADLINE, repeating, wait_for

__all__ = ["fly", "peer", "port"]  # fixtures

PAGE = (Path(__file__).parents[3] / "docs" / "live.md").read_text()
BLOCKS = re.findall(r"```bash\n(.*?)```", PAGE, re.DOTALL)
COMMANDS = [line.partition("#")[0].strip() for block in BLOCKS for line in block.splitlines()]
COMMANDS = [each for each in COMMANDS if "msg=" not in each]  # these need PX4's .msg files
SERVES, ROS2 = (
    [each for each in COMMANDS if each.startswith(f"nedbus {name}")] for name in ("serve", "ros2")
)


def arguments_of(command: str, **others: str) -> list[str]:
    """Return the arguments of a command on the page, with endpoints replaced."""
    return [others.get(each, each) for each in shlex.split(command)[1:]]


def test_every_command_has_a_test() -> None:
    """The tests below run every command on the page except the installation."""
    others = set(COMMANDS) - {*SERVES, *ROS2}
    assert others == {"nedbus echo vehicle_local_position", 'pip install -e ".[mavlink]"'}
    assert (len(SERVES), len(ROS2)) == (6, 6)


def test_hash_table_matches_the_layouts() -> None:
    """The table of layouts on the page lists each layout with the prefix of its type hash."""
    rows = re.findall(r"^\| `(RIHS01_\w{8})` \| (\S+)", PAGE, re.MULTILINE)
    assert {layout: start for start, layout in rows} == {
        layout: type_hash(layout)[:15] for layout in LAYOUTS
    }


@pytest.mark.slow
@pytest.mark.parametrize("command", SERVES)
def test_serve_command_publishes_the_vehicle(
    run_nedbus: Start, endpoint: str, port: int, fly: Fly, command: str
) -> None:
    """While a service command of the page is running, the echo command prints a line of the vehicle."""
    where = endpoint if "--connect" in command else free_endpoint()
    others = dict.fromkeys(("tcp/192.168.1.5:7447", "tcp/0.0.0.0:7447"), where)
    arguments = arguments_of(command.replace("0.0.0.0:14540", f"127.0.0.1:{port}"), **others)
    if where not in arguments:
        arguments += ["--listen", where]  # the page's own port may be taken
    service = run_nedbus(*arguments)
    echo = run_nedbus("echo", VLP, "-c", where, "-n", "1", "--wait")
    wait_for(lambda: "listening" in service.err, what="the service")
    if "mavlink" in command:
        fly("--system", 1)
    else:
        with (
            closing(open_client((where,), timeout=DEADLINE)) as session,
            repeating(partial(Px4(session).put, 1)),
        ):
            echo.wait()
    assert echo.wait() == 0, echo.err
    assert echo.out.startswith(f"1/{VLP} ")


@pytest.mark.slow
@pytest.mark.parametrize("command", ROS2)
def test_ros2_command_reaches_a_node(
    run_nedbus: Start, endpoint: str, bus: nedbus.Bus, peer: Peer, command: str
) -> None:
    """With the bridge command of the page, a ROS 2 node receives a message and lists the topic."""
    bridge = run_nedbus(
        *arguments_of(command, **{"tcp/192.168.1.5:7447": endpoint}), "-c", endpoint
    )
    layout = "1.14" if "1.14" in command else "1.16"
    domain = 3 if "--domain 3" in command else 0
    vehicle, topic = (
        ("7", f"/drone/fmu/out/{VLP}") if "--vehicle 7" in command else ("1", f"/fmu/out/{VLP}")
    )
    publisher = bus.publisher(VLP, vehicle=vehicle)
    wait_for(lambda: f"-> {topic}" in bridge.err, what="the topic")
    hashed = {"type_hash": "TypeHashNotSupported"} if "--humble" in command else {}
    node = peer("listen", layout, **hashed, topic=topic, rows=[{"timestamp": 1}], domain_id=domain)
    with repeating(lambda: publisher.publish({"timestamp": 1})):
        node.wait()
    message, *_, topics = [json.loads(line) for line in node.out.splitlines()]
    assert message == {"timestamp": 1}
    assert [topic, [ROS2_TYPE]] in topics
