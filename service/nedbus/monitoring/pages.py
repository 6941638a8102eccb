"""HTTP pages of a service: /metrics, /healthz, /readyz, /vehicles and /status."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict
from typing import Final

from nedbus.clock import format_since
from nedbus.daemon import Daemon
from nedbus.errors import ConfigError
from nedbus.extras import import_optional
from nedbus.health import AccountReport, SourceStatus
from nedbus.vehicle_events import Expectation, by_vehicle, faults_of
from nedbus_msgs.text import plural

from .http_server import Page

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


def why_not_ready(daemon: Daemon) -> list[str]:
    """Return why a service is not ready: no router, a refused vehicle, a silent source, or an overload; [] if ready."""
    if not daemon.ready.is_set():
        what = "waiting for a router at" if daemon.role == "client" else "starting a router on"
        return [f"the service is {what} {' or '.join(daemon.endpoints)}"]
    reasons = list[str]()
    if daemon.role == "client" and not daemon.sessions:
        reasons.append(f"no router answers at {' or '.join(daemon.endpoints)}")
    reasons += _refusals(daemon)
    for source in daemon.sources:
        reasons += _faults_of(source)
    return reasons


def _faults_of(source: SourceStatus) -> Iterator[str]:
    """Yield that a source receives nothing, or is overloaded."""
    fault = ""
    if source.state in {"starting", "retrying", "failed"}:
        fault = source.state
    elif source.state == "waiting" and not source.addresses:  # a replay that waits has addresses
        fault = "nothing arrives"
    if fault and source.error:
        fault = f"{fault}: {source.error}"
    if fault:
        yield f"{source.source}: {fault}"
    if source.overload:
        yield f"{source.source}: {source.overload}"


def _one_line(text: str) -> str:
    """Return a text without control characters and line breaks: a fault may quote a peer."""
    return "".join(character if character.isprintable() else " " for character in text)


def _health(daemon: Daemon) -> Page:
    reasons = _refusals(daemon)
    busy = daemon.busy
    if busy >= _BLOCKED:
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
