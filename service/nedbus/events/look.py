"""Look at some fields of messages fast, whatever holds them: a model, a row, or fields by name."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from operator import attrgetter, itemgetter
from typing import Any

Values = tuple[Any, ...]


class Look:
    """Return the values of these fields of a message, `absent` for those that fields by name do not have."""

    def __init__(self, names: Sequence[str], absent: float | None = None) -> None:
        self.names, self._absent = tuple(names), absent
        self._of_message: Callable[[object], Values] = attrgetter(*names)
        self._of_fields: Callable[[Mapping[str, object]], Values] = itemgetter(*names)

    def __call__(self, message: object) -> Values:
        """Return the values, in the order of the names."""
        if type(message) is not dict:
            return self._of_message(message)
        try:
            return self._of_fields(message)
        except KeyError:
            return tuple(message.get(name, self._absent) for name in self.names)
