"""Readers on the host, in containers, and behind a second router."""

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
from .recorder import Flight, is_whole

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600)]

STREAMS = {Address("1", name, 0 if topic.instances else None) for name, topic in DEFAULT.topics.items()}
COUNT = 2000  # samples: about 7 s of all streams


def parse(output: str) -> list[tuple[Address, Message]]:
    """Return what `nedbus echo --json` printed."""
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
        ("docker-compose.hosts.yml", {"service": ["vehicle"], "vehicle-router": ["link", "vehicle"]}),
    ],
)
def test_host_and_container_read_everything(make_stack: StartStack, file: str, networks: dict[str, list[str]]) -> None:
    """Every sample of all topics, with the right values; `compose stop` ends the service with exit code 0.

    Beside the service, and behind a second router, on a network that the service is not on; the host through that one.
    """
    stack = make_stack("readers", file)
    stack.up()
    echo = stack.run("subscriber", "echo", "*", "--every", "--wait", "--json", "--count", str(COUNT))
    with nedbus.connect(stack.endpoint, timeout=DEADLINE) as bus, bus.subscribe("*", mode="every") as subscription:
        samples = [subscription.receive(DEADLINE) for _ in range(COUNT)]
        assert subscription.counts == nedbus.Counts(received=COUNT)
    assert echo.wait() == 0, echo.err
    assert "lost" not in echo.err
    in_container = parse(echo.out)
    assert len(in_container) == COUNT
    for arrived in ([(sample.address, sample.message) for sample in samples], in_container):
        indices = Flight().indices(arrived)
        assert set(indices) >= STREAMS
        assert all(map(is_whole, indices.values()))
    for service, names in networks.items():
        assert sorted(stack.inspect(service)["NetworkSettings"]["Networks"]) == sorted(map(stack.network, names))
    stack.compose("stop", "service")
    assert stack.inspect("service")["State"]["ExitCode"] == 0


def test_late_joiner_gets_the_last_value(make_stack: StartStack) -> None:
    """It is kept, even though nothing is published any more."""
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
    """Return the page of `nedbus web` as a browser gets it through the usual port; nothing while it does not answer."""
    web = http.client.HTTPConnection(address, timeout=DEADLINE)
    try:
        web.request("GET", "/", headers={"Host": "127.0.0.1:8420"})
        return web.getresponse().read()
    except OSError:
        return b""
    finally:
        web.close()


def test_compose_up_shows_data(make_stack: StartStack) -> None:
    """The service logs its progress, the demo prints messages; both run as an ordinary user, and are healthy."""
    stack = make_stack("up", "docker-compose.yml", "tests/compose/quick-health.yml", NEDBUS_WEB="127.0.0.1:0")
    stack.compose("--profile", "demo", "up", "--detach", "--no-build")
    wait_for(lambda: " messages, " in stack.compose("logs", "service"), what="a count in the service's log", seconds=60)
    wait_for(lambda: stack.compose("logs", "subscriber").count(" ned ") > 5, what="messages in the subscriber's log")
    wait_for(lambda: stack.health("service") == "healthy", what="health", seconds=60)
    assert stack.compose("exec", "--no-TTY", "service", "id", "-un").strip() == "nedbus"
    page = stack.compose("port", "web", "8420").strip()
    wait_for(lambda: b"static/js/bokeh" in read_page(page), what="the page", seconds=60)
    stack.compose("kill", "router")
    wait_for(lambda: stack.health("service") == "unhealthy", what="its sickness", seconds=120)


def test_flags_are_those_of_zenohd(make_stack: StartStack) -> None:
    """The flags that compose files give a router image are flags of zenohd."""
    for file in ("docker-compose.yml", "docker-compose.hosts.yml"):
        config = json.loads(make_stack("flags", file).compose("config", "--format", "json"))
        for name, service in config["services"].items():
            if "router" in name:
                flags = [word for word in service["command"] if word.startswith("-")]
                assert set(flags) <= {"--config", "--listen", "--connect"}
