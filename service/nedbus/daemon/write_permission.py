"""Write permission at the router, whose access rules drop messages without an error at the sender.

Only services with a certificate are checked, because access rules refer to certificates. Each check briefly opens a
second session, soon after a link or vehicle appears and then rarely, because rules change only when a router restarts.
"""

from __future__ import annotations

import logging
import random
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from nedbus import limits
from nedbus.client import PublisherRegistry
from nedbus.errors import NedbusError
from nedbus.log_event import UnexpectedErrors, about
from nedbus.settings import Settings
from nedbus.timings import TIMINGS
from nedbus.transport import (
    CONFIRMED,
    Session,
    Tls,
    WriteVerdict,
    probe_at_router,
    routers_of,
    secure_endpoints,
)
from nedbus_msgs.text import plural

_log = logging.getLogger(__name__)

_GRACE: Final = 5.0  # s for the thread to end


def watch_permission(
    session: Session, settings: Settings, registry: PublisherRegistry
) -> WritePermission | None:
    """Start the checks if the service uses a client certificate, else return None."""
    endpoints = secure_endpoints(settings.connect, settings.tls)
    if settings.tls is None or not endpoints:
        return None

    def vehicles() -> set[str]:
        return {address.vehicle for address in tuple(registry.publishers)}

    permission = WritePermission(
        session, endpoints, tls=settings.tls, prefix=settings.prefix, vehicles=vehicles
    )
    permission.start()
    return permission


class WritePermission:
    """Check repeatedly, in a separate thread, whether the router accepts all vehicles returned by `vehicles`.

    `session`: publishes the vehicles, as a client of one of the endpoints or as a router connected to them.
    """

    def __init__(
        self,
        session: Session,
        endpoints: Sequence[str],
        *,
        tls: Tls,
        prefix: str,
        vehicles: Callable[[], set[str]],
    ) -> None:
        self._session = session
        self._endpoints = endpoints
        self._tls = tls
        self._prefix = prefix
        self._vehicles = vehicles
        self._stop = threading.Event()
        self._checking = threading.Lock()
        # consecutive denials by vehicle; 0 if allowed, no entry if unknown
        self._denials: dict[str, int] = {}
        self._thread = threading.Thread(target=self._run, name="nedbus-permission", daemon=True)
        self.start = self._thread.start

    @property
    def refused(self) -> dict[str, bool]:
        """Whether access rules deny each vehicle; vehicles whose permission is unknown are omitted."""
        known = self._denials.copy().items()
        return {vehicle: number > 0 for vehicle, number in known if not 0 < number < CONFIRMED}

    def decide(self) -> list[str]:
        """Check until each vehicle is known to be accepted or refused, or cannot be told; return the refused ones."""
        for _ in range(CONFIRMED):
            if self.check() != TIMINGS.probe_confirm:
                break
        return sorted(vehicle for vehicle, refused in self.refused.items() if refused)

    def close(self) -> None:
        """Stop the thread; close the session first to abort a running check."""
        self._stop.set()
        self._thread.join(_GRACE)

    def _run(self) -> None:
        due = 0.0
        routers = frozenset[str]()
        vehicles = set[str]()
        errors = UnexpectedErrors(
            _log, "unexpected error while probing the write permission (logged once)"
        )
        while not self._stop.wait(TIMINGS.probe_poll):
            now = time.monotonic()
            last_routers = routers
            last_vehicles = vehicles
            with errors:
                routers, vehicles = routers_of(self._session), self._vehicles()
                if routers != last_routers:
                    self._denials = {
                        vehicle: CONFIRMED * refused for vehicle, refused in self.refused.items()
                    }
                    due = now + random.uniform(*TIMINGS.probe_first)  # noqa: S311 - spreads the load, not a secret
                elif vehicles - last_vehicles:
                    due = min(due, now + TIMINGS.probe_first[0])
                if routers and vehicles and now >= due:
                    due = now + TIMINGS.probe_pause
                    due = now + self.check()

    def check(self) -> float:
        """Check once, and return the time until the next check [s]."""
        with self._checking:
            return self._check()

    def _check(self) -> float:
        vehicles = self._vehicles()
        verdicts: Mapping[str, WriteVerdict] = {}
        try:
            verdicts = self._probe(vehicles)
        except NedbusError as exc:  # link or session closed, or a TLS file being replaced
            _log.debug("write permission unknown: %s", exc)
        before = self.refused
        self._denials = {
            vehicle: number for vehicle, number in self._denials.items() if vehicle in vehicles
        }
        for vehicle, verdict in verdicts.items():
            number = self._denials.get(vehicle, 0)
            if verdict == "allowed":
                self._denials[vehicle] = 0
            elif verdict == "denied":
                self._denials[vehicle] = number + 1
            elif not number:
                # else keep the count: the router was slow, and rules do not change while a link is up
                self._denials.pop(vehicle, None)
        now = self.refused
        if new := [
            vehicle for vehicle, refused in now.items() if refused and not before.get(vehicle)
        ]:
            text = (
                "the router refuses messages of %s, so they reach no reader: check that its access rules allow them for"
                " the certificate %s ('nedbus pki rules', docs/security.md); nedbus probes again every minute"
            )
            _log.warning(
                text, _list_vehicles(new), self._tls.certificate, extra=about("access_denied")
            )
        if accepted := [
            vehicle for vehicle, refused in before.items() if refused and now.get(vehicle) is False
        ]:
            _log.info(
                "the router now accepts messages of %s",
                _list_vehicles(accepted),
                extra=about("access_granted"),
            )
        if any(
            verdict == "denied" and self._denials[vehicle] < CONFIRMED
            for vehicle, verdict in verdicts.items()
        ):
            return TIMINGS.probe_confirm
        return (
            TIMINGS.probe_pause if set(verdicts.values()) == {"allowed"} else TIMINGS.probe_unsure
        )

    def _probe(self, vehicles: set[str]) -> Mapping[str, WriteVerdict]:
        """Return the verdict for each vehicle, or no verdicts if the two sessions share no router."""
        return probe_at_router(
            self._session,
            self._endpoints,
            vehicles,
            tls=self._tls,
            prefix=self._prefix,
            stop=self._stop,
        )


def _list_vehicles(vehicles: Sequence[str]) -> str:
    more = (
        f" and {len(vehicles) - limits.SHOWN_NAMES} more"
        if len(vehicles) > limits.SHOWN_NAMES
        else ""
    )
    return (
        f"vehicle{plural(len(vehicles))} {', '.join(sorted(vehicles)[: limits.SHOWN_NAMES])}{more}"
    )
