"""The public functions `events` and `why`: from files, an open flight, samples, or live from a bus."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, overload

from nedbus import Flight, Sample
from nedbus.errors import ArgumentError
from nedbus.flights import detect_events
from nedbus_msgs import ANY, Selection, VehicleNames

if TYPE_CHECKING:
    from typing_extensions import TypeIs

    from nedbus import Bus
    from nedbus.health import EventHistory, LiveEvents, Verdict

_Recorded: TypeAlias = str | Path | Sequence[str | Path] | Flight | Iterable[Sample[Any]]


@overload
def events(
    source: Bus, *, vehicle: VehicleNames = ..., within: float | None = ...
) -> LiveEvents: ...
@overload
def events(source: _Recorded, *, vehicle: VehicleNames = ...) -> EventHistory: ...
def events(
    source: Bus | _Recorded, *, vehicle: VehicleNames = ANY, within: float | None = None
) -> LiveEvents | EventHistory:
    """Return the events of vehicles, each with earlier events that may explain it, as `nedbus events` shows them.

    `source`: a .ulg log, an .mcap recording or a .tlog, or several of them, which are merged by UTC; an open flight; or
    samples that end, such as a list of those of a subscription. From these, it returns an EventHistory, which has the
    whole flight; `time` is in seconds since its first message. From a bus, it returns LiveEvents, an iterator that ends
    when it is closed; `time` is Unix time [s].
    `vehicle`: one or several. `within`: of a bus, first the events of the last `within` seconds, which services keep.

    Raises the errors of `nedbus.open` for files, AddressError for an invalid name, ArgumentError for another source and
    for `within` with files, ClosedError once the flight or the bus is closed.
    """
    selection = Selection(vehicle=vehicle)
    if _is_bus(source):
        from nedbus.health import LiveEvents

        return LiveEvents(source, selection, within)
    if within is not None:
        raise ArgumentError(
            "within", within, "None with files and samples, which are read as a whole"
        )
    return detect_events(source).of(selection)


def why(
    source: Bus | _Recorded, *, vehicle: VehicleNames = ANY, at: str | None = None
) -> dict[str, Verdict]:
    """Return the verdict on each vehicle, worst first, as `nedbus why` prints it: usable or not, since when, and why.

    `source`: as in `events`; from a bus, the services' history of the last day, as `bus.why` for all vehicles.
    `vehicle`: one or several, in this order. `at`: the time in question, as in `EventHistory.why`.

    Raises the errors of `events` and of `EventHistory.why`.
    """
    if _is_bus(source):
        history = source.history()
    else:
        history = detect_events(source)
    return history.verdicts(vehicle, at=at)


def _is_bus(source: object) -> TypeIs[Bus]:
    """Return whether a source is a bus; without one, its module, which loads Zenoh, is not imported."""
    module = sys.modules.get("nedbus.client.bus")
    return module is not None and isinstance(source, module.Bus)
