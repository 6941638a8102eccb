"""Rules for the fields of a message, as Python expressions on values and on NumPy columns.

Every rule holds on all real flights examined; docs/messages.md has the counts.
"""

import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import lru_cache
from typing import Any, Final, NamedTuple, cast

FLOAT32_PI: Final = struct.unpack("<f", struct.pack("<f", math.pi))[0]
"""The largest angle that PX4 sends: float32(pi), which is above the double pi."""

_QUATERNION: Final = struct.Struct("<4f")

Place = Callable[[str], str]
"""A function from the name of a field to the Python expression of its value."""


class Check(NamedTuple):
    """The check of one field.

    `reason`: the error text, with other fields in braces.
    `wrong`: an expression that is true if the field breaks the rule. It has parentheses around each comparison and no
    `if`, to be convertible to an expression on columns.
    """

    field: str
    reason: str
    wrong: str


class Rule:
    """A rule for each of its `fields`, or between them; values already have the right types.

    NaN never breaks the rule of a single field.
    """

    reason: str
    flags: Mapping[str, Sequence[str]] = {}

    def __init__(self, *fields: str) -> None:
        self.fields = fields

    def wrong(self, value: str) -> str:
        """Return an expression that is true if a value breaks the rule."""
        raise NotImplementedError

    def checks(self, at: Place) -> Iterator[Check]:
        """Yield the check of each field."""
        for name in self.fields:
            yield Check(name, self.reason, self.wrong(at(name)))

    def kept(self, at: Place) -> str:
        """Return an expression that is true if a message obeys the rule."""
        return f"not ({' or '.join(check.wrong for check in self.checks(at))})"


class FiniteWhile(Rule):
    """Fields are finite while their flag is set; `flags` maps each flag to its fields."""

    def __init__(self, flags: Mapping[str, Sequence[str]]) -> None:
        super().__init__(*(name for flag, names in flags.items() for name in (flag, *names)))
        self.flags = flags

    def checks(self, at: Place) -> Iterator[Check]:
        """Yield the check of each field of each flag."""
        for flag, names in self.flags.items():
            for name in names:
                yield Check(name, f"must be finite while {flag} is true", f"({at(flag)} and not isfinite({at(name)}))")

    def kept(self, at: Place) -> str:
        """Check all fields at once first, as they are almost always finite."""
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
    """A field, or each element of an array, is within `least` and `greatest`, or is `or_` ("unknown"); NaN passes."""

    def __init__(
        self, field: str, least: float, greatest: float, *, or_: float | None = None, is_array: bool = False
    ) -> None:
        super().__init__(field)
        self._is_array = is_array
        # A valid value must remain valid when it is rounded to float32.
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
        """Yield the check of the earlier field."""
        earlier, later = self.fields
        yield Check(earlier, f"must not be later than {later} ({{{later}}})", f"({at(earlier)} > {at(later)})")


class UnitQuaternion(Rule):
    """A quaternion (w, x, y, z) has norm 1, within 0.001, or is not provided (w is NaN)."""

    reason = "must have norm 1, or NaN as its first element while it is not known"
    _SQUARE: Final = (0.999**2 + 1.001**2) / 2
    _TOLERANCE: Final = (1.001**2 - 0.999**2) / 2

    def wrong(self, value: str) -> str:
        """Compare the square of the norm."""
        bad = f"not (abs(squared_norm({value}) - {self._SQUARE!r}) <= {self._TOLERANCE!r})"
        return f"(({value}[0] == {value}[0]) and {bad})"


def passes_all(rules: Sequence[Rule], at: Place) -> Callable[[Any], bool]:
    """Return a function that checks whether `values` pass all rules; `at` gives the expression of a field in it.

    It is compiled from a single expression, so it costs no more than its comparisons.
    """
    return evaluated(f"lambda values: {' and '.join(rule.kept(at) for rule in rules) or True}")


def violations(rules: Sequence[Rule], values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the name and the reason for each field that breaks a rule, given the values of all fields."""
    for rule in rules:
        for field, reason, wrong in rule.checks(lambda name: f"values[{name!r}]"):
            if evaluated(f"lambda values: {wrong}")(values):
                yield field, reason.format_map(values)


def wrong_columns(rules: Sequence[Rule], **functions: Callable[..., Any]) -> list[Callable[[Any], Any]]:
    """Return one function per check, from a structured array to a mask of the messages that break the rule.

    `functions`: the functions that checks call, for columns; columns of arrays are transposed.
    """
    texts = [check.wrong for rule in rules for check in rule.checks(lambda name: f"values[{name!r}].T")]
    for word, operator in {" or ": " | ", " and ": " & ", "not ": "~"}.items():
        texts = [text.replace(word, operator) for text in texts]
    return [evaluated(f"lambda values: {text}", **functions) for text in texts]


@lru_cache(1024)
def evaluated(expression: str, **functions: Callable[..., Any]) -> Callable[[Any], Any]:
    """Compile a lambda that was generated from numbers and field positions, never from a peer's data."""
    names = {"isfinite": math.isfinite, "squared_norm": _squared_norm, "inf": math.inf, **functions}
    code = compile(expression, "<rules>", "eval")  # eval() of a str makes CPython lose a pending Ctrl-C
    return cast("Callable[[Any], Any]", eval(code, names))  # noqa: S307 - see above


def float32(value: float) -> float:
    """Return the nearest float32; infinity beyond its range."""
    try:
        return cast("float", struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)


def _squared_norm(quaternion: tuple[float, float, float, float]) -> float:
    """Return the squared norm of a quaternion after rounding to float32."""
    try:
        w, x, y, z = _QUATERNION.unpack(_QUATERNION.pack(*quaternion))
    except OverflowError:
        return math.inf
    return cast("float", w * w + x * x + y * y + z * z)
