"""STATUSTEXT: chunks, missing chunks, and copies from another link."""

from __future__ import annotations

from typing import Any

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus import limits
from nedbus.mavlink.status_texts import StatusTexts, TextCopies


def chunk(text: bytes, *, number: int = 0, text_id: int = 0, severity: int = 4) -> Any:
    """Return a STATUSTEXT as its receiver decodes it."""
    message = dialect.MAVLink_statustext_message(severity, text, text_id, number)
    message._text_raw = text.ljust(50, b"\0")
    return message


def joined(*messages: Any, now: float = 0.0) -> list[object]:
    """Return the texts that chunks make, all received at once, and read at the time `now`."""
    texts = StatusTexts()
    for message in messages:
        texts.add(message, 0.0)
    found = []
    while fields := texts.pop(now):
        found.append(fields["text"])
    return found


FULL = b"x" * 50


@pytest.mark.parametrize(
    ("messages", "texts"),
    [
        ([chunk(b"short")], ["short"]),
        ([chunk(FULL)], ["x" * 50]),  # without an id it is complete
        ([chunk(FULL, text_id=1)], []),  # its next chunk may come
        ([chunk(FULL, text_id=1), chunk(b"end", text_id=1, number=1)], ["x" * 50 + "end"]),
        ([chunk(b"end", text_id=1, number=1)], ["...end"]),
        ([chunk(FULL, text_id=1), chunk(b"end", text_id=1, number=2)], ["x" * 50 + "...end"]),
        ([chunk(FULL, text_id=1), chunk(b"next", text_id=2)], ["x" * 50 + "...", "next"]),
        ([chunk(FULL, text_id=1), chunk(b"next", text_id=1)], ["x" * 50 + "...", "next"]),
        ([chunk(FULL, text_id=1), chunk(b"a", text_id=1, severity=2)], ["x" * 50 + "...", "a"]),
        ([chunk(b"49" * 24 + b"x\0", text_id=1)], ["49" * 24 + "x"]),
    ],
)
def test_chunks_of_a_text_are_joined(messages: list[Any], texts: list[str]) -> None:
    """Chunks with one id and severity are one text, until a short one; "..." stands for a missing one."""
    assert joined(*messages) == texts


def test_text_without_its_end_is_published_after_two_seconds() -> None:
    """A text whose last chunk was lost ends with "..." after 2 s."""
    assert joined(chunk(FULL, text_id=1), now=2.0) == []
    assert joined(chunk(FULL, text_id=1), now=2.1) == ["x" * 50 + "..."]


def test_texts_that_wait_are_limited(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the limit, the oldest texts that wait are dropped."""
    monkeypatch.setattr(limits, "MAVLINK_TEXTS", 2)
    assert joined(*(chunk(text) for text in (b"a", b"b", b"c"))) == ["b", "c"]


def test_copies_are_those_of_another_link_within_ten_seconds() -> None:
    """A text is a copy if another link has delivered it more often in the last 10 s."""
    copies = TextCopies()
    arming = chunk(b"Arming denied")
    assert not copies.add(arming, 0, 100.0)
    assert not copies.add(arming, 0, 101.0), "the vehicle sent it twice"
    assert copies.add(arming, 1, 101.5)
    assert copies.add(arming, 1, 102.0)
    assert not copies.add(arming, 1, 103.0), "the third time"
    assert not copies.add(chunk(b"Arming denied", severity=2), 0, 103.0)
    assert not copies.add(arming, 2, 113.5), "the others came more than 10 s before"
