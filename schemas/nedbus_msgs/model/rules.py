"""The rules between the fields of a message: each as an expression, as reasons, and as a mask of many messages.

A rule is one only if no real flight breaks it: docs/messages.md has the counts.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cache, cached_property
from typing import Any, Final, Protocol, cast

FLOAT32_PI: Final = struct.unpack("<f", struct.pack("<f", math.pi))[0]
"""The largest angle that PX4 sends: float32(pi), which is above the double pi."""

Place = Callable[[str], str]
"""Return the Python expression of a field's value, given its name."""


class Rule(Protocol):
    """One rule, or several alike, between the values of a message, which have the right types."""

    @property
    def fields(self) -> Sequence[str]:
        """The fields that it looks at."""
        ...

    def expression(self, at: Place) -> str:
        """Return a Python expression that is true for values that keep it."""
        ...

    def violations(self, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield field and reason for each field of all fields' values that breaks it."""
        ...

    def mark(self, array: Any, invalid: Any, np: Any) -> None:
        """Set the mask of the messages of a structured array that break it; `np` is NumPy, which is slow to load."""
        ...


class FiniteWhile:
    """While a flag is set, its fields are finite; `flags` has the fields of each."""

    def __init__(self, flags: Mapping[str, Sequence[str]]) -> None:
        self.flags = flags
        self.fields = tuple(name for flag, names in flags.items() for name in (flag, *names))

    def expression(self, at: Place) -> str:
        """Look at all at once first: almost always they are finite."""
        at_once = " + ".join(at(name) for names in self.flags.values() for name in names)
        flagged = [
            f"(not {at(flag)} or {' and '.join(f'isfinite({at(name)})' for name in names)})"
            for flag, names in self.flags.items()
        ]
        return f"(isfinite({at_once}) or ({' and '.join(flagged)}))"

    def violations(self, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield the fields that are not finite."""
        for flag, names in self.flags.items():
            for name in names if values[flag] else ():
                if not math.isfinite(values[name]):
                    yield name, f"must be finite while {flag} is true"

    def mark(self, array: Any, invalid: Any, np: Any) -> None:
        """Look at each field."""
        for flag, names in self.flags.items():
            for name in names:
                invalid |= array[flag] & ~np.isfinite(array[name])


class _OfEach:
    """A rule of each of some fields by itself: `wrong` and `reason` say which values break it; NaN never does.

    `is_array`: the fields are arrays, and it is one of each element.
    """

    reason: str

    def __init__(self, *fields: str, is_array: bool = False) -> None:
        self.fields = fields
        self._is_array = is_array

    def wrong(self, value: str) -> str:
        """Return an expression that is true for a value that breaks it."""
        raise NotImplementedError

    def expression(self, at: Place) -> str:
        """Look at one field after the other."""
        return f"not ({' or '.join(self._wrong(at(name)) for name in self.fields)})"

    def violations(self, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield the fields that break it."""
        is_wrong = evaluated(f"lambda value: {self._wrong('value')}")
        return ((name, self.reason) for name in self.fields if is_wrong(values[name]))

    def mark(self, array: Any, invalid: Any, np: Any) -> None:
        """Look at whole columns."""
        for name in self.fields:
            wrong = self._is_wrong_column(array[name])
            invalid |= wrong.any(axis=1) if self._is_array else wrong

    @cached_property
    def _is_wrong_column(self) -> Callable[[Any], Any]:
        return evaluated(f"lambda value: {self.wrong('value')}".replace(" or ", " | ").replace(" and ", " & "))

    def _wrong(self, value: str) -> str:
        return f"any([{self.wrong('each')} for each in {value}])" if self._is_array else self.wrong(value)


class NotNegative(_OfEach):
    """Variances, standard deviations and the like are not negative; NaN and infinity pass."""

    reason = "must not be negative"

    def wrong(self, value: str) -> str:
        """Compare with 0."""
        return f"({value} < 0)"


class Within(_OfEach):
    """The magnitude of a field is at most a bound; NaN passes."""

    def __init__(self, field: str, bound: float) -> None:
        super().__init__(field)
        self.bound = bound
        self.reason = f"must be within +-{bound:.9g}"

    def wrong(self, value: str) -> str:
        """Compare the magnitude."""
        return f"(abs({value}) > {self.bound!r})"


class InRange(_OfEach):
    """A field is from `least` to `greatest`, or the value that stands for "not known"; NaN passes."""

    def __init__(
        self, field: str, least: float, greatest: float, *, or_: float | None = None, is_array: bool = False
    ) -> None:
        super().__init__(field, is_array=is_array)
        # A value that is rounded to float32 on its way must keep the rule that it kept before.
        self._bounds = min(least, float32(least)), max(greatest, float32(greatest))
        self._unknown = () if or_ is None else tuple(dict.fromkeys((or_, float32(or_))))
        unknown = "" if or_ is None else f", or {or_:g} while it is not known"
        self.reason = f"must be {least:.9g} to {greatest:.9g}{unknown}"

    def wrong(self, value: str) -> str:
        """Compare with both bounds, which may be infinite."""
        least, greatest = self._bounds
        beyond = [f"({value} < {least!r})"] * math.isfinite(least)
        beyond += [f"({value} > {greatest!r})"] * math.isfinite(greatest)
        outside = f"({' or '.join(beyond)})" if beyond else "(0 > 1)"
        return f"({' and '.join([outside, *(f'({value} != {each!r})' for each in self._unknown)])})"


class NotLater:
    """One time is not later than another."""

    def __init__(self, earlier: str, later: str) -> None:
        self.fields = (earlier, later)

    def expression(self, at: Place) -> str:
        """Compare them."""
        earlier, later = self.fields
        return f"{at(earlier)} <= {at(later)}"

    def violations(self, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield the earlier one."""
        earlier, later = self.fields
        if values[earlier] > values[later]:
            yield earlier, f"must not be later than {later} ({values[later]})"

    def mark(self, array: Any, invalid: Any, np: Any) -> None:
        """Compare the columns."""
        earlier, later = self.fields
        invalid |= array[earlier] > array[later]


class UnitQuaternion:
    """A quaternion (w, x, y, z) has norm 1, to a thousandth, or is not provided: w is NaN."""

    _SQUARES: Final = (0.999**2, 1.001**2)
    reason: Final = "must have norm 1, or NaN as its first element while it is not known"

    def __init__(self, field: str) -> None:
        self.fields = (field,)

    def expression(self, at: Place) -> str:
        """Compare the square of the norm."""
        value, (least, greatest) = at(self.fields[0]), self._SQUARES
        return f"({value}[0] != {value}[0] or {least!r} <= squared_norm({value}) <= {greatest!r})"

    def violations(self, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield it."""
        [field] = self.fields
        if not evaluated(f"lambda value: {self.expression(lambda _: 'value')}")(values[field]):
            yield field, self.reason

    def mark(self, array: Any, invalid: Any, np: Any) -> None:
        """Compare the norms, in float64."""
        least, greatest = self._SQUARES
        value = array[self.fields[0]].astype(float)
        squares = np.sum(value * value, axis=1)
        invalid |= ~np.isnan(value[:, 0]) & ~((squares >= least) & (squares <= greatest))


def passes_all(rules: Sequence[Rule], at: Place) -> Callable[[Any], bool]:
    """Return a function that returns whether `values` pass the rules; `at` gives the place of each field in it.

    It is one expression, so that it takes no more time than the comparisons that it is made of.
    """
    checks = [rule.expression(at) for rule in rules]
    return evaluated(f"lambda values: {' and '.join(checks) or True}")


@cache
def evaluated(expression: str) -> Callable[[Any], Any]:
    """Return the function of a lambda that is made here, of numbers and places: nothing of it comes from a peer."""
    names = {"isfinite": math.isfinite, "squared_norm": _squared_norm, "inf": math.inf}
    code = compile(expression, "<rules>", "eval")  # of a text, eval makes CPython forget a Ctrl-C of another thread
    return cast("Callable[[Any], Any]", eval(code, names))  # noqa: S307 - see above


_QUATERNION: Final = struct.Struct("<4f")


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
