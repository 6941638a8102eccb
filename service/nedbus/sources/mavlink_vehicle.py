"""The state of one MAVLink vehicle: messages in, the fields of an estimate and the next requests out; no I/O, no clock.

Times are monotonic seconds of the caller's clock, if not stated otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

from nedbus_msgs import FLAGS

_WRAP: Final = 2**32  # ms of time_boot_ms, 49.7 days
_MAX_DELAY: Final = 1000  # ms that a datagram may be late; further back is a reboot
_VALUE_TIMEOUT: Final = 2.0  # s after which a value is no longer part of the estimate
_STATUS_TIMEOUT: Final = 5.0  # s, as PX4 sends ESTIMATOR_STATUS once a second if nobody requests it
_SILENCE: Final = 3.0  # s after which all state is reset
_ACK_TIMEOUT: Final = 1.0  # s until a request is repeated
_MAX_TRIES: Final = 5
_RETRY_INTERVAL: Final = 5.0  # s until an unknown origin, or positions that do not arrive, are requested again
_FULL_TURN: Final = 36000  # 0.01 deg, of `hdg`
_UNKNOWN_HEADING: Final = 65535
# Bits of ESTIMATOR_STATUS.flags.
_VELOCITY_HORIZ, _VELOCITY_VERT = 2, 4
_POS_HORIZ_REL, _POS_HORIZ_ABS, _POS_VERT_ABS = 8, 16, 32
_CONST_POS_MODE: Final = 128

ORIGIN: Final = 49  # GPS_GLOBAL_ORIGIN
_POSITION, _STATUS = 32, 230
STREAMS: Final = {_POSITION: 40, _STATUS: 54, 33: 40, 141: 44, 331: 244}
"""The messages that an estimate is made of, in the order of requests, and their bytes on a link: a PX4's, MAVLink 2."""

_RATE: Final = 10.0  # Hz, of what is neither position nor status
_MIN_STATUS_RATE: Final = 2.0  # Hz, on a link that is full without it
_USABLE: Final = 0.9  # of a link; the rest is for heartbeats and answers
_BITS: Final = 10  # of a byte on a serial line, with start and stop


@dataclass(slots=True, eq=False)
class _Expiring:
    """Fields from one message, and until when they are valid."""

    until: float = 0.0
    fields: dict[str, object] | None = None

    def at(self, now: float) -> dict[str, object]:
        return self.fields if self.fields and now <= self.until else {}


class OutOfOrderError(Exception):
    """Raised for a position that arrives after a newer one."""


def request_rates(rate: float, baud: int) -> dict[int, float]:
    """Return the rates to request [Hz]: ESTIMATOR_STATUS as often as positions, at `rate`, if the link carries that."""
    rates = dict.fromkeys(STREAMS, _RATE) | {_POSITION: rate, _STATUS: 0.0}
    free = _USABLE * baud / _BITS - sum(size * rates[number] for number, size in STREAMS.items())
    rates[_STATUS] = max(_MIN_STATUS_RATE, min(rate, free / STREAMS[_STATUS]))
    return rates


