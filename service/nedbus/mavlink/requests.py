"""Requests for MAVLink messages: which ones, how often, and when; no I/O, callers pass monotonic time [s]."""

import logging
import math
from collections.abc import Collection, Mapping, Set
from typing import Final, NamedTuple

from pymavlink.dialects.v20 import common as dialect

from nedbus.log_event import about
from nedbus_msgs import DEFAULT_TOPIC, Address

_log = logging.getLogger(__name__)

_FIRST_ROUNDS: Final = 3  # initial transmissions of each request, because links lose messages
_REQUEST_INTERVAL: Final = 5.0  # s between rounds of requests for messages that do not arrive
_MISSING: Final = 3.0  # s after which a message that does not arrive is requested again

_SLOWEST: Final = 2.0  # Hz, on a saturated link
_USABLE_SHARE: Final = 0.9  # share of a link's bandwidth; the rest is for heartbeats and answers
_BITS_PER_BYTE: Final = 10  # on a serial line, with start and stop bits

ORIGIN: Final = dialect.MAVLINK_MSG_ID_GPS_GLOBAL_ORIGIN
QUATERNION: Final = dialect.MAVLINK_MSG_ID_ATTITUDE_QUATERNION
_POSITION: Final = dialect.MAVLINK_MSG_ID_LOCAL_POSITION_NED
_STATUS: Final = dialect.MAVLINK_MSG_ID_ESTIMATOR_STATUS


class Stream(NamedTuple):
    """A message to request. `size`: in MAVLink 2 [bytes]; `rate` [Hz], 0 for the option `rate`."""

    size: int
    rate: float
    topics: Set[str]


_LOCAL: Final = "vehicle_local_position"
_GLOBAL: Final = "vehicle_global_position"
STREAMS: Final[Mapping[int, Stream]] = {
    _POSITION: Stream(40, 0.0, {_LOCAL}),
    _STATUS: Stream(54, 0.0, {_LOCAL, _GLOBAL}),
    dialect.MAVLINK_MSG_ID_GLOBAL_POSITION_INT: Stream(40, 10.0, {_LOCAL, _GLOBAL}),
    dialect.MAVLINK_MSG_ID_ALTITUDE: Stream(44, 10.0, {_LOCAL}),
    dialect.MAVLINK_MSG_ID_ODOMETRY: Stream(244, 10.0, {_LOCAL, "vehicle_odometry"}),
    QUATERNION: Stream(44, 0.0, {"vehicle_attitude"}),
    dialect.MAVLINK_MSG_ID_GPS_RAW_INT: Stream(64, 5.0, {"sensor_gps"}),
    dialect.MAVLINK_MSG_ID_SYSTEM_TIME: Stream(24, 1.0, {"sensor_gps"}),
    dialect.MAVLINK_MSG_ID_SYS_STATUS: Stream(55, 1.0, {"vehicle_status"}),
    dialect.MAVLINK_MSG_ID_BATTERY_STATUS: Stream(66, 1.0, {"battery_status"}),
    dialect.MAVLINK_MSG_ID_HOME_POSITION: Stream(72, 1.0, {"home_position"}),
    dialect.MAVLINK_MSG_ID_EXTENDED_SYS_STATE: Stream(
        14, 1.0, {"vehicle_land_detected", "vehicle_status"}
    ),
}
"""Messages to request, in this order, and the topics that need them."""


def request_rates(rate: float, baud: int | None, topics: Collection[str]) -> dict[int, float]:
    """Return the rates to request [Hz] for these topics: positions at `rate`, other messages at their own rates.

    If a serial link with this baud rate cannot carry them all, the other messages share a common upper limit.
    """
    rates = dict[int, float]()
    for number, stream in STREAMS.items():
        if not stream.topics.isdisjoint(topics):
            rates[number] = stream.rate or rate
    if _STATUS in rates:
        rates[_STATUS] = max(_SLOWEST, rate)
    if baud is not None:
        _reduce(rates, _USABLE_SHARE * baud / _BITS_PER_BYTE)
    return rates


def _reduce(rates: dict[int, float], capacity: float) -> None:
    """Reduce all rates but that of the position until the messages fit into this capacity [bytes/s]."""
    free = capacity - STREAMS[_POSITION].size * rates.get(_POSITION, 0.0)
    others = sorted(rates.keys() - {_POSITION}, key=rates.__getitem__)
    size = sum(STREAMS[number].size for number in others)
    for number in others:  # what slow messages do not need is left for the faster ones
        rates[number] = min(rates[number], max(_SLOWEST, free / size))
        free -= STREAMS[number].size * rates[number]
        size -= STREAMS[number].size


class Requests:
    """The messages to request from one vehicle: each three times, and then every 5 s until it arrives."""

    def __init__(
        self, vehicle: str, topics: Collection[str], *, rate: float, baud: int | None
    ) -> None:
        self._vehicle = vehicle
        self._rates = request_rates(rate, baud, topics)
        if _POSITION in self._rates:
            self._rates[ORIGIN] = 0.0
        self._reported: set[int] = set()  # messages that were logged as not sent
        self.restart(0.0)

    def restart(self, now: float) -> None:
        """Request everything again."""
        self._started = now
        self._arrivals: dict[int, float] = {}  # the last one of each message
        self._pending = [*self._rates] * _FIRST_ROUNDS
        self._next_round = now + _REQUEST_INTERVAL

    def note_arrival(self, number: int, now: float) -> None:
        """Note that a message with this id has arrived."""
        if number in self._rates:
            self._arrivals[number] = now

    def end(self, number: int) -> None:
        """Request a message no more, until the next restart, because the vehicle sends it once per request."""
        self.note_arrival(number, math.inf)

    def last_arrival(self, number: int) -> float:
        """Return the time when a requested message arrived last; that of the first request before the first one."""
        return self._arrivals.get(number, self._started)

    def next(self, now: float) -> tuple[int, float] | None:
        """Return id and rate [Hz] of the next message to request, rate 0 for a single one; None if none is due."""
        if not self._pending and now >= self._next_round:
            self._next_round = now + _REQUEST_INTERVAL
            self._pending = self._missing(now)
            self._report(self._pending)
        if not self._pending:
            return None
        number = self._pending.pop(0)
        return number, self._rates[number]

    def _missing(self, now: float) -> list[int]:
        return [
            number for number in self._rates if now - self._arrivals.get(number, 0.0) > _MISSING
        ]

    def _report(self, missing: Collection[int]) -> None:
        """Log once which messages have never arrived, except for the origin, which a vehicle without a fix lacks."""
        address = Address(self._vehicle, DEFAULT_TOPIC)
        for number in {*missing} - self._arrivals.keys() - self._reported - {ORIGIN}:
            self._reported.add(number)
            name = dialect.mavlink_map[number].msgname
            extra = about("unsupported", address)
            _log.info("vehicle %s does not send %s on request", self._vehicle, name, extra=extra)
