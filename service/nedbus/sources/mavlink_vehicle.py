"""One vehicle as MAVLink tells of it: messages in, the fields of an estimate out, and what to ask it for.

No I/O. Times are seconds of the reader's clock, where not said otherwise.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

_WRAP: Final = 2**32  # ms of time_boot_ms, 49.7 days
_REORDERED: Final = 1000  # ms that a datagram may be late; further back is a reboot
_FRESH: Final = 2.0  # s for which a value is still part of the estimate
_FLAGS_FRESH: Final = 5.0  # s, as PX4 says it less often
_SILENCE: Final = 3.0  # s after which nothing is taken for granted any more
_PATIENCE: Final = 1.0  # s until something is asked for again
_TRIES: Final = 5
_AGAIN: Final = 5.0  # s until an origin that nobody told, or positions that do not come, are asked for again
_HOME_LAP: Final = 36000  # 0.01 deg
_UNKNOWN_HEADING: Final = 65535

ORIGIN: Final = 49  # GPS_GLOBAL_ORIGIN
STREAMS: Final = {32: None, 230: 2.0, 33: 10.0, 141: 10.0, 331: 10.0}
"""The messages that an estimate is made of, and how often each is asked for [Hz]; positions as the options say."""


@dataclass(slots=True, eq=False)
class _Kept:
    """Values that one message gave, and until when they hold."""

    until: float = 0.0
    fields: dict[str, object] | None = None

    def at(self, now: float) -> dict[str, object]:
        return self.fields if self.fields and now <= self.until else {}


class OutOfOrderError(Exception):
    """Raise for a position that was overtaken by a newer one."""


class Vehicle:
    """The state of one vehicle; feed it with `take`, and send what `requests` yields."""

    def __init__(self, rate: float) -> None:
        self._rates = {number: rate if hertz is None else hertz for number, hertz in STREAMS.items()}
        self._sequences: dict[int, int] = {}  # by component
        self._last_ms: int | None = None
        self._wraps = 0
        self.heard = 0.0
        self._placed = 0.0  # when it told its position last
        self.lost = 0
        self.restarted = False
        self._forget(0.0)

    def _forget(self, now: float) -> None:
        """Take nothing for granted: it was silent, or started again."""
        self._heading, self._yaw, self._status, self._bottom, self._speed = (_Kept() for _ in range(5))
        self._origin: dict[str, object] = {}
        self._wanted = [*self._rates, ORIGIN]
        self._tries = 0
        self._ask_at = now
        self._sequences.clear()

    def count(self, component: int, sequence: int, now: float) -> None:
        """Take note of a message of any kind: its sequence tells how many were lost before it."""
        if now - self.heard > _SILENCE:
            self._forget(now)
        self.heard = now
        last = self._sequences.get(component)
        step = 1 if last is None else (sequence - last) % 256
        if step > 128:  # it was overtaken, and taken for lost
            self.lost = max(0, self.lost - 1)
        elif step:  # else it came twice
            self.lost += step - 1
            self._sequences[component] = sequence

    def requests(self, now: float) -> Iterator[tuple[int, float]]:
        """Yield what to ask for now: a message's number, and at what rate [Hz]; 0 stands for once."""
        if now < self._ask_at or now - self.heard > _SILENCE:
            return
        if not self._wanted and now - self._placed > _SILENCE:
            self._wanted, self._tries = [*self._rates], 0  # it talks, but not of where it is
        if self._tries >= _TRIES:
            self._wanted, self._tries = self._wanted[1:], 0
        if self._wanted:
            self._tries += 1
            self._ask_at = now + _PATIENCE
            yield self._wanted[0], self._rates.get(self._wanted[0], 0.0)
        elif not self._origin:
            self._wanted, self._ask_at = [ORIGIN], now + _AGAIN

    def answered(self, now: float) -> int | None:
        """Take note that it answered the last request, whatever the answer; return which that was."""
        if not self._wanted or not self._tries:
            return None
        number, *self._wanted = self._wanted
        self._tries = 0
        self._ask_at = now if self._wanted else now + _AGAIN
        return number

    def take(self, message: Any, now: float) -> dict[str, object] | None:
        """Return the fields of an estimate if this is a position, else None.

        Raises OutOfOrderError for a position that is older than the last one.
        """
        match message.get_type():
            case "LOCAL_POSITION_NED":
                return self._estimate(message, now)
            case "GLOBAL_POSITION_INT" if message.hdg != _UNKNOWN_HEADING:
                turn = math.radians(message.hdg % _HOME_LAP / 100)
                self._heading = _Kept(now + _FRESH, {"heading": math.remainder(turn, math.tau)})
            case "ATTITUDE" if math.isfinite(message.yaw):
                self._yaw = _Kept(now + _FRESH, {"heading": math.remainder(message.yaw, math.tau)})
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
                seen = math.isfinite(message.bottom_clearance)
                bottom: dict[str, object] = {"dist_bottom": message.bottom_clearance} if seen else {}
                self._bottom = _Kept(now + _FRESH, {"dist_bottom_valid": seen, **bottom})
            case "ODOMETRY":
                self._speed = _Kept(now + _FRESH, _spread_of_velocity(message.velocity_covariance))
            case "ESTIMATOR_STATUS":
                spread = {"eph": message.pos_horiz_accuracy, "epv": message.pos_vert_accuracy}
                flags = message.flags
                self._status = _Kept(
                    now + _FLAGS_FRESH,
                    {
                        "xy_valid": bool(flags & (8 | 16)) and not flags & 128,
                        "z_valid": bool(flags & 32),
                        "v_xy_valid": bool(flags & 2),
                        "v_z_valid": bool(flags & 4),
                        **{name: value for name, value in spread.items() if math.isfinite(value)},
                    },
                )
        return None

    def _estimate(self, message: Any, now: float) -> dict[str, object]:
        self._follow_time(message.time_boot_ms, now)
        self._placed = now
        place = {name: getattr(message, name) for name in ("x", "y", "z", "vx", "vy", "vz")}
        fields: dict[str, object] = {
            "timestamp": (self._wraps * _WRAP + message.time_boot_ms) * 1000,
            **place,
            **self._yaw.at(now),
            **self._heading.at(now),
            **self._status.at(now),
            **self._bottom.at(now),
            **self._speed.at(now),
            **self._origin,
        }
        # The flags are of another message, and of another moment.
        for flag, names in (("xy_valid", "xy"), ("z_valid", "z"), ("v_xy_valid", ("vx", "vy")), ("v_z_valid", ("vz",))):
            if fields.get(flag) and not all(math.isfinite(place[name]) for name in names):
                fields[flag] = False
        return fields

    def _follow_time(self, ms: int, now: float) -> None:
        if self._last_ms is not None:
            step = (ms - self._last_ms + _WRAP // 2) % _WRAP - _WRAP // 2
            if -_REORDERED <= step < 0:
                raise OutOfOrderError(f"time_boot_ms {ms} after {self._last_ms}")
            if step < 0:
                self.restarted = True
                self.lost = 0  # the sequence started again too: it does not tell
                self._wraps = 0
                self._forget(now)
            elif ms < self._last_ms:
                self._wraps += 1
        self._last_ms = ms


def _spread_of_velocity(covariance: Any) -> dict[str, object]:
    """Return evh and evv of the variances in the diagonal, as far as they are known."""
    north, east, down = covariance[0], covariance[6], covariance[11]
    spread: dict[str, object] = {}
    if math.isfinite(north + east) and min(north, east) >= 0:
        spread["evh"] = math.sqrt(north + east)
    if math.isfinite(down) and down >= 0:
        spread["evv"] = math.sqrt(down)
    return spread
