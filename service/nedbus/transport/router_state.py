"""State of the routers of a network from their admin spaces: number and limit of sessions."""

import json
import re
from dataclasses import dataclass
from itertools import islice
from typing import Final

from .queries import query
from .session import Session

_KEY: Final = re.compile(r"@/([0-9a-f]{1,32})/router")
_MAX_ANSWER_BYTES: Final = 2**20  # about 5,700 sessions
_MAX_SESSIONS: Final = 2**32  # greatest limit accepted from a router
_MAX_ROUTERS: Final = 1000  # returned routers; any peer may claim to be one


@dataclass(frozen=True, slots=True)
class RouterState:
    """A router: its Zenoh id, its open sessions, including those with other routers, and their limit.

    `max_sessions`: None unless it is in `metadata` of the router's configuration; Zenoh reports it nowhere else.
    """

    zid: str
    sessions: int
    max_sessions: int | None

    @property
    def load(self) -> float | None:
        """Open sessions divided by their limit, 1.0 when full; None if the limit is unknown."""
        return None if self.max_sessions is None else self.sessions / self.max_sessions


def ask_routers(session: Session, *, timeout: float) -> list[RouterState]:
    """Return the state of each router that answers within `timeout` seconds, sorted by id.

    A router is missing if its admin space is off or denied, or if its answer exceeds the message size of this session:
    2**18 bytes for a client, about 1,400 sessions.
    """
    answers = query(session, "@/*/router", timeout=timeout)
    small = (answer for answer in answers if len(answer.payload) <= _MAX_ANSWER_BYTES)
    states = filter(None, (read_state(str(answer.key_expr), answer.payload.to_bytes()) for answer in small))
    by_zid = {state.zid: state for state in states}
    return [by_zid[zid] for zid in sorted(islice(by_zid, _MAX_ROUTERS))]


def read_state(key: str, payload: bytes) -> RouterState | None:
    """Parse the state in an answer; return None if it is not a router's, as any peer may answer anything."""
    found = _KEY.fullmatch(key)
    try:
        answer = json.loads(payload)
    except (ValueError, RecursionError):
        return None
    sessions = answer.get("sessions") if isinstance(answer, dict) else None
    if found is None or not isinstance(sessions, list):
        return None
    metadata = answer.get("metadata")
    limit = metadata.get("max_sessions") if isinstance(metadata, dict) else None
    is_limit = type(limit) is int and 0 < limit <= _MAX_SESSIONS  # not a bool
    return RouterState(found[1], len(sessions), limit if is_limit else None)
