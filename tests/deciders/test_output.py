"""Publishing a live source's topics that have no rate, with a clock of the test's."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from nedbus.client import PublisherRegistry
from nedbus.daemon.output import SourceOutput
from nedbus.events import Account
from nedbus.sources import SourceMessage
from nedbus_msgs import BY_TOPIC, Address
from tests.flights.messages import VLP

HOME, POSITION, OTHER = Address("1", "home_position"), Address("1", VLP), Address("2", VLP)
ATTITUDE = Address("1", "vehicle_attitude")


class Sky:
    """A live source, and what was published: address and timestamp."""

    def __init__(self) -> None:
        self.now, self.published = 0.0, list[tuple[Address, int]]()
        registry = SimpleNamespace(is_alive=lambda _: False, publisher=self._open)
        self.output = SourceOutput(
            "px4", "px4-zenoh:", cast("PublisherRegistry", registry), lambda: self.now, Account()
        )

    def hear(self, seconds: float, *addresses: Address, timestamp: int | None = None) -> None:
        """Let time pass, hear something of each of these, and look who is silent."""
        self.now += seconds
        for address in addresses:
            fields = {"timestamp": round(self.now * 1e6) if timestamp is None else timestamp}
            self.output.publish_live(SourceMessage(0.0, address, fields))
        self.output.expire_stale()

    def _open(self, address: Address, definition: Any, **_: object) -> SimpleNamespace:
        def publish(fields: dict[str, int]) -> None:
            self.published.append((address, fields["timestamp"]))

        return SimpleNamespace(definition=definition or BY_TOPIC[address.topic], publish=publish, close=lambda: None)


def test_home_stays_while_its_vehicle_is_heard() -> None:
    """It comes on events only: it is published for as long as anything else of its vehicle arrives."""
    sky = Sky()
    sky.hear(1, HOME, POSITION, OTHER)
    for _ in range(10):
        sky.hear(1, POSITION, OTHER)
    assert set(sky.output.addresses) == {HOME, POSITION, OTHER}
    for _ in range(4):
        sky.hear(1, OTHER)
    assert (sky.output.addresses, set(sky.output.stale)) == ([OTHER], {HOME, POSITION})


def test_home_is_back_with_its_vehicle() -> None:
    """After an outage of its link a vehicle would not send its home again; after a reboot it does."""
    sky = Sky()
    sky.hear(1, HOME, POSITION)
    sky.hear(4)
    assert sky.output.addresses == []
    sky.hear(1, OTHER)
    assert sky.output.addresses == [OTHER]
    sky.hear(1, POSITION)
    assert set(sky.output.addresses) == {HOME, POSITION, OTHER}
    assert sky.published[-2:] == [(HOME, 1_000_000), (POSITION, 7_000_000)]
    sky.hear(4)
    sky.hear(1, POSITION, timestamp=5)
    assert sky.output.addresses == [POSITION]
    assert sky.published[-1] == (POSITION, 5)


def test_home_of_before_a_reboot_is_never_back() -> None:
    """A home is said seconds after the boot: the next boot is known by all that the vehicle said, not by that alone."""
    sky = Sky()
    sky.hear(2, HOME, POSITION)
    for _ in range(30):
        sky.hear(1, POSITION)
    sky.hear(4)
    sky.hear(1, POSITION, timestamp=12_000_000)
    sky.hear(0, ATTITUDE, timestamp=12_100_000)
    assert set(sky.output.addresses) == {POSITION, ATTITUDE}
    assert [address for address, _ in sky.published].count(HOME) == 1
