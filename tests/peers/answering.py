"""Peers of plain Zenoh that answer questions, honest or not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from typing import Any

import zenoh

from nedbus.transport import Session, token_keys
from tests.waits import DEADLINE


@contextmanager
def answering(session: Session, key_expr: str, reply: Callable[[zenoh.Query], object]) -> Iterator[None]:
    """Let a peer answer what is asked for on these keys, which its router knows from the beginning."""
    queryable = session.declare_queryable(key_expr, zenoh.handlers.Callback(reply, indirect=False))
    token_keys(session, "nedbus/*/@alive/*/**", timeout=DEADLINE)  # who answers has noted what was declared before
    yield
    queryable.undeclare()


def reply_with(answers: Mapping[str, bytes], **options: Any) -> Callable[[zenoh.Query], None]:
    """Answer each question with all of these, by key."""

    def reply(query: zenoh.Query) -> None:
        with query:
            for key, payload in answers.items():
                query.reply(key, payload, **options)

    return reply
