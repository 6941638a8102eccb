"""Validation rules between fields, as Python expressions on values and on NumPy columns.

Every rule holds in all examined real flights; docs/messages.md has the counts.
"""

import math
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import chain
from string import Formatter
from typing import Any, Final, NamedTuple, cast

FLOAT32_PI: Final = struct.unpack("<f", struct.pack("<f", math.pi))[0]
"""The largest angle that PX4 sends: float32(pi), which exceeds pi as a double."""

LONGITUDE_LIMIT: Final = 360.0
"""The largest longitude that PX4 sends [deg].

Up to 1.15 PX4 does not wrap: MapProjection::reproject adds up to 180 degrees to the longitude of the origin.
"""

_QUATERNION: Final = struct.Struct("<4f")


class Check(NamedTuple):
    """The check of one field.

    `reason`: the error text. `wrong`: an expression that is true if the field breaks the rule; it has parentheses
    around each comparison and no `if`, so it converts to an expression on columns. Both have field names in braces.
    """

    field: str
    reason: str
    wrong: str


class Rule:
    """Base class of rules; values already have the right types, and NaN never breaks a rule on a single field.

    `flags`: for each flag, the fields that are finite while it is set.
    """

    flags: Mapping[str, Sequence[str]] = {}

    def __init__(self, checks: Iterable[Check]) -> None:
        self.checks = tuple(checks)

    @property
    def fields(self) -> Sequence[str]:
        """All fields that the rule reads."""
        parts = (part for check in self.checks for part in Formatter().parse(check.wrong))
        return list(dict.fromkeys(name for _, name, _, _ in parts if name))


class FiniteWhile(Rule):
    """Fields are finite while their flag is set; `flags`: the fields of each flag, separated by spaces."""

    def __init__(self, **flags: str) -> None:
        self.flags = {flag: tuple(names.split()) for flag, names in flags.items()}
        super().__init__(
            Check(
                name,
                f"must be finite while {flag} is true",
                f"({{{flag}}} and not isfinite({{{name}}}))",
            )
            for flag, names in self.flags.items()
            for name in names
        )


class NotNegative(Rule):
    """Variances, standard deviations and the like are not negative; NaN and infinity pass."""

    def __init__(self, *fields: str) -> None:
        super().__init__(
            Check(name, "must not be negative", f"({{{name}}} < 0)") for name in fields
        )


class Within(Rule):
    """The magnitude of each field is at most its bound; NaN passes."""

    def __init__(self, **bounds: float) -> None:
        super().__init__(
            Check(field, f"must be within +-{bound:.9g}", f"(abs({{{field}}}) > {bound!r})")
            for field, bound in bounds.items()
        )


class InRange(Rule):
    """A field, or each element of an array, is within `least` and `greatest`, or is `or_` ("unknown"); NaN passes."""

    def __init__(
        self,
        field: str,
        least: float,
        greatest: float,
        *,
        or_: float | None = None,
        is_array: bool = False,
    ) -> None:
        reason = f"must be {least:.9g} to {greatest:.9g}" + (
            "" if or_ is None else f", or {or_:g} if unknown"
        )
        # A valid value must stay valid when rounded to float32; the bounds may be infinite.
        least, greatest = min(least, float32(least)), max(greatest, float32(greatest))
        each = "each" if is_array else f"{{{field}}}"
        known = (
            []
            if or_ is None
            else [f"({each} != {value!r})" for value in dict.fromkeys((or_, float32(or_)))]
        )
        wrong = f"({' and '.join([f'(({each} < {least!r}) or ({each} > {greatest!r}))', *known])})"
        super().__init__(
            [Check(field, reason, f"any([{wrong} for each in {{{field}}}])" if is_array else wrong)]
        )


class NotLater(Rule):
    """One time is not later than another."""

    def __init__(self, earlier: str, later: str) -> None:
        reason = f"must not be later than {later} ({{{later}}})"
        super().__init__([Check(earlier, reason, f"({{{earlier}}} > {{{later}}})")])


