"""The liveliness tokens of a fleet, where a vehicle with too many tokens does not hide the others.

A client takes time quadratic in the number of tokens of one vehicle, and its session receives nothing else meanwhile.
Therefore tokens are listed on a separate session. If that takes long, the session is closed, and a query on another
one, whose replies arrive one by one, finds the vehicle with too many. As no key expression excludes a name, the others
are then listed by the first characters in which their names differ from it.
"""

import logging
import math
import string
import time
from collections import Counter
from collections.abc import Callable, Set
from contextlib import suppress
from functools import partial
from typing import Final

from nedbus import limits
from nedbus.errors import NedbusError
from nedbus.log_event import about
from nedbus.timings import TIMINGS
from nedbus_msgs import ANY, Selection

from .liveliness import LivelinessTokens, query_tokens
from .queries import Replies
from .session import Session

_log = logging.getLogger(__name__)

_CHARACTERS: Final = string.ascii_letters + string.digits + "_-"
_LONGEST_NAME: Final = 64  # characters; peers may use longer ones
_QUERY_TIMEOUT: Final = 60.0  # s


class FleetTokens:
    """Like LivelinessTokens, for a selection, on a separate session; excludes vehicles with over 1,000 tokens.

    An excluded vehicle is logged, and listed again after ten minutes; until then the list is incomplete.
    `open_session`: raises NedbusError if no router answers.
    """

    def __init__(
        self, open_session: Callable[[], Session], selection: Selection, *, prefix: str
    ) -> None:
        self._open_session = open_session
        self._prefix = prefix
        self._selection = selection
        self._keys: set[str] = set()
        self._numbers: Counter[str] = Counter()  # of keys, by vehicle
        self._excluded: set[str] = set()
        self._retry = math.inf  # monotonic time at which excluded vehicles are listed again [s]
        self._session = open_session()
        self._subscribe()

    @property
    def complete(self) -> bool:
        """True if all tokens are known."""
        if self._excluded or self.is_listing:
            return False
        return self._tokens.is_listing or self._tokens.complete

    @property
    def is_listing(self) -> bool:
        """True until the router has listed all tokens, except those of excluded vehicles."""
        if self._survey:
            return True
        return self._tokens.is_listing and not self._is_surveyed

    def undeclare(self) -> None:
        """End the subscription, and close its session."""
        self._session.close()

    def poll(self) -> list[tuple[str, bool]]:
        """Return the changes since the last call, like LivelinessTokens."""
        changes = [change for change in self._receive() if self._apply(*change)]
        if changes:
            crowded = self._crowded()
            if crowded:
                return changes + self._exclude(crowded)
        now = time.monotonic()
        if self._survey and all(query.ended for query in self._survey):
            self._end_survey()
        elif self._tokens.is_listing and now > self._slow:
            self._restart(self._query)
        elif now > self._retry:
            self._excluded = set()
            self._retry = math.inf
            self._restart(self._subscribe)
        return changes

    def _receive(self) -> list[tuple[str, bool]]:
        """Return the changes of the subscription, or the tokens that the survey lists."""
        if not self._survey:
            return self._tokens.poll()
        replies = [reply for query in self._survey for reply in query.poll()]
        return [(str(reply.ok.key_expr), True) for reply in replies if reply.ok is not None]

    def _crowded(self) -> set[str]:
        """Return the vehicles to exclude now: those above the limit, if few key expressions exclude them."""
        limit = limits.TOKENS_OF_VEHICLE
        crowded = {vehicle for vehicle, number in self._numbers.items() if number > limit}
        if crowded and len(self._key_exprs(self._excluded | crowded)) > limits.EXCLUDING_KEY_EXPRS:
            return set()
        return crowded

    def _exclude(self, crowded: set[str]) -> list[tuple[str, bool]]:
        """Exclude vehicles; return the ends of their tokens."""
        text = (
            "the streams of %s are not listed: over %d liveliness tokens, the limit for a vehicle"
        )
        names = ", ".join(map(repr, sorted(crowded)))
        _log.warning(text, names, limits.TOKENS_OF_VEHICLE, extra=about("incomplete"))
        self._excluded |= crowded
        self._retry = time.monotonic() + TIMINGS.excluded
        gone = [(key, False) for key in self._keys if self._vehicle_of(key) in crowded]
        for change in gone:
            self._apply(*change)
        self._restart(self._subscribe)
        return gone

    def _end_survey(self) -> None:
        is_complete = len(self._keys) < limits.REPLIES
        if any(query.failed for query in self._survey):
            is_complete = False
        self._restart(partial(self._subscribe, is_surveyed=is_complete))
        self._slow = math.inf  # no vehicle has too many

    def _restart(self, start: Callable[[], None]) -> None:
        """List the tokens on a new session, because the old one processes all tokens that the router has sent."""
        self._slow = math.inf
        with suppress(NedbusError):  # no router answers: the old session reconnects
            session = self._open_session()
            self._session.close()
            self._session = session
            start()

    def _subscribe(self, *, is_surveyed: bool = False) -> None:
        self._survey: list[Replies] = []
        self._is_surveyed = is_surveyed  # a query has listed all tokens
        self._tokens = LivelinessTokens(
            self._session, *self._key_exprs(self._excluded), known=self._keys
        )
        self._slow = time.monotonic() + TIMINGS.slow_list

    def _query(self) -> None:
        key_exprs = self._key_exprs(self._excluded)
        self._survey = [
            query_tokens(self._session, key_expr, timeout=_QUERY_TIMEOUT) for key_expr in key_exprs
        ]

    def _key_exprs(self, excluded: Set[str]) -> list[str]:
        return key_exprs_without(excluded, self._selection, prefix=self._prefix)

    def _apply(self, key: str, alive: bool) -> bool:
        """Apply a change; return False if it has no effect."""
        if (key in self._keys) == alive:
            return False
        vehicle = self._vehicle_of(key)
        if not alive:
            self._keys.remove(key)
            self._numbers[vehicle] -= 1
            if not self._numbers[vehicle]:
                del self._numbers[vehicle]
            return True
        if len(self._keys) >= limits.REPLIES:
            return False
        self._keys.add(key)
        self._numbers[vehicle] += 1
        return True

    def _vehicle_of(self, key: str) -> str:
        return key.removeprefix(f"{self._prefix}/").partition("/")[0][: _LONGEST_NAME + 1]


def key_exprs_without(excluded: Set[str], selection: Selection, *, prefix: str) -> list[str]:
    """Return key expressions that match the tokens of a selection, except those of the excluded vehicles."""
    if selection.vehicles != (ANY,):
        kept = [vehicle for vehicle in selection.vehicles if vehicle not in excluded]
        if not kept:
            return [f"{prefix}/{selection.vehicles[0]}/@alive/-"]  # no token
        return Selection(selection.topics, kept, selection.instance).alive_key_exprs(prefix=prefix)
    starts = {name[:length] for name in excluded for length in range(len(name) + 1)}
    # All names that begin like an excluded one, and then differ.
    patterns = {
        f"{start}{character}$*"
        for start in starts
        for character in _CHARACTERS
        if len(start) <= _LONGEST_NAME and start + character not in starts
    }
    # The excluded names shortened, which are names of their own.
    patterns |= starts - excluded - {""}
    return [
        tokens.replace(f"/{ANY}/", f"/{pattern}/", 1)
        for tokens in selection.alive_key_exprs(prefix=prefix)
        for pattern in sorted(patterns) or [ANY]
    ]
