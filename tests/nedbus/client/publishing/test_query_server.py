"""Replies to queries by QueryServer."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import zenoh

import nedbus
from nedbus.client import QueryServer
from nedbus.transport import Session, query
from tests.waits import DEADLINE, wait_for


class Panic(BaseException):
    """A panic in Zenoh, which is not an Exception."""


@pytest.fixture
def server(zenoh_session: Session) -> Iterator[QueryServer]:
    """Return the query server of another session."""
    server = QueryServer(zenoh_session)
    yield server
    server.close()


def test_panic_in_a_reply_does_not_end_the_server(
    server: QueryServer, bus: nedbus.Bus, caplog: pytest.LogCaptureFixture
) -> None:
    """If a reply fails, even with a panic in Zenoh, this query has no reply, and the next one has."""
    faults = [Panic()]

    def reply(request: zenoh.Query) -> None:
        if faults:
            raise faults.pop()
        request.reply("a/key", b"found")

    server.answer("a/key", reply)

    def has_failed() -> bool:
        assert query(bus._session, "a/key", timeout=DEADLINE) == []
        return not faults

    # Until the queryable is known to the other session, queries do not reach it.
    wait_for(has_failed, what="a reply that fails")
    assert [each.payload.to_bytes() for each in query(bus._session, "a/key", timeout=DEADLINE)] == [
        b"found"
    ]
    assert [record.getMessage() for record in caplog.records] == [
        "a/key: unexpected error in a query reply (logged once)"
    ]
