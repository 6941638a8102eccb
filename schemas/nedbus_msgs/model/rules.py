"""Validation rules between fields, as Python expressions on values and on NumPy columns.

Every rule holds in all examined real flights; docs/messages.md has the counts.
"""

import math
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from functools import lru_cache
from string import Formatter
from typing import Any, Final, NamedTuple, cast

FLOAT32_PI: Final = struct.unpack("<f", struct.pack("<f", math.pi))[0]
"""The largest angle that PX4 sends: float32(pi), which exceeds pi as a double."""

LONGITUDE_LIMIT: Final = 360.0
"""The largest longitude that PX4 sends [deg].

Up to 1.15 PX4 does not wrap: MapProjection::reproject adds up to 180 degrees to the longitude of the origin.
"""

_QUATERNION: Final = struct.Struct("<4f")
_COLUMN_OPERATORS: Final = {" or ": " | ", " and ": " & ", "not ": "~"}


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
        names: list[str] = []
        for check in self.checks:
            for _, name, _, _ in Formatter().parse(check.wrong):
                if name and name not in names:
                    names.append(name)
        return names


class FiniteWhile(Rule):
    """Fields are finite while their flag is set; `flags`: the fields of each flag, separated by spaces."""

    def __init__(self, **flags: str) -> None:
        self.flags = {flag: tuple(names.split()) for flag, names in flags.items()}
        checks: list[Check] = []
        for flag, names in self.flags.items():
            reason = f"must be finite while {flag} is true"
            for name in names:
                wrong = f"({_value(flag)} and not isfinite({_value(name)}))"
                checks.append(Check(name, reason, wrong))
        super().__init__(checks)


class NotNegative(Rule):
    """Variances, standard deviations and the like are not negative; NaN and infinity pass."""

    def __init__(self, *fields: str) -> None:
        reason = "must not be negative"
        super().__init__(Check(name, reason, f"({_value(name)} < 0)") for name in fields)


class Within(Rule):
    """The magnitude of each field is at most its bound; NaN passes."""

    def __init__(self, **bounds: float) -> None:
        checks: list[Check] = []
        for name, bound in bounds.items():
            reason = f"must be within +-{bound:.9g}"
            checks.append(Check(name, reason, f"(abs({_value(name)}) > {bound!r})"))
        super().__init__(checks)


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
        reason = f"must be {least:.9g} to {greatest:.9g}"
        if or_ is not None:
            reason += f", or {or_:g} if unknown"
        # A valid value must stay valid when rounded to float32; the bounds may be infinite.
        lowest = min(least, float32(least))
        highest = max(greatest, float32(greatest))
        if is_array:
            value = "element"
        else:
            value = _value(field)
        wrong = f"(({value} < {lowest!r}) or ({value} > {highest!r}))"
        if or_ is not None:
            wrong += f" and ({value} != {or_!r})"
            if float32(or_) != or_:
                wrong += f" and ({value} != {float32(or_)!r})"
        wrong = f"({wrong})"
        if is_array:
            wrong = f"any([{wrong} for element in {_value(field)}])"
        super().__init__([Check(field, reason, wrong)])


class NotLater(Rule):
    """One time is not later than another."""

    def __init__(self, earlier: str, later: str) -> None:
        reason = f"must not be later than {later} ({{{later}}})"
        super().__init__([Check(earlier, reason, f"({_value(earlier)} > {_value(later)})")])


class UnitQuaternion(Rule):
    """A quaternion (w, x, y, z) has norm 1, within `tolerance`, or is unknown: w is NaN.

    `or_zeros`: it is unknown as well if all elements are zero.
    """

    def __init__(self, field: str, *, tolerance: float = 0.001, or_zeros: bool = False) -> None:
        reason = "must have norm 1, or NaN as first element if unknown"
        if or_zeros:
            reason = "must have norm 1, or NaN as first element or zeros if unknown"
        least = (1.0 - tolerance) ** 2
        greatest = (1.0 + tolerance) ** 2
        middle = (greatest + least) / 2
        deviation = (greatest - least) / 2
        value = _value(field)
        norm = f"squared_norm({value})"
        is_known = f"({value}[0] == {value}[0])"  # false for NaN
        is_other = f"(not (abs({norm} - {middle!r}) <= {deviation!r}))"
        wrong = f"{is_known} and {is_other}"
        if or_zeros:
            wrong += f" and ({norm} != 0)"
        super().__init__([Check(field, reason, f"({wrong})")])


def _value(name: str) -> str:
    """Return the field's name in braces, for which its value is inserted."""
    return f"{{{name}}}"


def expression_of(rules: Sequence[Rule], accessors: Mapping[str, str]) -> str:
    """Return one expression that is true if `values` pass all rules; `accessors`: the expression for each field.

    A single expression avoids a function call per rule. For FiniteWhile(z_valid="z") and NotNegative("eph", "epv"):

        (isfinite(values[3]) or not ((values[1] and not isfinite(values[3]))))
            and not ((values[4] < 0) or (values[5] < 0))
    """
    if not rules:
        return "True"
    passed: list[str] = []
    for rule in rules:
        right = f"not ({' or '.join(check.wrong for check in rule.checks)})"
        guarded: list[str] = []
        for fields in rule.flags.values():
            guarded.extend(_value(name) for name in fields)
        if guarded:
            # Fast path: the sum of all guarded fields is almost always finite.
            right = f"(isfinite({' + '.join(guarded)}) or {right})"
        passed.append(right)
    return " and ".join(passed).format_map(accessors)


def violations(rules: Sequence[Rule], values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    """Yield the name and the reason for each field that breaks a rule, given the values of all fields."""
    accessors = {name: f"values[{name!r}]" for name in values}
    for rule in rules:
        for check in rule.checks:
            is_wrong = compile_lambda(f"lambda values: {check.wrong}".format_map(accessors))
            if is_wrong(values):
                yield check.field, check.reason.format_map(values)


def column_checks(
    rules: Sequence[Rule], **functions: Callable[..., Any]
) -> list[Callable[[Any], Any]]:
    """Return one function per check that maps a structured array to a mask of the messages that break it.

    `functions`: column versions of the functions that checks call; array columns are transposed. For the first check of
    FiniteWhile(z_valid="z"):

        lambda values: (values['z_valid'].T & ~isfinite(values['z'].T))
    """
    checks: list[Callable[[Any], Any]] = []
    for rule in rules:
        accessors = {name: f"values[{name!r}].T" for name in rule.fields}
        for check in rule.checks:
            text = check.wrong.format_map(accessors)
            for word, operator in _COLUMN_OPERATORS.items():
                text = text.replace(word, operator)
            checks.append(compile_lambda(f"lambda values: {text}", **functions))
    return checks


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
        packed = struct.pack("<f", value)
    except OverflowError:
        return math.copysign(math.inf, value)
    rounded: float = struct.unpack("<f", packed)[0]
    return rounded


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
