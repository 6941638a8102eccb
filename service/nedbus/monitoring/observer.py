"""Observer of the health of selected streams and of their vehicles' events."""

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

from nedbus import Bus, Sample, clock
from nedbus.health import Health, Monitor, Publishers, RejectionReport, stream_state
from nedbus.timings import TIMINGS
from nedbus.vehicle_events import RECENT, EventLog
from nedbus_msgs import Address, Selection

# A reader is behind with more queued messages than both.
_BACKLOG: Final = 200  # messages
_BACKLOG_TIME: Final = 1.0  # s of messages at their usual rates
_STALL: Final = 2.5  # s between polls; after a longer pause, this process was stalled
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
        self._bus = bus
        self._selection = selection
        self.monitor = Monitor()
        self._rejections = bus.rejections()
        self._last_poll: float | None = None
        self._disconnected = 0.0  # time of the last poll without a link

    def add(self, sample: Sample[Any]) -> None:
        """Add a sample just read; a retained one is no event, because its stream may have ended long ago."""
        if not self.monitor.add(sample):
            return
        self.event_log.add(
            sample.address,
            sample.message,
            clock.steady(),
            missing=sample.provenance.missing,
            lost=sample.lost,
            source=sample.source,
        )

    def poll(self) -> Snapshot:
        """Poll streams, rejections and the link, and record changes in the event log."""
        now = clock.steady()
        connected = self._bus.connected
        dropped = self.subscription.counts.dropped
        waiting = self.subscription.waiting
        healths = self.monitor.snapshot()
        rejected = self._take_rejections(now)
        alive = self._bus.publishers(timeout=0.2)
        if not connected:
            self._disconnected = now
        is_settled = now - self._disconnected > _SETTLING_TIME
        link = "" if connected else f"no link to {' or '.join(self._bus.routers)}"
        self.event_log.update(
            now,
            self._states(healths, alive, is_settled=is_settled),
            link=link,
            dropped=dropped,
            is_behind=self._is_behind(now, waiting, healths),
            present={address.vehicle for address in alive},
        )
        if is_settled:
            self._forget_ended(alive)
        behind = ""
        if self.event_log.overload:
            behind = f"reader overloaded: {waiting} messages queued, {dropped} dropped"
        known = {address: health for address, health in healths.items() if address in self.monitor}
        return Snapshot(now, known, alive, rejected, link, behind)

    def _take_rejections(self, now: float) -> list[RejectionReport]:
        """Take the new rejections of the selection, on the steady clock, and add them to the event log."""
        rejected = list[RejectionReport]()
        for report in self._rejections.take():
            if self._selection.matches(report.address):
                rejected.append(replace(report, received=round(now * 1e9)))
                self.event_log.reject(report.address, report.reason, now)
        return rejected

    def _states(
        self, healths: Mapping[Address, Health], alive: Publishers, *, is_settled: bool
    ) -> dict[Address, str]:
        """Return the state of the main stream of each vehicle; unknown just after a reconnect."""
        states = dict[Address, str]()
        for vehicle in list(self.event_log.vehicles.values()):
            main = vehicle.main
            if main is None:
                continue
            if not is_settled:
                states[main] = "unknown"
            elif main in healths:
                states[main] = stream_state(healths[main], publishers=alive[main]).name
        return states

    def _is_behind(self, now: float, waiting: int, healths: Mapping[Address, Health]) -> bool:
        """Return whether messages wait for this process, or it was stalled since the last poll."""
        was_stalled = self._last_poll is not None and now - self._last_poll > _STALL
        self._last_poll = now
        rate = sum(health.usual_rate or 0.0 for health in healths.values())
        return was_stalled or waiting > max(_BACKLOG, _BACKLOG_TIME * rate)

    def _forget_ended(self, alive: Publishers) -> None:
        """Forget streams without a publisher that have been silent for long; of unknown vehicles, after a minute."""
        for address, newest in self.monitor.items():
            limit = TIMINGS.forgotten
            if address.vehicle not in self.event_log.vehicles:
                limit = min(limit, RECENT)
            # A retained message does not come again.
            is_listed = alive.complete or not newest.sample.retained
            if not alive[address] and newest.age > limit and is_listed:
                # It is kept if a message has arrived in the meantime.
                self.monitor.forget(address, silence=limit)
