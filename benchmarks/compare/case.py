"""Parameters of one benchmark run of one compared library or API."""

from dataclasses import dataclass

TOPIC = "vehicle_local_position"


@dataclass(frozen=True)
class Case:
    """One publisher process and one reader process.

    `endpoint`: the router.
    `vehicles`: published vehicle ids; forms of other projects support only one.
    `paced`: send at a fixed rate like a live vehicle; otherwise at full speed without loss.
    """

    endpoint: str
    vehicles: tuple[str, ...] = ("1",)
    paced: bool = False

    @property
    def lossless(self) -> bool:
        """True if publishers wait for slow readers; live ones never do."""
        return not self.paced

    @property
    def vehicle(self) -> str:
        """Vehicle to subscribe to: the only one, or "*" for several."""
        return self.vehicles[0] if len(self.vehicles) == 1 else "*"
