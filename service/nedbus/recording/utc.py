"""UTC of a flight, derived from its messages."""

import logging
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any, Final

import numpy as np

from nedbus.client import Sample
from nedbus.log_event import about
from nedbus_msgs import ANY, DEFAULT_TOPIC, Selection, is_unix_time, vehicle_name
from nedbus_msgs.arrays import MessageArray, to_array

from .arrays import Flight, missing_of
from .flight_files import matching, require_one_vehicle

_log = logging.getLogger(__name__)

_FIELDS: Final = ("time_utc_usec", "estimated_offset")  # UTC of a GNSS receiver, or offset to a companion's clock
_RELATIVE: Final = "timestamp_time_relative"  # us from the message's timestamp to the receiver's UTC
_TOLERANCE: Final = 1_000_000  # us; messages this close to the median agree
_AGREEING: Final = 0.9  # fraction that must agree; a smaller one indicates several boots or a clock step
_TAIL: Final = 0.1  # share of the messages that determines the offset after a correction
_MAX_PARTS: Final = 3  # offsets until the last correction; more are a drift
_MAX_CORRECTION: Final = 20e6  # us, more than all leap seconds; a larger step may be another boot
_APART: Final = 1e6  # us between the messages of a source and all others, if both use the same clock


@dataclass(frozen=True, slots=True)
class UtcOffset:
    """Offset from a vehicle's time since boot to Unix time [us], and its source.

    `source`: the stream, "boot_time_utc_us" of a log, or "timestamp" if timestamps are Unix time already, as uXRCE-DDS
    sends them once synchronized. The stream timesync_status is as accurate as the clock of the companion computer.
    `offset_us`: median over the messages of the source; a GNSS fix is a few tenths of a second older than its message.
    `count`: messages within one second of the median; `spread_us`: their maximum minus minimum.
    `corrected_us`: by how much the source corrected its time in flight, as a receiver does that has downloaded the leap
    seconds; the offset after the last correction holds for all messages.
    """

    source: str
    offset_us: int
    count: int
    spread_us: int
    corrected_us: int = 0

    def at(self, timestamp: int) -> datetime:
        """Return the UTC of a `timestamp` from the same boot of this vehicle; Unix time is used as it is."""
        return datetime.fromtimestamp(0, UTC) + timedelta(microseconds=int(self.unix_us(int(timestamp))))

    def unix_us(self, timestamps: Any) -> Any:
        """Return the Unix time [us] of a timestamp or an array of timestamps."""
        return timestamps + self.offset_us * ~np.asarray(is_unix_time(timestamps))


def utc_of(
    flight: str | Path | Mapping[str, MessageArray] | Iterable[Sample[Any]], *, vehicle: str | int = ANY
) -> UtcOffset | None:
    """Return the UTC offset of a .ulg log, an .mcap recording, arrays from `read`, or samples; None if it is unknown.

    For live samples: `utc = nedbus.utc_of(bus.latest("*", vehicle="7"))`, then `utc.at(sample.message.timestamp)` for
    any sample until the vehicle reboots.

    The source is a GNSS receiver with a `time_utc_usec` other than 0, a companion's clock in `timesync_status`, or a
    log's `boot_time_utc_us`, accepted only with a date from 2000 to 2100; Unix timestamps are used as they are.
    A receiver may correct its UTC in flight, at most twice and by up to 20 s; the last part then holds for all. Else
    the offset is unknown, and the reason is logged, if over 10 % of the messages are more than a second off their
    median. A source whose timestamps do not overlap those of the other messages is not used.

    Raises AddressError for several vehicles unless `vehicle` names one, and the errors of `read`.
    """
    found = find_utc(flight, vehicle=vehicle)
    if isinstance(found, UtcOffset):
        return found
    if found:
        _log.warning("UTC is unknown: %s", found, extra=about("incomplete"))
    return None


