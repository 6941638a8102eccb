"""Write permission at the router: access rules drop messages without telling the sender.

Only services with a certificate are checked, as access rules go by it: with a second session for a moment, soon after a
link is up or a vehicle appears, and then rarely. Rules change when a router restarts.
"""

from __future__ import annotations

import logging
import random
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from typing import Final

from nedbus.client import PublisherRegistry
from nedbus.errors import ConnectError, NedbusError
from nedbus.log_event import about
from nedbus.settings import Settings
from nedbus.transport import Session, Tls, Verdict, open_client, probe_writes, while_open

_log = logging.getLogger(__name__)

_FIRST: Final = (1.0, 5.0)  # s, drawn: the vehicles of a fleet come back together when their router does
_CONFIRM: Final = 1.0  # s until a denial is checked again
_BELIEVED: Final = 3  # denials in a row that are a refusal: a slow or restarting router is none
_UNSURE_PAUSE: Final = 60.0  # s until the next check while a vehicle is refused or unknown
_PAUSE: Final = 600.0  # s until the next check when all are allowed
_POLL: Final = 1.0  # s between two polls of the link
_OPEN: Final = 5.0  # s for a session
_ARRIVED: Final = 3.0  # s for a message that is allowed
_GRACE: Final = 5.0  # s to end
_MAX_NAMED: Final = 20  # vehicles in a line of the log


def watch_permission(session: Session, settings: Settings, registry: PublisherRegistry) -> WritePermission | None:
    """Start the checks, if the service has a certificate that access rules may go by."""
    endpoints = [endpoint for endpoint in settings.connect if endpoint.startswith(("tls/", "quic/"))]
    if settings.tls is None or settings.tls.certificate is None or not endpoints:
        return None

    def vehicles() -> set[str]:
        return {publisher.address.vehicle for publisher in registry.publishers}

    permission = WritePermission(session, endpoints, tls=settings.tls, prefix=settings.prefix, vehicles=vehicles)
    permission.start()
    return permission


class WritePermission:
    """Check in a thread of its own whether the router refuses any of the vehicles that `vehicles` returns.

    `session` publishes them, as a client of one of the endpoints or as a router that joins them.
    """

    def __init__(
        self, session: Session, endpoints: Sequence[str], *, tls: Tls, prefix: str, vehicles: Callable[[], set[str]]
    ) -> None:
        self._session = session
        self._endpoints = endpoints
        self._tls = tls
        self._prefix = prefix
        self._vehicles = vehicles
        self._stop = threading.Event()
        self._denials: dict[str, int] = {}  # in a row, of each vehicle of which anything is known
        self._thread = threading.Thread(target=self._run, name="nedbus-permission", daemon=True)

    @property
    def refused(self) -> dict[str, bool]:
        """The router's verdict on each vehicle, where it is known: true if access rules refuse it."""
        known = self._denials.copy().items()
        return {vehicle: number > 0 for vehicle, number in known if not 0 < number < _BELIEVED}

    def start(self) -> None:
        """Check when the link changes, when a vehicle is new, and rarely in between."""
        self._thread.start()

    def close(self) -> None:
        """End; best after the session, which ends a check that is under way."""
        self._stop.set()
        self._thread.join(_GRACE)

    def _run(self) -> None:
        due, known = 0.0, (set[str](), set[str]())
        while not self._stop.wait(_POLL):
            now = time.monotonic()
            routers, vehicles = _routers_of(self._session), self._vehicles()
            if routers != known[0]:
                self._denials = {vehicle: _BELIEVED * refused for vehicle, refused in self.refused.items()}
                due = now + random.uniform(*_FIRST)  # noqa: S311 - spreads load, no secret
            elif vehicles - known[1]:
                due = min(due, now + _FIRST[0])
            known = routers, vehicles
            if routers and vehicles and now >= due:
                due = now + self.check()

    def check(self) -> float:
        """Check once, and return the seconds until the next check."""
        vehicles = self._vehicles()
        try:
            verdicts = self._probe(vehicles)
        except NedbusError as exc:  # the link or the session has gone, or a file is being replaced
            _log.debug("the write permission is unknown: %s", exc)
            verdicts = {}
        before = self.refused
        self._denials = {vehicle: number for vehicle, number in self._denials.items() if vehicle in vehicles}
        for vehicle, verdict in verdicts.items():
            number = self._denials.get(vehicle, 0)
            if verdict == "allowed":
                self._denials[vehicle] = 0
            elif verdict == "denied":
                self._denials[vehicle] = number + 1
            elif not number:  # else the router was slow: rules do not change under a link
                self._denials.pop(vehicle, None)
        self._log_changes(before)
        if any(verdict == "denied" and self._denials[vehicle] < _BELIEVED for vehicle, verdict in verdicts.items()):
            return _CONFIRM
        is_well = bool(verdicts) and set(verdicts.values()) == {"allowed"}
        return _PAUSE if is_well else _UNSURE_PAUSE

    def _probe(self, vehicles: set[str]) -> Mapping[str, Verdict]:
        """Return the verdict on each vehicle; none without a router to which both sessions have a link."""
        routers = _routers_of(self._session)
        for endpoint in self._endpoints if vehicles else ():
            try:
                reader = open_client([endpoint], timeout=_OPEN, tls=self._tls, stop=self._stop)
            except ConnectError:
                continue
            with reader:
                if not (there := _routers_of(reader)) or not there <= routers:
                    continue
                verdicts = probe_writes(reader, self._session, vehicles, prefix=self._prefix, timeout=_ARRIVED)
                # A probe that did not arrive counts only if no link was broken meanwhile.
                return verdicts if _routers_of(reader) == there and _routers_of(self._session) == routers else {}
        return {}

    def _log_changes(self, before: Mapping[str, bool]) -> None:
        now = self.refused
        if new := [vehicle for vehicle, refused in now.items() if refused and not before.get(vehicle)]:
            _log.warning(
                "the router refuses %s: its messages reach no reader; do its access rules name it, with the"
                " certificate %s? ('nedbus pki rules', docs/security.md); still trying",
                _name(new),
                self._tls.certificate,
                extra=about("refused"),
            )
        if mended := [vehicle for vehicle, refused in before.items() if refused and now.get(vehicle) is False]:
            _log.info("the router takes %s now: all is well again", _name(mended), extra=about("accepted"))


def _routers_of(session: Session) -> set[str]:
    """Return the routers to which a session has a link."""
    try:
        with while_open():
            return {str(zid) for zid in session.info.routers_zid()}
    except NedbusError:
        return set()


def _name(vehicles: Sequence[str]) -> str:
    more = f" and {len(vehicles) - _MAX_NAMED} more" if len(vehicles) > _MAX_NAMED else ""
    return f"vehicle {', '.join(sorted(vehicles)[:_MAX_NAMED])}{more}"
