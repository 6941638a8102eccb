"""How near the routers of a network are to their limits, asked now and then and not when somebody scrapes."""

from __future__ import annotations

import threading
from contextlib import suppress
from typing import Final

from nedbus.client import Bus
from nedbus.errors import NedbusError
from nedbus.transport import RouterState, Session, ask_routers

MAX_ROUTERS: Final = 16
"""Routers whose state is kept: any peer may claim to be one."""

_PAUSE: Final = 10.0  # s between two questions; longer where the answers are large:
_LONGEST: Final = 60.0
_SESSIONS: Final = 20  # that may be told of in a second, 3.7 kB: a router's answer has 183 bytes for each of its own
_TIMEOUT: Final = 5.0  # s for all answers, over a slow link perhaps
_OPEN: Final = 1.0  # s


class RouterWatch:
    """Ask all routers for their state until told to stop; `states` is what they said last.

    It has a session of its own: an answer of a router with 1,000 sessions, 183 kB, does not hold up messages.
    """

    def __init__(self, bus: Bus) -> None:
        self._bus = bus
        self._lock = threading.Lock()  # of the session, which `close` may find while it opens
        self._session: Session | None = None
        self._closed = False
        self.states: tuple[RouterState, ...] = ()

    def run(self, stop: threading.Event) -> None:
        """Ask every 10 s, less often where there are more than 200 sessions, until `stop` is set."""
        while not stop.is_set():
            states: list[RouterState] = []
            with suppress(NedbusError):  # no room for this session, a broken link: then nothing is known
                session = self._open()
                if session is not None:
                    states = ask_routers(session, timeout=_TIMEOUT)
            self.states = tuple(states[:MAX_ROUTERS])
            told = sum(state.sessions for state in states)
            stop.wait(min(_LONGEST, max(_PAUSE, told / _SESSIONS)))

    def close(self) -> None:
        """End its session, and with it a question that is not answered yet."""
        with self._lock:
            self._closed = True
            session = self._session
        if session is not None:
            session.close()

    def _open(self) -> Session | None:
        """Return the session, opened when it is first needed; None after `close`."""
        if self._session is not None or self._closed:
            return self._session
        session = self._bus.open_session(timeout=_OPEN)
        with self._lock:
            if not self._closed:
                self._session = session
                return session
        session.close()
        return None