def find_utc(
    flight: str | Path | Mapping[str, MessageArray] | Iterable[Sample[Any]], *, vehicle: str | int = ANY
) -> UtcOffset | str:
    """Return what `utc_of` returns, or why it is unknown, "" if no message contains UTC."""
    vehicle = vehicle_name(vehicle)
    if isinstance(flight, Mapping):
        return _find_utc(flight)
    if not isinstance(flight, str | Path):
        samples = [each for each in flight if vehicle in (ANY, each.vehicle)]
        require_one_vehicle("the samples", (each.address for each in samples), vehicle)
        return _find_utc({each.address.stream: to_array([each.message]) for each in samples})
    path = Path(flight).expanduser()
    with Flight(path) as opened:
        addresses = matching(path, opened.addresses, Selection(vehicle=vehicle))
        require_one_vehicle(path, addresses, vehicle)
        used = [each for each in addresses if not opened.definitions[each].types.keys().isdisjoint(_FIELDS)]
        others = [each for each in addresses if each not in used]
        others = [each for each in others if each.topic == DEFAULT_TOPIC] or others
        streams = opened.read(used + others if used else addresses[:1])
        return _find_utc({address.stream: messages for address, (messages, _) in streams.items()}, opened.boot_utc)


def _find_utc(streams: Mapping[str, MessageArray], boot_utc: int = 0) -> UtcOffset | str:
    unix = sum(int(np.sum(is_unix_time(messages["timestamp"]))) for messages in streams.values())
    if unix > sum(map(len, streams.values())) / 2:
        return UtcOffset("timestamp", 0, unix, 0)
    names = {name: set(messages.dtype.names or ()) - missing_of(messages) for name, messages in streams.items()}
    others = [messages["timestamp"] for name, messages in streams.items() if names[name].isdisjoint(_FIELDS)]
    period, reasons = _period(np.concatenate([np.zeros(0), *others])), list[str]()
    for field in _FIELDS:
        for name, messages in sorted(streams.items()):
            if field not in names[name]:
                continue
            times, value = messages["timestamp"].astype(np.int64), messages[field].astype(np.int64)
            if field == "estimated_offset":
                utc = times - value
            else:
                utc = value - messages[_RELATIVE] if _RELATIVE in names[name] else value
            is_known = is_unix_time(utc) & ~is_unix_time(times)
            offsets, (first, last) = (utc - times)[is_known], _period(times[is_known])
            if not len(offsets):
                continue
            if len(offsets) > 1 and (first > period[1] + _APART or last < period[0] - _APART):
                reasons.append(f"the timestamps of {name}, which has UTC, are not on the clock of the other messages")
            elif (parts := _stable_parts(times[is_known], offsets)) is None:
                low, high = np.quantile(offsets, [0.05, 0.95]) / 1e6
                reasons.append(
                    f"the UTC of {name} varies by {high - low:.0f} s: a drift, or a mixture of clocks or boots"
                )
            else:
                final, middle = parts[0], int(np.median(parts[0]))
                corrected = middle - int(np.median(parts[1])) if len(parts) > 1 else 0
                return UtcOffset(name, middle, len(final), int(np.ptp(final)), corrected)
    if is_unix_time(boot_utc):
        return UtcOffset("boot_time_utc_us", boot_utc, 1, 0)
    return reasons[0] if reasons else ""


def _period(times: Any) -> tuple[float, float]:
    """Return the period of all but a few wild times since boot."""
    times = times[~np.asarray(is_unix_time(times), bool)]
    return tuple(np.quantile(times, [0.02, 0.98])) if len(times) else (-np.inf, np.inf)


def _stable_parts(times: Any, offsets: Any) -> list[Any] | None:
    """Return the agreeing offsets after the last correction and those before it; None for a drift or a mixture."""
    near = offsets[_is_near(offsets, offsets)]
    if len(near) >= _AGREEING * len(offsets):
        return [near]
    medians = np.median([times[:-2], times[1:-1], times[2:]], axis=0)  # without single wild values
    if (np.diff(medians) < -_TOLERANCE).any():
        return None  # several boots
    parts, few = list[Any](), (1 - _AGREEING) * len(offsets)
    while len(offsets) > few:
        tail = offsets[-max(1, int(_TAIL * len(offsets))) :]
        is_late = _is_near(offsets, tail)
        begin = int(np.argmax(np.append(0, np.cumsum(np.where(is_late, -1, 1)))))
        if len(parts) == _MAX_PARTS or is_late[begin:].mean() < _AGREEING:
            return None
        parts.append(offsets[begin:][is_late[begin:]])
        offsets = offsets[:begin]
    return parts if np.ptp([*map(np.median, parts)]) <= _MAX_CORRECTION else None


def _is_near(offsets: Any, typical: Any) -> Any:
    """Return which offsets agree with one of the typical ones, not with the mean of two clocks."""
    return np.abs(offsets - int(np.quantile(typical, 0.5, method="lower"))) <= _TOLERANCE
