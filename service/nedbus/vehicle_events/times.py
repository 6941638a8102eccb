"""Event times as text: UTC if known, else seconds since boot; and durations."""

import math
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Final

from nedbus.clock import format_duration, format_utc
from nedbus.timeline import unix_seconds

from .event import Event

_CLOCK: Final = re.compile(r"([01]?\d|2[0-3]):([0-5]\d)(?::([0-5]\d(?:\.\d+)?))?")

# Descriptions of the clocks that times may refer to; UTC and time since boot may differ between vehicles.
_CLOCKS: Final[Mapping[str, str]] = {
    "host": "UTC, from the clocks of the hosts",
    "vehicle": "UTC, from the vehicle's messages",
    "boot": "seconds since boot",
    "start": "seconds since the start of the recording",
}


@dataclass(frozen=True, slots=True)
class Times:
    """Conversion of event times to UTC, for live data or a file.

    `is_live`: event times are on a clock of this host; `ahead`: Unix time minus that clock [s].
    `offsets`: Unix time minus time since boot [s], for each vehicle whose messages contain it.
    `remarks`: for each vehicle of a file, why its UTC is unknown, or that it was corrected in flight.
    """

    is_live: bool = False
    offsets: Mapping[str, float] = field(default_factory=dict)
    ahead: float = 0.0
    remarks: Mapping[str, str] = field(default_factory=dict)

    def describe(self, clocks: Collection[str]) -> str:
        """Describe clocks, by the keys that `clock` returns, with the remarks on UTC."""
        reasons = {text for name, text in self.remarks.items() if name not in self.offsets}
        notes = {text for name, text in self.remarks.items() if name in self.offsets}
        why = " and ".join(sorted(reasons)) or "no message contains UTC"
        remarks = {
            "boot": f", because {why}",
            "vehicle": "".join(f"; {note}" for note in sorted(notes)),
        }
        return "; ".join(_CLOCKS[clock] + remarks.get(clock, "") for clock in sorted(clocks))

    def utc(self, event: Event) -> float | None:
        """Return the Unix time of an event [s], None if unknown."""
        if self.is_live:
            return event.time + self.ahead
        if event.boot is None:
            return None
        return self.utc_of_boot(event.vehicle, event.boot)

    def utc_of_boot(self, vehicle: str, boot: float) -> float | None:
        """Convert a time since a vehicle's boot, which may already be Unix time, to Unix time [s]; None if unknown."""
        return unix_seconds(boot, self.offsets.get(vehicle))

    def clock(self, event: Event) -> str:
        """Return the clock used for an event: host, vehicle, boot or start."""
        if self.is_live:
            return "host"
        if self.utc(event) is not None:
            return "vehicle"
        if event.boot is None:
            return "start"
        return "boot"

    @staticmethod
    def unit(clock: str) -> str:
        """Return the unit of a clock's times: "UTC", or seconds with their epoch, such as "s since boot"."""
        return _CLOCKS[clock].partition(",")[0].replace("seconds", "s")

    def text(self, event: Event) -> str:
        """Format the time of an event without the date, as `find` parses it: 14:05:12.3, 123.400 or +12.300."""
        utc = self.utc(event)
        if utc is not None:
            return format_utc(utc)
        if event.boot is not None:
            return f"{event.boot:.3f}"
        return f"+{event.time:.3f}"

    def text_at(self, time: float) -> str:
        """Format a time of live data on the event log's clock [s], as UTC."""
        return format_utc(time + self.ahead)

    def period(self, begin: Event | None, end: Event | None, lasted: float) -> str:
        """Format a period and its duration [s]; `begin` and `end` are None if they are outside the data."""
        still = "until the end"
        if self.is_live:
            still = "until now"
        duration = f"({format_duration(lasted)})"
        if begin is None:
            return f"from the first message {still} {duration}"
        start = self.text(begin)
        if end is not None:
            unit = Times.unit(self.clock(end))
            if begin.boot is not None and end.boot is not None and end.boot < begin.boot:
                unit += ", after a reboot"
            return f"from {start} to {self.text(end)} {unit} {duration}"
        unit = Times.unit(self.clock(begin))
        if lasted == 0:
            return f"at {start} {unit}"
        return f"from {start} {unit}, {still} {duration}"

    def find(self, text: str, near: Event) -> float:
        """Parse 14:05:12 (UTC), 123.4 (since boot) or +12.3 (since the start); return the event log's time [s].

        `near`: an event of the same vehicle; an ambiguous time resolves to the one closest to it.

        Raises ValueError for other text, for UTC or time since boot if no message has it, and for +12.3 in live data.
        """
        text = text.strip()
        clock = _CLOCK.fullmatch(text)
        if clock is not None:
            return self._find_utc(clock, near)
        try:
            seconds = float(text)
        except ValueError:
            seconds = math.nan
        if not math.isfinite(seconds):
            raise ValueError("not a time")
        if text[0] in "+-":
            if self.is_live:
                raise ValueError("live data has no start")
            return seconds
        if near.boot is not None:
            return near.time + seconds - near.boot
        if self.is_live:
            raise ValueError("no message of this vehicle has the time since boot")
        return seconds

    def _find_utc(self, clock: re.Match[str], near: Event) -> float:
        """Return the event log's time [s] of a time of day, of the day on which it is closest to an event."""
        utc = self.utc(near)
        if utc is None:
            raise ValueError(self.remarks.get(near.vehicle, "no message of this vehicle has UTC"))
        day = datetime.fromtimestamp(utc, UTC)
        midnight = day.replace(hour=0, minute=0, second=0, microsecond=0)
        hours, minutes, seconds = clock.groups(default="0")
        time = timedelta(hours=int(hours), minutes=int(minutes), seconds=float(seconds))
        step = (midnight + time).timestamp() - utc
        half_a_day = 43_200
        # closest, also across midnight
        closest = (step + half_a_day) % (2 * half_a_day) - half_a_day
        return near.time + closest
