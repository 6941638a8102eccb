"""Plain Zenoh queryables, correct or malicious."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import zenoh

from nedbus.transport import Session, token_keys
from tests.waits import DEADLINE


@contextmanager
def answer_queries(
    session: Session, key_expr: str, reply: Callable[[zenoh.Query], object]
) -> Iterator[None]:
    """Declare a queryable for `key_expr` that the router has registered before the block begins."""
    queryable = session.declare_queryable(key_expr, zenoh.handlers.Callback(reply, indirect=False))
    token_keys(
        session, "nedbus/*/@alive/*/**", timeout=DEADLINE
    )  # the router answers after it has registered the queryable
    yield
    queryable.undeclare()


def reply_with(payloads: Mapping[str, bytes], **options: Any) -> Callable[[zenoh.Query], None]:
    """Return a callback that answers each query with all of these payloads, by key."""

    def reply(query: zenoh.Query) -> None:
        with query:
            for key, payload in payloads.items():
                query.reply(key, payload, **options)

    return reply
