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

    @property
    def text(self) -> str:
        """The state in one line."""
        parts = [f"{self.name} {self.state}"]
        if self.state == "rejected" and not math.isnan(self.ratio):
            parts.append(f"(test ratio {self.ratio:.2g})")
        if self.since is not None:
            parts.append(f"since {self.since:.1f} s")
        text = " ".join(parts)
        return f"{text}: {self.cause}" if self.cause else text


@dataclass(frozen=True, slots=True)
class Fusion:
    """Whether EKF2 uses the external position of a vehicle.

    `quantities`: position, height, velocity, yaw. `sent`: what a service sends into the vehicle, None if unknown.
    `echoed`: messages per second that PX4 received, from vehicle_visual_odometry. `eph`: of the estimate [m].
    `variance`: of the received horizontal position [m^2]. `bias`: of vision against GNSS, north and east [m].
    `remarks`: what is fused, but not as intended. `missing`: evidence that the data lacks, and how to get it.
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
        return None if states <= {"unknown"} else False

    @property
    def causes(self) -> tuple[str, ...]:
        """The causes of all quantities, each once."""
        return tuple(dict.fromkeys(quantity.cause for quantity in self.quantities if quantity.cause))

    @property
    def lines(self) -> Sequence[str]:
        """The report as text; parts of `sent` are untrusted."""
        lines = []
        if self.sent is not None:
            lines.append(f"sent: {self.sent.text}")
            if self.sent.age is not None and self.sent.clock == "arrival":
                lines.append(f"delay before the link: {1000 * self.sent.age:.0f} ms; set EKF2_EV_DELAY to it, plus the sensor's")
        if not math.isnan(self.echoed):
            lines.append(f"echoed by PX4: {self.echoed:.1f} Hz")
        lines += [quantity.text for quantity in self.quantities]
        if not math.isnan(self.eph):
            of_input = "" if math.isnan(self.variance) else f"; received with {math.sqrt(self.variance):.2g} m"
            lines.append(f"eph {self.eph:.2g} m{of_input}")
        if not math.isnan(self.bias[0]):
            lines.append(f"bias against GNSS: {self.bias[0]:.1f} m north, {self.bias[1]:.1f} m east")
        return [*lines, *self.remarks, *(f"not in the data: {each}" for each in self.missing)]
