"""The plan of a fleet: which session has which streams, and what is told to the processes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from nedbus_msgs import TOPICS, Address

SLOT: Final = 0.01  # s in which what is due is published together
PARTS: Final = 3  # processes of vehicles: the second is behind the link, the third is restarted


@dataclass(frozen=True)
class Plan:
    """What was asked for: `rate` in Hz of each stream, `seconds` from the first message to the last."""

    sessions: int
    vehicles: int
    topics: int
    rate: float
    seconds: float
    routers: int
    events: tuple[str, ...]
    zenohd: str | None
    router_config: str | None

    @property
    def addresses(self) -> list[str]:
        """All streams."""
        return [address for number in range(self.vehicles) for address in self._streams(number)]

    def parts(self, endpoints: Sequence[str], link: str | None) -> list[Part]:
        """Return the parts of the fleet; the second one knows no other router than the one behind the link."""
        parts = []
        for index in range(PARTS):
            sessions = []
            for number in range(index, self.sessions, PARTS):
                addresses = [
                    each for vehicle in range(number, self.vehicles, self.sessions) for each in self._streams(vehicle)
                ]
                first = number % len(endpoints)
                known = [*endpoints[first:], *endpoints[:first]] if link is None or index != 1 else [link]
                sessions.append({"endpoints": known, "addresses": addresses})
            parts.append(Part(sessions, self.rate))
        return [part for part in parts if part.sessions]

    def _streams(self, vehicle: int) -> list[str]:
        chosen = list(TOPICS.values())[: self.topics]
        return [str(Address(f"v{vehicle}", topic.name, 0 if topic.instances else None)) for topic in chosen]


@dataclass(frozen=True)
class SessionPlan:
    """One session: the routers that it knows, and its streams."""

    endpoints: list[str]
    addresses: list[str]


@dataclass
class Part:
    """The sessions of one process; they may be given as JSON has them."""

    given: list[Any]
    rate: float
    sessions: list[SessionPlan] = field(init=False)

    def __post_init__(self) -> None:
        self.sessions = [SessionPlan(**each) for each in self.given]

    def as_json(self) -> dict[str, Any]:
        """Return what makes the same again."""
        return {"given": self.given, "rate": self.rate}
