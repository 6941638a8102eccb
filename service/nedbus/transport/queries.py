"""Queries: what is answered on a key expression, and which liveliness tokens there are."""

from __future__ import annotations

from itertools import islice
from typing import Final

import zenoh

from .session import RawSample, Session, while_open

_MAX_ANSWERS: Final = 10_000  # more are not sent by honest peers


def query(session: Session, key_expr: str, *, timeout: float, newest: bool = True) -> list[RawSample]:
    """Return what is answered within `timeout` seconds, at most 10,000: the newest answer for each key, or all."""
    mode = zenoh.ConsolidationMode.LATEST if newest else zenoh.ConsolidationMode.NONE
    with while_open(session):
        replies = session.get(
            key_expr, target=zenoh.QueryTarget.ALL, consolidation=mode, timeout=_zenoh_timeout(timeout)
        )
        return [reply.ok for reply in islice(replies, _MAX_ANSWERS) if reply.ok is not None]


def alive_keys(session: Session, key_expr: str, *, timeout: float) -> list[str]:
    """Return the keys of all liveliness tokens that match, each once, sorted."""
    with while_open(session):
        replies = session.liveliness().get(key_expr, timeout=_zenoh_timeout(timeout))
        return sorted({str(reply.ok.key_expr) for reply in islice(replies, _MAX_ANSWERS) if reply.ok is not None})


def ask_all(session: Session, key: str, *, timeout: float, priority: zenoh.Priority) -> bool:
    """Return whether all queryables on a key answered within `timeout` seconds; also true when there is none."""
    with while_open(session):
        replies = session.get(
            key,
            target=zenoh.QueryTarget.ALL,
            timeout=_zenoh_timeout(timeout),
            priority=priority,
            congestion_control=zenoh.CongestionControl.DROP,  # a query that waits for a full queue could cut a link
        )
        return all(reply.ok is not None for reply in replies)


def _zenoh_timeout(timeout: float) -> float:
    """Return a timeout that Zenoh accepts: neither 0 nor infinity."""
    return min(max(timeout, 0.001), 86_400.0)
