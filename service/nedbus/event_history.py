"""The events of files, samples or services, with the state of each vehicle, and the verdict on each vehicle."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Final

from nedbus import limits
from nedbus.health import AccountReport, Event, Times, VehicleReport, Verdict
from nedbus.vehicle_events import ALL, by_vehicle, events_outside, verdict_of
from nedbus_msgs import ANY, AddressError, ArgumentError, Selection, VehicleNames, vehicle_name

_AT: Final = "14:05:12 (UTC), 123.4 (s since boot) or +12.3 (s since the start of the recording)"


@dataclass(frozen=True, slots=True)
class EventHistory:
    """Events of vehicles in chronological order, over which it iterates; `nedbus.events` or `bus.history` returns one.

    `events`: times are seconds since the first message of the files or samples, or Unix times of the services.
    `reports`: by vehicle, worst first, the report that describes it; `vehicles` has the states.
    `times`: conversion of event times to UTC. `from_start`: by vehicle, the conditions that are active since its first
    message and cause no event, as text. `dropped`: oldest events left out, because there are more than 100,000.
    `warnings`: damage of the files, and what was left out. `begins`: by vehicle, when its file begins; 0 if not named.
    """

    events: tuple[Event, ...]
    reports: Mapping[str, AccountReport]
    times: Times
    from_start: Mapping[str, str] = field(default_factory=dict)
    dropped: int = 0
    warnings: tuple[str, ...] = ()
    begins: Mapping[str, float] = field(default_factory=dict)

    @property
    def vehicles(self) -> dict[str, VehicleReport]:
        """The state of each vehicle at the end, worst first."""
        states = {}
        for name, report in self.reports.items():
            states[name] = report.vehicles[name]
        return states

    @property
    def end(self) -> float:
        """The time of the last message, or in live data now, on the clock of `event.time` [s]."""
        ends = [report.now for report in self.reports.values()]
        return max(ends, default=0.0)

    def utc(self, event: Event) -> float | None:
        """Return the Unix time of an event [s], None if unknown."""
        return self.times.utc(event)

    def of(self, selection: Selection) -> EventHistory:
        """Return the part about selected vehicles, with the events of the link and of the reader.

        Raises AddressError for a vehicle that is not in `vehicles`.
        """
        if selection.vehicles == (ANY,):
            return self
        selected = selection.vehicles
        for name in selected:
            self._require(name)
        reports = {name: self.reports[name] for name in selected}
        from_start = {name: text for name, text in self.from_start.items() if name in selected}
        shown = (ALL, *selected)
        events = [event for event in self.events if event.vehicle in shown]
        return replace(self, events=tuple(events), reports=reports, from_start=from_start)

    def why(self, vehicle: str | int, *, at: str | None = None) -> Verdict:
        """Return the verdict on a vehicle: usable or not, since when, for how long, and why.

        `at`: the time in question: "14:05:12" (UTC), "123.4" (seconds since boot) or, in a file, "+12.3" (seconds since
        the start of the recording). By default, a file is judged as a whole, and live data by its present state.

        Raises AddressError for a vehicle that is not in `vehicles`, ArgumentError for `at` if it is no such time, or if
        the data has no such clock.
        """
        name = vehicle_name(vehicle)
        self._require(name)
        report = self.reports[name]
        events = [event for event in self.events if event.vehicle in (name, ALL)]
        state = report.vehicles[name]
        at_time = self._moment(at, events)
        verdict = verdict_of(
            name,
            events,
            state.held,
            topics=state.topics,
            unknown=state.unknown,
            times=self.times,
            end=report.now,
            at=at_time,
            since=state.first,
            begin=self.begins.get(name, 0.0),
        )
        others = tuple(events_outside(verdict.stories, events))
        return replace(verdict, others=others)

    def verdicts(self, vehicle: VehicleNames = ANY, *, at: str | None = None) -> dict[str, Verdict]:
        """Return the verdict on each vehicle, worst first, or on the named ones in this order; errors as of `why`."""
        names = Selection(vehicle=vehicle).vehicles
        if names == (ANY,):
            names = tuple(self.reports)
        return {name: self.why(name, at=at) for name in names}

    def _require(self, vehicle: str) -> None:
        if vehicle in self.reports:
            return
        expected = "a vehicle with messages, but there is none"
        if self.reports:
            names = [*self.reports][: limits.SHOWN_NAMES]
            expected = f"one of {', '.join(names)}"
        raise AddressError("vehicle", vehicle, expected, problem="is not in this history")

    def _moment(self, at: object, events: list[Event]) -> float | None:
        """Return the time in question on the clock of the events; None for all."""
        if at is None:
            return None
        if not isinstance(at, str):
            raise ArgumentError("at", at, f"a string, such as {_AT}")
        if not events:
            return None
        try:
            return self.times.find(at, events[-1])
        except ValueError as exc:
            raise ArgumentError("at", at, _AT, problem=f"is not in this data ({exc})") from exc

    def __iter__(self) -> Iterator[Event]:
        return iter(self.events)

    def __len__(self) -> int:
        return len(self.events)


def history_of_services(reports: Collection[AccountReport]) -> EventHistory:
    """Return the history of all services as one; times are Unix times by the clocks of the hosts [s]."""
    events: list[Event] = []
    for report in reports:
        events += report.events
    events.sort(key=lambda event: event.time)
    return EventHistory(tuple(events), by_vehicle(reports), Times(is_live=True))
