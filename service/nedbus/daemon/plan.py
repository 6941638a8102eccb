"""Plan of a service: its opened sources, or the mistakes in their settings."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from nedbus.errors import ConfigError
from nedbus.settings import Settings, locate_setting, locate_source
from nedbus.sources import ReplaySource, Source, parse_source
from nedbus.transport import dial_endpoint

_TLS: Final = ("tls_key", "tls_certificate", "tls_ca")


@dataclass(frozen=True, slots=True)
class Planned:
    """A configured source, number `index` in the settings; a reload leaves it running if text and vehicle are equal."""

    index: int = field(compare=False)
    text: str
    vehicle: str
    source: Source = field(compare=False)


def plan_sources(settings: Settings, endpoints: Sequence[str]) -> tuple[list[Planned], list[ConfigError]]:
    """Open the sources for a service with these endpoints; also return the mistakes, at most one per source."""
    plan: list[Planned] = []
    mistakes: list[ConfigError] = []
    if not settings.source and "source" not in settings.left_out:
        reason = "no source is given: use --source with sim:, ulog:FILE, px4-zenoh: or mavlink:LINK"
        mistakes.append(ConfigError("source", reason))
    tls = None
    try:
        tls = settings.tls
    except ConfigError as exc:
        if not settings.left_out.intersection(_TLS):
            mistakes.append(
                locate_setting(settings, next(name for name in _TLS if getattr(settings, name)), exc.reason)
            )
    routers = tuple(map(dial_endpoint, endpoints))
    for index, given in enumerate(settings.source):
        try:
            spec = parse_source(given)
            source = spec.open_source(vehicle=settings.vehicle, routers=routers, tls=tls)
        except ConfigError as exc:
            mistakes.append(locate_source(settings, index, exc))
        else:
            plan.append(Planned(index, spec.text, settings.vehicle, source))
    if settings.until_done and plan and not mistakes and not any(is_finite(planned.source) for planned in plan):
        reason = "no source ever ends: give sim: a duration, or remove loop=1 from ulog:"
        mistakes.append(ConfigError("until_done", reason))
    return plan, mistakes


def is_finite(source: Source) -> bool:
    """Return True if a source ends by itself."""
    return isinstance(source, ReplaySource) and source.finite
