"""The rules between the fields of a message, each an expression of Python: of values, and of columns of NumPy.

A rule is one only if no real flight breaks it: docs/messages.md has the counts.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache
from typing import Any, Final, NamedTuple, cast

FLOAT32_PI: Final = struct.unpack("<f", struct.pack("<f", math.pi))[0]
"""The largest angle that PX4 sends: float32(pi), which is above the double pi."""

_QUATERNION: Final = struct.Struct("<4f")

Place = Callable[[str], str]
"""Return the Python expression of a field's value, given its name."""


class Check(NamedTuple):
    """The check of one field: `wrong` is an expression that is true if it breaks the rule.

    `reason`: the text for it, with other fields in braces.
    `wrong` has parentheses around each comparison, and no `if`, so that it can be made one of columns.
    """

    field: str
    reason: str
    wrong: str


class Rule:
    """A rule of each of some `fields` by itself, or between them; the values have the right types.

    NaN never breaks the rule of a field.
    """

    reason: str

    def __init__(self, *fields: str) -> None:
        self.fields = fields

    def wrong(self, value: str) -> str:
        """Return an expression that is true for a value that breaks it."""
        raise NotImplementedError

    def checks(self, at: Place) -> Iterator[Check]:
        """Yield the check of each field."""
        for name in self.fields:
            yield Check(name, self.reason, self.wrong(at(name)))

    def kept(self, at: Place) -> str:
        """Return an expression that is true for a message that keeps it."""
        return f"not ({' or '.join(check.wrong for check in self.checks(at))})"


class FiniteWhile(Rule):
    """While a flag is set, its fields are finite; `flags` has the fields of each."""

    def __init__(self, flags: Mapping[str, Sequence[str]]) -> None:
        super().__init__(*(name for flag, names in flags.items() for name in (flag, *names)))
        self.flags = flags

    def checks(self, at: Place) -> Iterator[Check]:
        """Yield the check of each field that a flag stands for."""
        for flag, names in self.flags.items():
            for name in names:
                yield Check(name, f"must be finite while {flag} is true", f"({at(flag)} and not isfinite({at(name)}))")

    def kept(self, at: Place) -> str:
        """Look at all fields at once first: almost always they are finite."""
        fields = [at(name) for names in self.flags.values() for name in names]
        return f"(isfinite({' + '.join(fields)}) or {super().kept(at)})"


class NotNegative(Rule):
    """Variances, standard deviations and the like are not negative; NaN and infinity pass."""

    reason = "must not be negative"

    def wrong(self, value: str) -> str:
        """Compare with 0."""
        return f"({value} < 0)"


class Within(Rule):
    """The magnitude of a field is at most a bound; NaN passes."""

    def __init__(self, field: str, bound: float) -> None:
        super().__init__(field)
        self.bound = bound
        self.reason = f"must be within +-{bound:.9g}"

    def wrong(self, value: str) -> str:
        """Compare the magnitude."""
        return f"(abs({value}) > {self.bound!r})"


class InRange(Rule):
    """A field, or each element of an array, is from `least` to `greatest`, or the value of "not known"; NaN passes."""

    def __init__(
        self, field: str, least: float, greatest: float, *, or_: float | None = None, is_array: bool = False
    ) -> None:
        super().__init__(field)
        self._is_array = is_array
        # A value that is rounded to float32 on its way must keep the rule that it kept before.
        self._bounds = min(least, float32(least)), max(greatest, float32(greatest))
        self._unknown = () if or_ is None else tuple(dict.fromkeys((or_, float32(or_))))
        unknown = "" if or_ is None else f", or {or_:g} while it is not known"
        self.reason = f"must be {least:.9g} to {greatest:.9g}{unknown}"

    def wrong(self, value: str) -> str:
        """Compare with both bounds, which may be infinite."""
        if self._is_array:
            return f"any([{self._wrong('each')} for each in {value}])"
        return self._wrong(value)

    def _wrong(self, value: str) -> str:
        least, greatest = self._bounds
        known = [f"({value} != {each!r})" for each in self._unknown]
        return f"({' and '.join([f'(({value} < {least!r}) or ({value} > {greatest!r}))', *known])})"


class NotLater(Rule):
    """One time is not later than another."""

    def __init__(self, earlier: str, later: str) -> None:
        super().__init__(earlier, later)

    def checks(self, at: Place) -> Iterator[Check]:
        """Yield that of the earlier one."""
        earlier, later = self.fields
        yield Check(earlier, f"must not be later than {later} ({{{later}}})", f"({at(earlier)} > {at(later)})")


class UnitQuaternion(Rule):
    """A quaternion (w, x, y, z) has norm 1, to a thousandth, or is not provided: w is NaN."""

    reason = "must have norm 1, or NaN as its first element while it is not known"
    _SQUARE: Final = (0.999**2 + 1.001**2) / 2
    _TOLERANCE: Final = (1.001**2 - 0.999**2) / 2

    def wrong(self, value: str) -> str:
        """Compare the square of the norm."""
        bad = f"not (abs(squared_norm({value}) - {self._SQUARE!r}) <= {self._TOLERANCE!r})"
        return f"(({value}[0] == {value}[0]) and {bad})"


def passes_all(rules: Sequence[Rule], at: Place) -> Callable[[Any], bool]:
    """Return a function that returns whether `values` pass the rules; `at` gives the place of each field in it.

    It is one expression, so that it takes no more time than the comparisons that it is made of.
    """
    return evaluated(f"lambda values: {' and '.join(rule.kept(at) for rule in rules) or True}")


def violations(rules: Sequence[Rule], values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield field and reason of each field that breaks a rule, given the values of all fields."""
    for rule in rules:
        for field, reason, wrong in rule.checks(lambda name: f"values[{name!r}]"):
            if evaluated(f"lambda values: {wrong}")(values):
                yield field, reason.format_map(values)


def wrong_columns(rules: Sequence[Rule], **functions: Callable[..., Any]) -> list[Callable[[Any], Any]]:
    """Return functions that return a mask of the messages of a structured array that break a rule.

    `functions` are those of columns, by the names that checks have for them; an array of vectors is transposed.
    """
    texts = [check.wrong for rule in rules for check in rule.checks(lambda name: f"values[{name!r}].T")]
    for word, operator in {" or ": " | ", " and ": " & ", "not ": "~"}.items():
        texts = [text.replace(word, operator) for text in texts]
    return [evaluated(f"lambda values: {text}", **functions) for text in texts]


@cache
def evaluated(expression: str, **functions: Callable[..., Any]) -> Callable[[Any], Any]:
    """Return the function of a lambda that is made here, of numbers and places: nothing of it comes from a peer."""
    names = {"isfinite": math.isfinite, "squared_norm": _squared_norm, "inf": math.inf, **functions}
    code = compile(expression, "<rules>", "eval")  # of a text, eval makes CPython forget a Ctrl-C of another thread
    return cast("Callable[[Any], Any]", eval(code, names))  # noqa: S307 - see above


def float32(value: float) -> float:
    """Return the nearest float32; infinity beyond its range."""
    try:
        return cast("float", struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)


def _squared_norm(quaternion: tuple[float, float, float, float]) -> float:
    """Return the square of the norm that it has once it is rounded to float32."""
    try:
        w, x, y, z = _QUATERNION.unpack(_QUATERNION.pack(*quaternion))
    except OverflowError:
        return math.inf
    return cast("float", w * w + x * x + y * y + z * z)
