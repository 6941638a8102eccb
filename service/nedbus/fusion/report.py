"""Fusion: the use of an external position at one time, as a report."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

from nedbus.samples import PositionStatus

State = Literal["fused", "rejected", "not used", "not received", "unknown"]


@dataclass(frozen=True, slots=True)
class QuantityFusion:
    """Whether EKF2 uses one quantity of an external position: position, height, velocity or yaw.

    `state`: "fused"; "rejected": measurements fail EKF2's test, all or a quarter of them; "not used": EKF2 receives
    them, and neither fuses nor rejects them; "not received": EKF2 does not receive them; "unknown": no evidence.
    `since`: the vehicle's time since boot at which the state began [s]; None if unknown.
    `ratio`: the largest test ratio of the last measurement, above 1 if rejected; NaN if EKF2 could not compute it.
    `cause`: what explains a state other than "fused", and the remedy; "" if unknown.
    """

    name: str
    state: State
    since: float | None = None
    ratio: float = math.nan
    cause: str = ""


@dataclass(frozen=True, slots=True)
class Fusion:
    """Whether EKF2 uses the external position of a vehicle.

    `quantities`: position, height, velocity, yaw. `sent`: what a service sends into the vehicle, None if unknown.
    `echoed`: messages per second that PX4 received, from vehicle_visual_odometry. `eph`: of the estimate [m].
    `variance`: of the received horizontal position [m^2]. `bias`: of vision against GNSS, north and east [m].
    `remarks`: what is wrong as a whole, such as what is fused without effect.
    `missing`: evidence that the data lacks, and how to get it.
    Numbers that are unknown are NaN.
    """

    vehicle: str
    quantities: tuple[QuantityFusion, ...]
    sent: PositionStatus | None = None
    echoed: float = math.nan
    eph: float = math.nan
    variance: float = math.nan
    bias: tuple[float, float] = (math.nan, math.nan)
    remarks: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()

    @property
    def used(self) -> bool | None:
        """True if any quantity is fused, None if that is unknown."""
        states = {quantity.state for quantity in self.quantities}
        if "fused" in states:
            return True
        if states <= {"unknown"}:
            return None
        return False

    @property
    def causes(self) -> tuple[str, ...]:
        """The causes of all quantities, each once."""
        causes = [quantity.cause for quantity in self.quantities if quantity.cause]
        return tuple(dict.fromkeys(causes))

    @property
    def lines(self) -> Sequence[str]:
        """The report as text: what is sent, how quantities are used, what else is known, and missing evidence."""
        lines = list[str]()
        if self.sent is not None:
            lines.append(f"sent: {self.sent.text}{self._delay_to_set}")
        lines += self._states
        lines.append(self._numbers)
        lines += self.remarks
        lines += [f"not in the data: {evidence}" for evidence in self.missing]
        return lines

    @property
    def _delay_to_set(self) -> str:
        if self.sent is None or self.sent.age is None or self.sent.clock != "arrival":
            return ""
        return f"; set EKF2_EV_DELAY to {1000 * self.sent.age:.0f} ms, plus the delay of the link"

    @property
    def _states(self) -> list[str]:
        """Quantities with the same state and cause, in one line each."""
        groups: dict[tuple[str, str], list[QuantityFusion]] = {}
        for quantity in self.quantities:
            groups.setdefault((quantity.state, quantity.cause), []).append(quantity)
        lines = list[str]()
        for (state, cause), quantities in groups.items():
            text = f"{', '.join(quantity.name for quantity in quantities)} {state}"
            starts = [quantity.since for quantity in quantities if quantity.since is not None]
            ratios = [quantity.ratio for quantity in quantities if not math.isnan(quantity.ratio)]
            if state == "rejected" and ratios:
                text += f" (test ratio {max(ratios):.2g})"
            if starts:
                text += f" since {min(starts):.1f} s"
            if cause:
                text += f": {cause}"
            lines.append(text)
        return lines

    @property
    def _numbers(self) -> str:
        parts = ["no message from PX4 shows what it received"]
        if not math.isnan(self.echoed):
            parts = [f"PX4 receives {self.echoed:.1f} Hz"]
        if not math.isnan(self.variance):
            parts.append(f"with a deviation of {math.sqrt(self.variance):.2g} m")
        if not math.isnan(self.eph):
            parts.append(f"eph {self.eph:.2g} m")
        if not math.isnan(self.bias[0]):
            parts.append(f"bias against GNSS {self.bias[0]:.1f} m north, {self.bias[1]:.1f} m east")
        return ", ".join(parts)
