"""A vehicle with synthetic messages, and its event log."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any, Final

from nedbus.vehicle_events import Event, EventLog
from nedbus_msgs import Address, get_topic
from tests.flights.messages import VALID, VLP, message

POSITION: Final = Address("1", VLP)
GOOD_GPS: Final[dict[str, Any]] = {
    "fix_type": 3, "satellites_used": 12, "jamming_state": 0, "jamming_indicator": 0, "spoofing_state": 0,
}  # fmt: skip
ORIGIN: Final[dict[str, Any]] = {
    "xy_global": True, "z_global": True, "ref_lat": 47.0, "ref_lon": 8.0, "ref_alt": 500.0,
}  # fmt: skip
DISARMED, ARMED = 1, 2


class Flight:
    """A vehicle and its event log; messages arrive without delay, and times are in seconds."""

    def __init__(self) -> None:
        self.event_log = EventLog()
        self.now = 100.0
        self.booted = 90.0
        self.link = ""
        self._seen = 0

    def wait(self, seconds: float) -> Flight:
        self.now += seconds
        return self

    def send(
        self, topic: str = VLP, *, vehicle: str = "1", instance: int | None = None, missing: Iterable[str] = (),
        lost: int = 0, **fields: Any,
    ) -> list[Event]:  # fmt: skip
        """Send a message, with valid flags by default; return the new events."""
        stamp = round((self.now - self.booted) * 1e6)
        values: object = {"timestamp": stamp, **fields}
        if topic == VLP:
            values = message(stamp, **(VALID | ORIGIN | fields))
        instance = 0 if instance is None and get_topic(topic).instances else instance
        address = Address(vehicle, topic, instance)
        self.event_log.add(address, values, self.now, missing=frozenset(missing), lost=lost)
        return self.new_events()

    def fly(self, seconds: float, rate: float = 10.0) -> list[Event]:
        """Send positions for this duration; return the new events."""
        reported = []
        for _ in range(round(seconds * rate)):
            self.wait(1 / rate)
            reported += self.send()
        return reported

    def gps(self, **fields: Any) -> list[Event]:
        return self.send("vehicle_gps_position", **GOOD_GPS | fields)

    def status(self, state: int, **fields: Any) -> list[Event]:
        return self.send(
            "vehicle_status", **{"arming_state": state, "nav_state": 4, "failsafe": False} | fields
        )

    def battery(self, warning: int) -> list[Event]:
        return self.send("battery_status", warning=warning, remaining=0.2, connected=True)

    def update(self, state: str | None = "ok", *, dropped: int = 0) -> list[Event]:
        """Update the event log with the state of the position stream (None if not observed); return the new events."""
        self.event_log.update(
            self.now, None if state is None else {POSITION: state}, link=self.link, dropped=dropped
        )
        return self.new_events()

    def reject(self, reason: str = "x is NaN") -> list[Event]:
        self.event_log.reject(POSITION, reason, self.now)
        return self.new_events()

    def new_events(self) -> list[Event]:
        new, self._seen = self.event_log.events_since(self._seen)
        return new

    @property
    def severity(self) -> str:
        return self.event_log.state("1", self.now).severity

    @property
    def kinds(self) -> list[str]:
        return [each.kind for each in self.event_log.state("1", self.now).conditions]


def lose_gps(flight: Flight) -> None:
    """Lose the GPS fix, then the position estimate."""
    flight.gps()
    flight.fly(1)
    flight.gps(fix_type=0, satellites_used=0)
    flight.wait(1.0).send(dead_reckoning=True)
    flight.wait(2.0).send(dead_reckoning=True)
    flight.wait(2.0).send(dead_reckoning=True, xy_valid=False, v_xy_valid=False)
    flight.wait(0.5).status(ARMED)
    flight.wait(0.5).status(ARMED, failsafe=True)
