"""Receive from PX4's Zenoh module, and from any other publisher of px4_msgs over rmw_zenoh."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from typing import Final

from nedbus.errors import ConnectError, SourceError
from nedbus.sources.options import Px4ZenohOptions
from nedbus.sources.source import Absence, Rejection, SourceContext, SourceMessage
from nedbus.transport import Session, check_endpoints, open_client

from .definitions import read_definitions
from .node import Px4ZenohNode
from .streams import StreamRegistry

_CONNECT_TIMEOUT: Final = 0.5  # s; the service ends within 1 s, and tries again until then


class Px4ZenohSource:
    """Everything of px4_msgs at a router: that of the service, or another one."""

    def __init__(self, endpoint: str, options: Px4ZenohOptions, context: SourceContext) -> None:
        if endpoint:
            check_endpoints([endpoint], where="px4-zenoh")
        self._endpoints = (endpoint,) if endpoint else context.routers
        self._is_own = not endpoint or endpoint in context.routers
        self._tls = context.tls
        self._options = options
        self._given = read_definitions(options.msg)
        self._vehicle = options.vehicle or context.vehicle
        self._name = f"px4-zenoh:{' or '.join(self._endpoints)}"

    def listen(self, router: Session | None) -> Iterator[SourceMessage | Rejection | Absence | None]:
        """Receive; raise SourceError when no router answers."""
        with ExitStack() as closing:
            if router is not None and self._is_own:
                # A link between the router and a client of its own would drop messages beyond its queue.
                session = router
            else:
                session = self._open_session()
                closing.callback(session.close)
            streams = StreamRegistry(self._options, vehicle=self._vehicle, given=self._given)
            node = closing.enter_context(Px4ZenohNode(session, streams, domain=self._options.domain))
            yield from node.run()  # a session that lost its router connects again by itself

    def _open_session(self) -> Session:
        try:
            return open_client(self._endpoints, timeout=_CONNECT_TIMEOUT, tls=self._tls)
        except ConnectError as exc:
            reason = "no Zenoh router answers there: start one, or name another as px4-zenoh:tcp/HOST:7447"
            raise SourceError(self._name, reason) from exc