class Vehicle:
    """The state of one vehicle: pass messages to `handle`, and send what `requests` yields."""

    def __init__(self, rate: float, baud: int) -> None:
        self._rates = request_rates(rate, baud)
        self._sequences: dict[int, int] = {}  # by component
        self._last_ms: int | None = None
        self._wraps = 0
        self._last_message = 0.0
        self._last_position = 0.0
        self.lost = 0
        self.rebooted = False
        self._reset(0.0)

    def _reset(self, now: float) -> None:
        """Discard what was received, and request everything again: it was silent, or rebooted."""
        self._heading, self._yaw, self._status, self._bottom, self._velocity = (_Expiring() for _ in range(5))
        self._origin: dict[str, object] = {}
        self._is_global = False
        self._pending = [*self._rates, ORIGIN]
        self._tries = 0
        self._next_request = now
        self._sequences.clear()

    def track_sequence(self, component: int, sequence: int, now: float) -> None:
        """Count the messages that were lost before this one, whatever its type."""
        if now - self._last_message > _SILENCE:
            self._reset(now)
        self._last_message = now
        last = self._sequences.get(component)
        step = 1 if last is None else (sequence - last) % 256
        if step > 128:  # out of order: it was counted as lost
            self.lost = max(0, self.lost - 1)
        elif step:  # else a duplicate
            self.lost += step - 1
            self._sequences[component] = sequence

    def requests(self, now: float) -> Iterator[tuple[int, float]]:
        """Yield what to request now: the number of a message, and its rate [Hz], 0 for once."""
        if now < self._next_request or now - self._last_message > _SILENCE:
            return
        if not self._pending and now - self._last_position > _SILENCE:
            self._pending, self._tries = [*self._rates], 0  # it sends messages, but no positions
        if self._tries >= _MAX_TRIES:
            self._pending, self._tries = self._pending[1:], 0
        if self._pending:
            self._tries += 1
            self._next_request = now + _ACK_TIMEOUT
            yield self._pending[0], self._rates.get(self._pending[0], 0.0)
        elif not self._origin:
            self._pending, self._next_request = [ORIGIN], now + _RETRY_INTERVAL

    def acknowledge(self, now: float) -> int | None:
        """Go on after an answer to the last request, whatever its result; return the message that was requested."""
        if not self._pending or not self._tries:
            return None
        number, *self._pending = self._pending
        self._tries = 0
        self._next_request = now if self._pending else now + _RETRY_INTERVAL
        return number

    def has(self, number: int) -> bool:
        """Return whether it should be able to send this message now: without a global position there is no origin."""
        return number != ORIGIN or self._is_global

    def handle(self, message: Any, now: float) -> dict[str, object] | None:
        """Return the fields of an estimate if this is a position, else None.

        Raises OutOfOrderError for a position that is older than the last one.
        """
        match message.get_type():
            case "LOCAL_POSITION_NED":
                return self._estimate(message, now)
            case "GLOBAL_POSITION_INT" if message.hdg != _UNKNOWN_HEADING:
                heading = math.radians(message.hdg % _FULL_TURN / 100)
                self._heading = _Expiring(now + _VALUE_TIMEOUT, {"heading": math.remainder(heading, math.tau)})
            case "ATTITUDE" if math.isfinite(message.yaw):
                self._yaw = _Expiring(now + _VALUE_TIMEOUT, {"heading": math.remainder(message.yaw, math.tau)})
            case "GPS_GLOBAL_ORIGIN" if abs(message.latitude) <= 90e7 and abs(message.longitude) <= 180e7:
                self._origin = {
                    "xy_global": True,
                    "z_global": True,
                    "ref_lat": message.latitude / 1e7,
                    "ref_lon": message.longitude / 1e7,
                    "ref_alt": message.altitude / 1e3,
                    **({"ref_timestamp": message.time_usec} if message.time_usec else {}),
                }
            case "ALTITUDE":
                is_known = math.isfinite(message.bottom_clearance)
                bottom: dict[str, object] = {"dist_bottom": message.bottom_clearance} if is_known else {}
                self._bottom = _Expiring(now + _VALUE_TIMEOUT, {"dist_bottom_valid": is_known, **bottom})
            case "ODOMETRY":
                fields = _velocity_deviations(message.velocity_covariance)
                self._velocity = _Expiring(now + _VALUE_TIMEOUT, fields)
            case "ESTIMATOR_STATUS":
                deviations = {"eph": message.pos_horiz_accuracy, "epv": message.pos_vert_accuracy}
                known = {name: value for name, value in deviations.items() if math.isfinite(value)}
                self._is_global = bool(message.flags & _POS_HORIZ_ABS)
                self._status = _Expiring(now + _STATUS_TIMEOUT, _validity(message.flags) | known)
        return None

    def _estimate(self, message: Any, now: float) -> dict[str, object]:
        self._track_time(message.time_boot_ms, now)
        self._last_position = now
        position = {name: getattr(message, name) for name in ("x", "y", "z", "vx", "vy", "vz")}
        fields: dict[str, object] = {
            "timestamp": (self._wraps * _WRAP + message.time_boot_ms) * 1000,
            **position,
            **self._yaw.at(now),
            **self._heading.at(now),
            **self._status.at(now),
            **self._bottom.at(now),
            **self._velocity.at(now),
            **self._origin,
        }
        # The flags are from an earlier message: these fields may have become NaN since.
        for flag in ("xy_valid", "z_valid", "v_xy_valid", "v_z_valid"):
            if fields.get(flag) and not all(math.isfinite(position[name]) for name in FLAGS[flag].fields):
                fields[flag] = False
        return fields

    def _track_time(self, ms: int, now: float) -> None:
        if self._last_ms is not None:
            step = (ms - self._last_ms + _WRAP // 2) % _WRAP - _WRAP // 2
            if -_MAX_DELAY <= step < 0:
                raise OutOfOrderError(f"time_boot_ms {ms} after {self._last_ms}")
            if step < 0:
                self.rebooted = True
                self.lost = 0  # the sequence restarted too, so the count is wrong
                self._wraps = 0
                self._reset(now)
            elif ms < self._last_ms:
                self._wraps += 1
        self._last_ms = ms


def _validity(bits: int) -> dict[str, object]:
    """Return what ESTIMATOR_STATUS.flags say about position and velocity.

    The constant position mode was the opposite of a horizontal velocity up to PX4 1.15; since PX4's commit 48f1687d3a
    it is set for every vehicle at rest too, whose velocity and position are valid.
    """
    is_constant = bits & _CONST_POS_MODE and not bits & _VELOCITY_HORIZ
    return {
        "xy_valid": bool(bits & (_POS_HORIZ_REL | _POS_HORIZ_ABS)) and not is_constant,
        "z_valid": bool(bits & _POS_VERT_ABS),
        "v_xy_valid": bool(bits & _VELOCITY_HORIZ),
        "v_z_valid": bool(bits & _VELOCITY_VERT),
    }


def _velocity_deviations(covariance: Any) -> dict[str, object]:
    """Return evh and evv from the variances in the diagonal, as far as they are known."""
    north, east, down = covariance[0], covariance[6], covariance[11]
    fields: dict[str, object] = {}
    if math.isfinite(north + east) and min(north, east) >= 0:
        fields["evh"] = math.sqrt(north + east)
    if math.isfinite(down) and down >= 0:
        fields["evv"] = math.sqrt(down)
    return fields
