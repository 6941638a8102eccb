"""Publishers with invalid messages and arguments, and failures while one is opened."""

from __future__ import annotations

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
import zenoh

import nedbus
from nedbus.client import PublisherRegistry, QueryServer, io_thread
from nedbus.transport import Session, token_keys
from nedbus_msgs import Address, VehicleLocalPosition
from nedbus_msgs.arrays import DTYPE, to_array
from tests.flights.messages import VLP, message
from tests.nedbus.client.numbered import numbered, receive_timestamps, wait_for_subscriber
from tests.waits import DEADLINE, wait_for


@pytest.mark.parametrize("method", ["publish", "publish_row", "publish_many"])
def test_every_publish_method_raises_for_invalid_messages(client: nedbus.Bus, method: str) -> None:
    """Every publish method of either client raises InvalidMessageError for an invalid message, and sends nothing."""
    publisher = client.publisher(VLP, vehicle="1")
    fields = {**message(1).model_dump(), "eph": -1.0}
    given: dict[str, object] = {
        "publish": fields,
        "publish_row": tuple(fields.values()),
        "publish_many": to_array([message(1), VehicleLocalPosition.model_construct(**fields)]),
    }
    with pytest.raises(nedbus.InvalidMessageError, match=r"eph: must not be negative \(is -1.0\)") as info:
        getattr(publisher, method)(given[method])
    assert isinstance(info.value, nedbus.NedbusError)
    assert ("at index 1:" in str(info.value)) is (method == "publish_many")
    assert publisher.published == 0


def test_publish_many_with_invalid_arguments_sends_nothing(bus: nedbus.Bus) -> None:
    """`publish_many` raises TypeError for another dtype and ClosedError after closing; an empty array sends nothing."""
    publisher = bus.publisher(VLP, vehicle="1")
    with pytest.raises(TypeError, match="astype"):
        publisher.publish_many(np.zeros(3, [("x", "f4")]))
    publisher.publish_many(np.empty(0, DTYPE))
    publisher.close()
    with pytest.raises(nedbus.ClosedError):
        publisher.publish_many(numbered(1))
    assert publisher.published == 0


def test_publish_many_waits_for_credit_at_exactly_the_due_messages(
    bus: nedbus.Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A lossless `publish_many` waits for its readers at the message that is due, whatever is put in one group.

    All messages arrive in order.
    """
    publisher, waited = bus.publisher(VLP, vehicle="1", lossless=True), list[int]()
    control = publisher._flow_control

    def wait_for_credit(published: int) -> None:
        waited.append(published)
        control.check_at = published + 37 if len(waited) < 3 else 1000

    monkeypatch.setattr(control, "wait_for_credit", wait_for_credit)
    control.check_at = 70
    with bus.subscribe(VLP, vehicle="1", mode="every") as subscription:
        wait_for_subscriber(publisher)
        publisher.publish_many(numbered(300))
        assert receive_timestamps(subscription, 300) == list(range(1, 301))
    assert waited == [70, 107, 144]
    assert publisher.published == 300


def test_invalid_source_leaves_nothing_behind(bus: nedbus.Bus, zenoh_session: Session) -> None:
    """A publisher with an invalid source raises, and leaves no listener, directory, job or liveliness token behind."""
    jobs = len(io_thread._jobs)
    for number in range(3):
        with pytest.raises(nedbus.errors.ArgumentError, match="not valid"):
            bus.publisher(VLP, vehicle=str(number), source="not valid")
        assert_nothing_is_open(bus._publishers, zenoh_session)
    assert len(io_thread._jobs) <= jobs + 1  # one vehicle answers schema queries, for messages in transit


class FailingSession:
    """A session in which one declaration fails."""

    def __init__(self, session: Session, fails_at: int) -> None:
        self.session, self.left = session, fails_at
        self.declared = self.probes = 0

    def __getattr__(self, name: str) -> Any:
        found = getattr(self.session, name)
        return self.counted(found) if name.startswith("declare_") else found

    def liveliness(self) -> SimpleNamespace:
        return SimpleNamespace(declare_token=self.counted(self.session.liveliness().declare_token))

    def counted(self, declare: Callable[..., object]) -> Callable[..., object]:
        def call(*arguments: Any, **options: Any) -> object:
            self.left -= 1
            self.declared += 1
            if self.left == 0:
                raise zenoh.ZError("out of resources")
            result = declare(*(self.session if each is self else each for each in arguments), **options)
            if isinstance(result, zenoh.Publisher):  # a probe, which declares a matching listener
                self.probes += 1
                return SimpleNamespace(
                    declare_matching_listener=self.counted(result.declare_matching_listener),
                    undeclare=lambda: self.undeclare(result),
                )
            return result

        return call

    def undeclare(self, probe: zenoh.Publisher) -> None:
        self.probes -= 1
        probe.undeclare()


@pytest.mark.parametrize("step", [*range(1, 11)])
@pytest.mark.parametrize("declarations", [7, 9], ids=["client", "lossless-in-router"])
def test_failed_declaration_leaves_nothing_behind(
    bus: nedbus.Bus, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch, step: int, declarations: int
) -> None:
    """If any declaration of a publisher fails, nothing stays open, and the address is free for the next one."""
    is_router = declarations == 9
    session = cast("Any", FailingSession(bus._session, step))
    monkeypatch.setattr("zenoh.ext.declare_advanced_publisher", session.counted(zenoh.ext.declare_advanced_publisher))
    queries = QueryServer(session)
    registry, address = PublisherRegistry(session, queries, prefix="nedbus", is_client=not is_router), Address("1", VLP)
    if step <= declarations:
        with pytest.raises(nedbus.NedbusError, match="out of resources"):
            registry.publisher(address, lossless=is_router)
        assert (session.declared, session.probes) == (step, 0)
        assert_nothing_is_open(registry, zenoh_session)
    publisher = registry.publisher(address, lossless=is_router)
    publisher.publish(message(5))
    wait_for(lambda: len(open_tokens(zenoh_session)) == 2, what="the tokens")
    assert step <= declarations or session.declared == declarations, "each declaration is tested"
    publisher.close()
    queries.close()
    registry.heartbeats.close()


def test_interrupted_open_closes_the_publisher(
    bus: nedbus.Bus, zenoh_session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ctrl-C while `bus.publisher` waits for the router closes the publisher, which the script has no reference to."""

    def interrupt(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr("nedbus.client.bus.token_keys", interrupt)
        with pytest.raises(KeyboardInterrupt):
            bus.publisher(VLP, vehicle="1")
    assert_nothing_is_open(bus._publishers, zenoh_session)
    bus.publisher(VLP, vehicle="1").publish(message(5))


def open_tokens(session: Session) -> list[str]:
    """Return the liveliness tokens of publishers and of their keys."""
    return [key for each in ("**", "*/@alive/**") for key in token_keys(session, f"nedbus/{each}", timeout=DEADLINE)]


def assert_nothing_is_open(registry: PublisherRegistry, session: Session) -> None:
    """Check that a registry has no open publisher, and no state or liveliness token of one."""
    assert not registry.publishers
    assert not registry._rate_listeners
    assert not registry._directories
    assert not registry.heartbeats.writers
    wait_for(lambda: open_tokens(session) == [], what="the end of the liveliness tokens")
