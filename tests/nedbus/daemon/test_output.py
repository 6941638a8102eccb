"""Publishing topics without a rate of a live source, with a fake clock."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any, cast

from nedbus.client import PublisherRegistry
from nedbus.daemon.output import SourceOutput
from nedbus.events import EventLog
from nedbus.sources import SourceMessage
from nedbus_msgs import BY_TOPIC, Address
from tests.flights.messages import VLP

HOME, POSITION, OTHER = Address("1", "home_position"), Address("1", VLP), Address("2", VLP)
ATTITUDE = Address("1", "vehicle_attitude")


class Sky:
    """A live source, and the address and timestamp of each message that it published."""

    def __init__(self) -> None:
        self.now, self.published = 0.0, list[tuple[Address, int]]()
        registry = SimpleNamespace(publisher=self._open)
        self.output = SourceOutput(
            "px4", "px4-zenoh:", cast("PublisherRegistry", registry), lambda: self.now, EventLog()
        )

    def hear(self, seconds: float, *addresses: Address, timestamp: int | None = None) -> None:
        """Advance the clock, receive a message on each of these addresses, and check for silent ones."""
        self.now += seconds
        for address in addresses:
            fields = {"timestamp": round(self.now * 1e6) if timestamp is None else timestamp}
            self.output.publish_live(SourceMessage(0.0, address, fields))
        self.output.expire_stale()

    def _open(self, address: Address, definition: Any, **_: object) -> SimpleNamespace:
        def publish(fields: dict[str, int]) -> None:
            self.published.append((address, fields["timestamp"]))

        return SimpleNamespace(
            definition=definition or BY_TOPIC[address.topic],
            publish=publish,
            close=lambda: None,
            relabel=lambda _: None,
        )


def test_home_stays_while_its_vehicle_is_heard() -> None:
    """A topic sent on events only stays published as long as other messages of its vehicle arrive."""
    sky = Sky()
    sky.hear(1, HOME, POSITION, OTHER)
    for _ in range(10):
        sky.hear(1, POSITION, OTHER)
    assert set(sky.output.addresses) == {HOME, POSITION, OTHER}
    for _ in range(4):
        sky.hear(1, OTHER)
    assert (sky.output.addresses, set(sky.output.stale)) == ([OTHER], {HOME, POSITION})


def test_home_is_back_with_its_vehicle() -> None:
    """It is published again after a link outage, as the vehicle would not repeat it, but not after a reboot."""
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
    """A home position from before a reboot is not published again, even if it was sent seconds after that boot."""
    sky = Sky()
    sky.hear(2, HOME, POSITION)
    for _ in range(30):
        sky.hear(1, POSITION)
    sky.hear(4)
    sky.hear(1, POSITION, timestamp=12_000_000)
    sky.hear(0, ATTITUDE, timestamp=12_100_000)
    assert set(sky.output.addresses) == {POSITION, ATTITUDE}
    assert [address for address, _ in sky.published].count(HOME) == 1


def test_addresses_that_come_one_after_the_other_are_published() -> None:
    """Of more addresses than a source may have, the one that is stale longest makes room for the next."""
    sky = Sky()
    for number in range(1500):
        sky.hear(1, Address(f"v{number}", VLP))
    assert Address("v1499", VLP) in sky.output.addresses
    assert 990 <= len(sky.output.addresses + sky.output.stale) <= 1000
    assert not sky.output.rejected


def test_address_beyond_the_limit_is_refused_until_another_is_stale() -> None:
    """Of a thousand addresses that are published none makes room; what is left out is counted, and said once."""
    sky = Sky()
    present = [Address(f"v{number}", VLP) for number in range(1000)]
    sky.hear(1, *present, OTHER)
    sky.hear(1, *present, OTHER)
    assert OTHER not in sky.output.addresses
    assert sky.output.rejections == {"too many addresses": 2}
    assert sky.output.warnings == (f"vehicles: more than 1000 addresses: {OTHER} is ignored",)
    sky.hear(4, *present[1:])
    sky.hear(1, OTHER)
    assert OTHER in sky.output.addresses
    assert present[0] not in sky.output.stale