class UnitQuaternion(Rule):
    """A quaternion (w, x, y, z) has norm 1, within `tolerance`, or is unknown: w is NaN.

    `or_zeros`: it is unknown as well if all elements are zero.
    """

    def __init__(self, field: str, *, tolerance: float = 0.001, or_zeros: bool = False) -> None:
        reason = "must have norm 1, or NaN as first element if unknown"
        if or_zeros:
            reason = "must have norm 1, or NaN as first element or zeros if unknown"
        least, greatest = (1.0 - tolerance) ** 2, (1.0 + tolerance) ** 2
        middle, deviation = (greatest + least) / 2, (greatest - least) / 2
        norm = f"squared_norm({{{field}}})"
        is_other = f"(not (abs({norm} - {middle!r}) <= {deviation!r}))"
        is_known = f"({{{field}}}[0] == {{{field}}}[0])"
        wrong = f"({is_known} and {is_other}"
        wrong += f" and ({norm} != 0))" if or_zeros else ")"
        super().__init__([Check(field, reason, wrong)])


def expression_of(rules: Sequence[Rule], accessors: Mapping[str, str]) -> str:
    """Return one expression that is true if `values` pass all rules; `accessors`: the expression for each field.

    A single expression avoids a function call per rule.
    """
    passed = []
    for rule in rules:
        right = f"not ({' or '.join(check.wrong for check in rule.checks)})"
        # Fast path: the sum of all guarded fields is almost always finite.
        finite = " + ".join(f"{{{name}}}" for fields in rule.flags.values() for name in fields)
        passed.append(f"(isfinite({finite}) or {right})" if finite else right)
    return (" and ".join(passed) or "True").format_map(accessors)


def violations(rules: Sequence[Rule], values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the name and the reason for each field that breaks a rule, given the values of all fields."""
    accessors = {name: f"values[{name!r}]" for name in values}
    for check in chain.from_iterable(rule.checks for rule in rules):
        if compile_lambda(f"lambda values: {check.wrong}".format_map(accessors))(values):
            yield check.field, check.reason.format_map(values)


def column_checks(
    rules: Sequence[Rule], **functions: Callable[..., Any]
) -> list[Callable[[Any], Any]]:
    """Return one function per check that maps a structured array to a mask of the messages that break it.

    `functions`: column versions of the functions that checks call; array columns are transposed.
    """
    accessors = {name: f"values[{name!r}].T" for rule in rules for name in rule.fields}
    texts = [check.wrong.format_map(accessors) for rule in rules for check in rule.checks]
    for word, operator in {" or ": " | ", " and ": " & ", "not ": "~"}.items():
        texts = [text.replace(word, operator) for text in texts]
    return [compile_lambda(f"lambda values: {text}", **functions) for text in texts]


@lru_cache(1024)
def compile_lambda(expression: str, **functions: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a lambda generated from numbers and field positions, never from data of a peer."""
    names = {
        "isfinite": math.isfinite,
        "squared_norm": _rounded_norm,
        "inf": math.inf,
        "nan": math.nan,
        **functions,
    }
    # eval() of a str makes CPython lose a pending Ctrl-C
    code = compile(expression, "<rules>", "eval")
    return cast("Callable[..., Any]", eval(code, names))  # noqa: S307 - see above


def float32(value: float) -> float:
    """Return the nearest float32; infinity beyond its range."""
    try:
        return cast("float", struct.unpack("<f", struct.pack("<f", value))[0])
    except OverflowError:
        return math.copysign(math.inf, value)


def squared_norm(quaternion: tuple[float, ...]) -> float:
    """Return the squared norm of a quaternion."""
    w, x, y, z = quaternion
    return w * w + x * x + y * y + z * z


def _rounded_norm(quaternion: tuple[float, ...]) -> float:
    """Return the squared norm of a quaternion after rounding to float32."""
    try:
        return squared_norm(_QUATERNION.unpack(_QUATERNION.pack(*quaternion)))
    except OverflowError:
        return math.inf
