"""Observer of the health of selected streams and of their vehicles' events."""

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from nedbus import Bus, Sample, clock
from nedbus.health import Health, Monitor, RejectionReport, stream_state
from nedbus.timings import TIMINGS
from nedbus.vehicle_events import RECENT, EventLog
from nedbus_msgs import Address, Selection

_MAX_WAITING: Final = 200  # queued messages above which the reader is behind
_MAX_LAG: Final = 1.0  # s; if more, the limit is the usual number of messages in this time
_MAX_PAUSE: Final = 2.5  # s between polls; after a longer pause, this process was stalled
_SETTLING_TIME: Final = 3.0  # s after a reconnect; delayed messages have arrived by then


@dataclass(frozen=True, slots=True)
class Snapshot:
    """Snapshot of the streams, new rejections and the link.

    `time`: time on the steady clock [s]; `rejected` uses the same clock.
    `healths`: health by stream, without streams of forgotten vehicles and those silent for an hour.
    `alive`: number of publishers by address, None if unknown.
    `link`, `behind`: fault of the router link and of this reader, "" if none.
    """

    time: float
    healths: Mapping[Address, Health] = field(default_factory=dict)
    alive: Counter[Address] | None = None
    rejected: Sequence[RejectionReport] = ()
    link: str = ""
    behind: str = ""


class Observer:
    """Subscribe to a selection and keep an `event_log` of its vehicles on the steady clock.

    The thread that reads `subscription` passes each sample to `add`. One thread calls `poll`, about twice a second.
    `monitor`: the newest message and the health of each stream.
    """

    def __init__(self, bus: Bus, selection: Selection) -> None:
        self.event_log = EventLog()
        self.subscription = bus.subscribe(
            *selection.topics, vehicle=selection.vehicles, instance=selection.instance, mode="every"
        )
        self._bus, self._selection = bus, selection
        self.monitor = Monitor()
        self._rejections = bus.rejections()
        self._last_poll: float | None = None
        self._disconnected = 0.0  # time of the last poll without a link

    def add(self, sample: Sample[Any]) -> None:
        """Add a sample just read; a retained one is no event, because its stream may have ended long ago."""
        if self.monitor.add(sample):
            missing, now = sample.provenance.missing, clock.steady()
            self.event_log.add(
                sample.address,
                sample.message,
                now,
                missing=missing,
                lost=sample.lost,
                source=sample.source,
            )

    def poll(self) -> Snapshot:
        """Poll streams, rejections and the link, and record changes in the event log."""
        now, connected = clock.steady(), self._bus.connected
        dropped, waiting = self.subscription.counts.dropped, self.subscription.waiting
        healths = self.monitor.snapshot()
        taken = [
            report for report in self._rejections.take() if self._selection.matches(report.address)
        ]
        rejected = [replace(report, received=round(now * 1e9)) for report in taken]
        for report in rejected:
            self.event_log.reject(report.address, report.reason, now)
        alive = self._bus.publishers(timeout=0.2)
        self._disconnected = self._disconnected if connected else now
        settled = now - self._disconnected > _SETTLING_TIME
        states = {
            main: stream_state(healths[main], publishers=alive[main]).name if settled else "unknown"
            for main in [vehicle.main for vehicle in list(self.event_log.vehicles.values())]
            if main is not None and (main in healths or not settled)
        }
        link = "" if connected else f"no link to {' or '.join(self._bus.routers)}"
        paused = self._last_poll is not None and now - self._last_poll > _MAX_PAUSE
        self._last_poll = now
        rate = sum(health.usual_rate or 0.0 for health in healths.values())
        is_behind = paused or waiting > max(_MAX_WAITING, _MAX_LAG * rate)
        present = {each.vehicle for each in alive}
        self.event_log.update(
            now, states, link=link, dropped=dropped, is_behind=is_behind, present=present
        )
        if settled:
            for address, each in self.monitor.items():
                limit = min(
                    TIMINGS.forgotten,
                    math.inf if address.vehicle in self.event_log.vehicles else RECENT,
                )
                # a retained message does not come again
                is_listed = alive.complete or not each.sample.retained
                if not alive[address] and each.age > limit and is_listed:
                    # unless a message has arrived in the meantime
                    self.monitor.forget(address, silence=limit)
        behind = (
            f"reader overloaded: {waiting} messages queued, {dropped} dropped"
            if self.event_log.overload
            else ""
        )
        healths = {address: each for address, each in healths.items() if address in self.monitor}
        return Snapshot(now, healths, alive, rejected, link, behind)
