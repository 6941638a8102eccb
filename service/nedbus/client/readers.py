"""The readers that acknowledge, as a publisher knows them: who is there, and who may come back. Pure, without I/O."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

RETURN: Final = 5.0
"""Seconds that a reader has to come back that has gone without being closed, once there is a router."""

THAW: Final = 90.0
"""Seconds that a reader has to come back that stood still before, until Zenoh's lease ended: it may be stopped."""

_UNKNOWN: Final = ""  # one that has never answered


class Readers:
    """Note who answers, and who has gone but may come back. Not thread-safe.

    One that was closed says so; any other may come back: its link broke, or its router restarts.
    """

    def __init__(self) -> None:
        self._there: set[str] = set()
        self._away: dict[str, float] = {}  # and until when
        self._silent: set[str] = set()  # who has not answered for long

    @property
    def away(self) -> bool:
        """Whether anybody may come back."""
        return bool(self._away)

    def note(self, answers: Mapping[str, bool], *, late: bool, stood_still: bool, now: float) -> None:
        """Note the answers to one question, by reader: whether it is closed.

        `late`: somebody has not answered in time, and is still there. `stood_still`: the question was open for long
        after the last answer. `now` in seconds.
        """
        closed = {reader for reader, is_closed in answers.items() if is_closed}
        if answers.keys() - self._there - self._away.keys():  # somebody answers for the first time
            self._there.discard(_UNKNOWN)
            self._away.pop(_UNKNOWN, None)
        for reader in answers:
            self._away.pop(reader, None)
        self._there |= answers.keys()
        if stood_still or late:
            silent = self._there - answers.keys()
            self._there |= silent or {_UNKNOWN}
            self._silent |= silent or {_UNKNOWN}
        self._there -= closed
        if late:
            return
        gone = self._there - answers.keys()
        self._there -= gone
        self._away = {reader: until for reader, until in self._away.items() if until > now}
        self._away |= dict.fromkeys(gone & self._silent, now + THAW)
        self._away |= dict.fromkeys(gone - self._silent, now + RETURN)
        self._silent.clear()

    def wait_for_link(self, now: float) -> None:
        """Let nobody's time run while the publisher has no router, or has just joined one, `now` in seconds."""
        if not self._there and not self._away:
            self._away[_UNKNOWN] = now
        self._away = {reader: max(until, now + RETURN) for reader, until in self._away.items()}
