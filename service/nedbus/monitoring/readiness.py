"""Why a service is not ready: for /readyz, and for the status that systemd shows."""

from collections.abc import Iterator

from nedbus.daemon import Daemon
from nedbus.health import SourceStatus
from nedbus_msgs.text import plural


def why_not_ready(daemon: Daemon) -> list[str]:
    """Return why a service is not ready: no router, a refused vehicle, a silent source, or an overload; [] if ready."""
    if not daemon.ready.is_set():
        what = "waiting for a router at" if daemon.role == "client" else "starting a router on"
        return [f"the service is {what} {' or '.join(daemon.endpoints)}"]
    reasons = list[str]()
    if daemon.role == "client" and not daemon.sessions:
        reasons.append(f"no router answers at {' or '.join(daemon.endpoints)}")
    reasons += refusals_of(daemon)
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


def refusals_of(daemon: Daemon) -> list[str]:
    """Return that the router refuses messages of vehicles; [] if it refuses none."""
    refused = sorted(vehicle for vehicle, is_refused in daemon.refused.items() if is_refused)
    if not refused:
        return []
    return [f"the router refuses messages of vehicle{plural(len(refused))} {', '.join(refused)}"]
