"""HTTP pages of a service: /metrics, /healthz, /readyz, /vehicles and /status."""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Final

from nedbus.clock import format_since
from nedbus.daemon import Daemon
from nedbus.errors import ConfigError
from nedbus.extras import import_optional
from nedbus.health import AccountReport
from nedbus.vehicle_events import Expectation, by_vehicle, faults_of

from .http_server import Page
from .readiness import refusals_of, why_not_ready

_BLOCKED: Final = 20.0  # s on one message, after which a source is not healthy


def service_pages(daemon: Daemon) -> Mapping[str, Callable[[], Page]]:
    """Return the pages of a service by path."""
    return {
        "/metrics": lambda: _metrics(daemon),
        "/healthz": lambda: _health(daemon),
        "/readyz": lambda: Page.verdict(why_not_ready(daemon), "ready"),
        "/vehicles": lambda: vehicles_page(daemon.report()),
        "/status": lambda: Page.json(asdict(daemon.status)),
    }


def vehicles_page(report: AccountReport) -> Page:
    """Return the state of each vehicle, or status 503 with the faults."""
    faults = faults_of([report], Expectation(well=True))
    lines = list[str]()
    for name in by_vehicle([report]):
        vehicle = report.vehicles[name]
        since = format_since(vehicle.since, report.now)
        lines.append(_one_line(f"{name} {vehicle.text}{since}"))
    good = "\n".join(lines) or "no vehicles"
    return Page.verdict([_one_line(fault) for fault in faults], good)


def _one_line(text: str) -> str:
    """Return a text without control characters and line breaks: a fault may quote a peer."""
    return "".join(character if character.isprintable() else " " for character in text)


def _health(daemon: Daemon) -> Page:
    reasons = refusals_of(daemon)
    busy = daemon.busy
    if busy >= _BLOCKED:
        reasons.append(f"a source has been blocked by one message for {busy:.0f} s")
    return Page.verdict(reasons, "ok")


def _metrics(daemon: Daemon) -> Page:
    try:
        metrics = import_optional("metrics", "nedbus.monitoring.metrics")
    except ConfigError as exc:
        return Page.text(str(exc), status=501)
    page: Page = metrics.metrics_page(metrics.service_metrics(daemon))
    return page
