"""Whether the router accepts what a script publishes: Zenoh drops forbidden messages without an error at the sender."""

import threading
from collections.abc import Sequence
from functools import partial

from nedbus import limits
from nedbus.errors import RefusedError
from nedbus.transport import (
    Session,
    Tls,
    WriteVerdict,
    is_refused,
    probe_at_router,
    routers_of,
    secure_endpoints,
)


class PublishPermission:
    """The write permissions of a session with a client certificate, probed once per vehicle and link to a router."""

    def __init__(
        self, session: Session, endpoints: Sequence[str], *, tls: Tls, prefix: str
    ) -> None:
        self._session = session
        self._endpoints = endpoints
        self._tls = tls
        self._prefix = prefix
        self._lock = threading.Lock()
        # for which the permissions below hold: rules change only with a restart
        self._routers = frozenset[str]()
        self._refused: dict[str, bool] = {}  # by vehicle

    @classmethod
    def of(
        cls, session: Session, endpoints: Sequence[str], *, tls: Tls | None, prefix: str
    ) -> "PublishPermission | None":
        """Return the permissions of a session; None if no access rules apply, without a client certificate."""
        secure = secure_endpoints(endpoints, tls)
        if tls is None or not secure:
            return None
        return cls(session, secure, tls=tls, prefix=prefix)

    def is_refused(self, vehicle: str) -> bool:
        """Return True if the router is known to refuse this vehicle; does not ask the router."""
        return self._refused.get(vehicle, False)

    def require(self, vehicle: str) -> None:
        """Raise RefusedError if the router refuses this vehicle; asks the router once per vehicle and link.

        Does nothing if it cannot be told, for example while there is no link.
        """
        with self._lock:
            routers = routers_of(self._session)
            if routers != self._routers or len(self._refused) > limits.KNOWN_VEHICLES:
                self._routers, self._refused = routers, {}
            if vehicle not in self._refused:
                refused = is_refused(partial(self._probe, vehicle))
                if refused is not None:
                    self._refused[vehicle] = refused
        if self.is_refused(vehicle):
            raise RefusedError(vehicle, self._tls.certificate)

    def _probe(self, vehicle: str) -> WriteVerdict | None:
        verdicts = probe_at_router(
            self._session, self._endpoints, [vehicle], tls=self._tls, prefix=self._prefix
        )
        return verdicts.get(vehicle)
