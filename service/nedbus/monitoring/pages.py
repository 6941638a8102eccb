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
from nedbus_msgs.text import plural

from .http_server import Page

_MAX_BUSY: Final = 20.0  # s that a source may spend on one message


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
    vehicles = ((name, report.vehicles[name]) for name in by_vehicle([report]))
    lines = [
        f"{name} {vehicle.text}{format_since(vehicle.since, report.now)}"
        for name, vehicle in vehicles
    ]
    good = "\n".join(map(_one_line, lines)) or "no vehicles"
    return Page.verdict(list(map(_one_line, faults)), good)


def why_not_ready(daemon: Daemon) -> list[str]:
    """Return why a service is not ready: no router, a refused vehicle, a silent source, or an overload; [] if ready."""
    if not daemon.ready.is_set():
        what = "waiting for a router at" if daemon.role == "client" else "starting a router on"
        return [f"the service is {what} {' or '.join(daemon.endpoints)}"]
    reasons = []
    if daemon.role == "client" and not daemon.sessions:
        reasons.append(f"no router answers at {' or '.join(daemon.endpoints)}")
    reasons += _refusals(daemon)
    for source in daemon.sources:
        # a replay that waits for a reader has addresses
        silent = source.state == "waiting" and not source.addresses
        if silent or source.state in {"starting", "retrying", "failed"}:
            what = "nothing arrives" if silent else source.state
            reasons.append(f"{source.source}: {what}{f': {source.error}' if source.error else ''}")
        if source.overload:
            reasons.append(f"{source.source}: {source.overload}")
    return reasons


def _one_line(text: str) -> str:
    return "".join(each if each.isprintable() else " " for each in text)  # a fault may quote a peer


def _health(daemon: Daemon) -> Page:
    reasons, busy = _refusals(daemon), daemon.busy
    if busy >= _MAX_BUSY:
        reasons.append(f"a source has been blocked by one message for {busy:.0f} s")
    return Page.verdict(reasons, "ok")


def _refusals(daemon: Daemon) -> list[str]:
    refused = sorted(vehicle for vehicle, is_refused in daemon.refused.items() if is_refused)
    if not refused:
        return []
    return [f"the router refuses messages of vehicle{plural(len(refused))} {', '.join(refused)}"]


def _metrics(daemon: Daemon) -> Page:
    try:
        metrics = import_optional("metrics", "nedbus.monitoring.metrics")
    except ConfigError as exc:
        return Page.text(str(exc), status=501)
    page: Page = metrics.metrics_page(metrics.service_metrics(daemon))
    return page
