"""Recordings of the datagrams between a real PX4 and a service, played into the output of a source; without sockets."""

from __future__ import annotations

import math
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final, cast

import pytest

from nedbus import clock
from nedbus.client import Health, PublisherRegistry, stream_state
from nedbus.daemon.output import SourceOutput
from nedbus.mavlink.parser import Received, new_parser, parse
from nedbus.sources import Rejection, SourceMessage
from nedbus.sources.mavlink.position_sender import BusAccess
from nedbus.sources.mavlink.reader import LogReceiver
from nedbus.sources.mavlink.source import _LinkSession
from nedbus.sources.options import MavlinkOptions
from nedbus.vehicle_events import Event, EventLog, Times, Verdict, report_of, verdict_of
from nedbus_msgs import BY_TOPIC, Address
from tests.peers.px4_log_stream import datagrams

_TICK: Final = 0.25  # s of the recording between two checks of the streams


class Receiver(LogReceiver):
    """The receiver of a link without its thread."""

    def __init__(self, options: MavlinkOptions) -> None:
        self._reader, self._options, self._send = (
            cast("Any", SimpleNamespace(name="udp")),
            options,
            self._answer,
        )
        self._sent: list[int] = []  # times in TIMESYNC requests, which the vehicle answers at once
        self.vehicles = {}

    def _answer(self, message: Any, _: object) -> None:
        if message.get_type() == "TIMESYNC":
            self._sent.append(message.ts1)

    def tick(self, now: float) -> None:
        for vehicle in self.vehicles.values():
            self._execute(vehicle, vehicle.client.tick(now))
            while self._sent:
                self._execute(vehicle, vehicle.client.on_timesync(self._sent.pop(), now))

    def process(self, received: Received) -> Received | Rejection:
        self.tick(received.time)
        return self._process(received)


def play(
    path: Path, options: MavlinkOptions
) -> Iterator[tuple[float, SourceMessage | Rejection | None]]:
    """Yield the items of the source and their times of arrival [s]."""
    session = _LinkSession(
        cast("Any", SimpleNamespace(send=lambda *_: None, peer=None, baud=None)),
        options,
        name="udp",
        access=BusAccess(None, (), None, "nedbus"),
    )
    session._receiver = receiver = Receiver(options)
    checked = math.nan
    for when, is_sent, frame in datagrams(path):
        checked = when if math.isnan(checked) else checked
        while checked + _TICK <= when:
            checked += _TICK
            receiver.tick(checked)
            for log in session._logs.values():
                log.log_changes()
            yield checked, None
        for item in parse(new_parser(), frame, "udp", ("127.0.0.1", 1), when) if is_sent else ():
            found = item if isinstance(item, Rejection) else receiver.process(item)
            if isinstance(found, Rejection):
                yield when, found
                continue
            for each in session._handle(found):
                yield when, each


class Service:
    """A service without a network that receives a recording.

    `start`, `now`: times in it [s]. `rejected`: reports of rejected messages.
    """

    def __init__(self, path: Path, monkeypatch: pytest.MonkeyPatch, **options: Any) -> None:
        self.now = self.start = 0.0
        self.event_log = EventLog()
        self.rejected: list[object] = []
        registry = SimpleNamespace(
            publisher=self._open, reject=lambda _, report: self.rejected.append(report)
        )
        self.output = SourceOutput(
            "udp", "mavlink:udp", cast("PublisherRegistry", registry), self._now, self.event_log
        )
        monkeypatch.setattr(clock, "steady", self._now)
        self._items = play(
            path, MavlinkOptions.model_validate({"log": "armed", "state": "0"} | options)
        )

    def run(self, until: float = 1e9) -> Service:
        """Play the recording up to this time [s since its start]."""
        for time, item in self._items:
            self.now, self.start = time, self.start or time
            if isinstance(item, Rejection):
                self.output.reject(item)
            elif item is not None:
                self.output.publish_live(item)
            else:
                self.output.expire_stale()
                alive, healths = {*self.output.addresses}, self.healths
                mains = [each.main for each in self.event_log.vehicles.values() if each.main]
                states = {
                    each: stream_state(healths[each], publishers=each in alive).name
                    for each in mains
                }
                self.event_log.update(self.now, states, present={each.vehicle for each in alive})
            if self.now - self.start >= until:
                break
        return self

    @property
    def healths(self) -> dict[Address, Health]:
        streams, now = self.output._streams.items(), round(1e9 * self.now)
        return {address: stream.health.snapshot(now) for address, stream in streams}

    def verdict(self, vehicle: str = "4") -> Verdict:
        """Return the verdict of `nedbus why` on the live vehicle."""
        known = report_of(self.event_log, "", "", self.now, within=1e9).vehicles[vehicle]
        return verdict_of(
            vehicle, self.event_log.events, known.held, topics=known.topics, unknown=known.unknown,
            times=Times(is_live=True), end=self.now,
        )  # fmt: skip

    def events(self, *kinds: str) -> list[Event]:
        return [each for each in self.event_log.events if not kinds or each.kind in kinds]

    def _now(self) -> float:
        return self.now

    def _open(self, address: Address, definition: Any, **_: object) -> SimpleNamespace:
        return SimpleNamespace(
            definition=definition or BY_TOPIC[address.topic], source="mavlink",
            publish_encoded=lambda *_: None, close=lambda: None, relabel=lambda _: None,
        )  # fmt: skip
