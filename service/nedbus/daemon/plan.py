"""What a service is to run: the sources of its settings, opened, or all that is wrong with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from nedbus.errors import ConfigError
from nedbus.settings import Settings, locate_source
from nedbus.sources import LiveSource, Source, parse_source
from nedbus.transport import dial_endpoint


@dataclass(frozen=True, slots=True)
class Planned:
    """A source as it is configured, `index` among others: after a reload one with this text and vehicle goes on."""

    index: int
    text: str
    vehicle: str
    source: Source

    def is_same(self, other: Planned) -> bool:
        """Return whether two plans ask for the same."""
        return (self.text, self.vehicle) == (other.text, other.vehicle)


def plan_sources(settings: Settings, endpoints: Sequence[str]) -> tuple[list[Planned], list[ConfigError]]:
    """Return the sources of these settings, for a service with these endpoints, and all mistakes in them."""
    if not settings.source:
        reason = "nothing to publish: give --source sim:, ulog:FILE, px4-zenoh: or mavlink:LINK, or several"
        return [], [ConfigError("source", reason)]
    plan: list[Planned] = []
    mistakes: list[ConfigError] = []
    routers = tuple(map(dial_endpoint, endpoints))
    for index, given in enumerate(settings.source):
        try:
            spec = parse_source(given)
            source = spec.open_source(vehicle=settings.vehicle, routers=routers, tls=settings.tls)
        except ConfigError as exc:
            mistakes.append(locate_source(settings, index, exc))
        else:
            plan.append(Planned(index, spec.text, settings.vehicle, source))
    if settings.until_done and not mistakes and not any(is_finite(planned.source) for planned in plan):
        reason = "no source ever ends: give sim: a duration, or take loop=1 from ulog:"
        mistakes.append(ConfigError("until_done", reason))
    return plan, mistakes


def is_finite(source: Source) -> bool:
    """Return whether a source ends by itself."""
    return not isinstance(source, LiveSource) and source.finite
