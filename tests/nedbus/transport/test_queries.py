"""Replies to queries: the end of a query, and which replies the limits drop."""

from types import SimpleNamespace
from typing import Any

import pytest

from nedbus.transport import Replies, queries


class Handler:
    """A channel that stays open, with these replies."""

    def __init__(self, *replies: object) -> None:
        self._replies = list(replies)

    def try_recv(self) -> Any:
        return self._replies.pop(0) if self._replies else None


def sample(key: str) -> Any:
    return SimpleNamespace(key_expr=key, payload=bytes(10))


def test_query_without_an_end_has_failed(monkeypatch: pytest.MonkeyPatch) -> None:
    """A query whose end Zenoh does not report within a second of the timeout has ended, and failed."""
    now = 100.0
    monkeypatch.setattr(queries, "time", SimpleNamespace(monotonic=lambda: now))
    handler: Any = Handler(SimpleNamespace(ok=sample("a")))
    replies = Replies(handler, timeout=5.0)
    assert len(replies.poll()) == 1
    now = 106.0
    assert replies.poll() == []
    assert not replies.ended
    now = 106.1
    assert replies.poll() == []
    assert replies.ended
    assert replies.failed


def test_poll_returns_a_limited_number_of_replies(monkeypatch: pytest.MonkeyPatch) -> None:
    """Replies beyond the limit stay in the channel for the next poll; one without a sample marks the query failed."""
    monkeypatch.setattr("nedbus.limits.REPLIES", 2)
    handler: Any = Handler(*[SimpleNamespace(ok=sample("a"))] * 2, SimpleNamespace(ok=None))
    replies = Replies(handler, timeout=5.0)
    assert len(replies.poll()) == 2
    assert not replies.failed
    assert len(replies.poll()) == 1
    assert replies.failed
    assert not replies.ended


def test_group_with_most_replies_loses_them(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the limit, the largest group loses replies, and the replies of the smallest group come first."""
    monkeypatch.setattr("nedbus.limits.REPLIES", 3)
    accepted = queries._Accepted()
    for group in ("large", "large", "large", "large", "small"):
        accepted.add(group, sample(group))
    kept = [str(reply.key_expr) for reply in accepted.samples()]
    assert kept == ["small", "large", "large"]
    assert (accepted.count, accepted.dropped) == (3, 2)
