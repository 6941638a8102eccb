"""Parameters of one run of a form."""

from dataclasses import dataclass

TOPIC = "vehicle_local_position"


@dataclass(frozen=True)
class Case:
    """One publisher process and one reader process.

    `endpoint`: the router.
    `vehicles`: the ids that are published; forms of other projects know one only.
    `paced`: messages come at a rate, from a live vehicle; else as fast as they can be sent without losing any.
    """

    endpoint: str
    vehicles: tuple[str, ...] = ("1",)
    paced: bool = False

    @property
    def lossless(self) -> bool:
        """True if publishers wait for their readers: live ones never do."""
        return not self.paced

    @property
    def vehicle(self) -> str:
        """Vehicle that a reader subscribes to: the only one, or all of them."""
        return self.vehicles[0] if len(self.vehicles) == 1 else "*"
