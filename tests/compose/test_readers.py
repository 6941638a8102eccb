"""Subscribers on the host, in containers, and behind a second router."""

from __future__ import annotations

import http.client
import json

import pytest

import nedbus
from nedbus import Mode
from nedbus_msgs import BY_TOPIC, DEFAULT, Address, Message
from tests.flights.messages import VLP
from tests.waits import DEADLINE, wait_for

from .conftest import StartStack
from .recorder import Flight, is_complete

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600)]

STREAMS = {
    Address("1", name, 0 if topic.instances else None) for name, topic in DEFAULT.topics.items()
}
COUNT = 2000  # samples: about 7 s of all streams


def parse(output: str) -> list[tuple[Address, Message]]:
    """Return the messages in the output of `nedbus echo --json`."""
    rows = [json.loads(line) for line in output.splitlines()]
    return [
        (
            Address(row["vehicle"], row["topic"], row["instance"]),
            BY_TOPIC[row["topic"]].model.model_validate_json(json.dumps(row["message"])),
        )
        for row in rows
    ]


@pytest.mark.parametrize(
    ("file", "networks"),
    [
        ("docker-compose.yml", {}),
        (
            "docker-compose.hosts.yml",
            {"service": ["vehicle"], "vehicle-router": ["link", "vehicle"]},
        ),
    ],
)
def test_host_and_container_receive_all_messages(
    make_stack: StartStack, file: str, networks: dict[str, list[str]]
) -> None:
    """Subscribers receive all messages of all topics with correct values; `compose stop` exits with 0.

    The subscribers are on the network of the service, or behind a second router on another network.
    """
    stack = make_stack("readers", file)
    stack.up()
    echo = stack.run(
        "subscriber", "echo", "*", "--every", "--wait", "--json", "--count", str(COUNT)
    )
    with (
        nedbus.connect(stack.endpoint, timeout=DEADLINE) as bus,
        bus.subscribe("*", mode="every") as subscription,
    ):
        samples = [subscription.receive(DEADLINE) for _ in range(COUNT)]
        assert subscription.counts == nedbus.Counts(received=COUNT)
    assert echo.wait() == 0, echo.err
    assert "lost" not in echo.err
    in_container = parse(echo.out)
    assert len(in_container) == COUNT
    for arrived in ([(sample.address, sample.message) for sample in samples], in_container):
        indices = Flight().indices(arrived)
        assert set(indices) >= STREAMS
        assert all(map(is_complete, indices.values()))
    for service, names in networks.items():
        assert sorted(stack.inspect(service)["NetworkSettings"]["Networks"]) == sorted(
            map(stack.network, names)
        )
    stack.compose("stop", "service")
    assert stack.inspect("service")["State"]["ExitCode"] == 0


def test_late_subscriber_receives_the_last_message(make_stack: StartStack) -> None:
    """A late subscriber receives the last message, even after the replay has ended."""
    stack = make_stack("late", NEDBUS_SOURCE="sim:?duration=2")
    stack.up()
    with nedbus.connect(stack.endpoint, timeout=DEADLINE) as bus:
        wait_for(lambda: "state='done'" in str(bus.services()), what="the end of the flight")
        last = Flight("sim:?duration=2").last(Address("1", VLP))
        modes: tuple[Mode, ...] = ("latest", "every")
        for mode in modes:
            with bus.subscribe(VLP, mode=mode) as subscription:
                assert subscription.receive(DEADLINE).message == last


def read_page(address: str) -> bytes:
    """Return the page of `nedbus web`, requested as from its default port; b"" if it does not respond."""
    web = http.client.HTTPConnection(address, timeout=DEADLINE)
    try:
        web.request("GET", "/", headers={"Host": "127.0.0.1:8420"})
        return web.getresponse().read()
    except OSError:
        return b""
    finally:
        web.close()


def test_compose_up_shows_data(make_stack: StartStack) -> None:
    """The service logs its progress and the demo prints messages; the service runs unprivileged and is healthy."""
    stack = make_stack(
        "up", "docker-compose.yml", "tests/compose/quick-health.yml", NEDBUS_WEB="127.0.0.1:0"
    )
    stack.compose("--profile", "demo", "up", "--detach", "--no-build")
    wait_for(
        lambda: " messages, " in stack.compose("logs", "service"),
        what="a count in the service's log",
        seconds=60,
    )
    wait_for(
        lambda: stack.compose("logs", "subscriber").count(" ned ") > 5,
        what="messages in the subscriber's log",
    )
    wait_for(lambda: stack.health("service") == "healthy", what="health", seconds=60)
    assert stack.compose("exec", "--no-TTY", "service", "id", "-un").strip() == "nedbus"
    page = stack.compose("port", "web", "8420").strip()
    wait_for(lambda: b"static/js/bokeh" in read_page(page), what="the page", seconds=60)
    stack.compose("kill", "router")
    wait_for(
        lambda: stack.health("service") == "unhealthy", what="the failed health check", seconds=120
    )


def test_router_options_exist_in_zenohd(make_stack: StartStack) -> None:
    """The compose files pass only options of zenohd to the router image."""
    for file in ("docker-compose.yml", "docker-compose.hosts.yml"):
        config = json.loads(make_stack("flags", file).compose("config", "--format", "json"))
        for name, service in config["services"].items():
            if "router" in name:
                flags = [word for word in service["command"] if word.startswith("-")]
                assert set(flags) <= {"--config", "--listen", "--connect"}
