"""Fast path of validation: checks all fields of a message as one tuple, in a fifth of the model's time.

It applies the model's types and rules, and accepts nothing that the model rejects.
Whatever it does not accept is passed to the model, which decides and reports the reasons.
"""

import math
import struct
from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property
from operator import itemgetter
from typing import Any, Final

from pydantic import ValidationError
from pydantic_core import CoreConfig, SchemaValidator, core_schema

from .px4_types import FieldType, decode_text, encode_text
from .rules import Rule, compile_lambda, expression_of

_FLOAT32_MAX: Final = struct.unpack("<f", b"\xff\xff\x7f\x7f")[0]

Values = tuple[object, ...]  # the values of all fields of a message, in order
ByName = Callable[[Values], dict[str, object]]


class Validation:
    """Validation of the fields of one message, and their rounding to float32.

    `passes_rules`: return whether the values of all fields, already of the right types, pass the rules.
    `by_name`: return the values of all fields by name.
    `values_of`: return the values of all fields in order from a mapping.
    `validate`: return the values of all fields; raise pydantic.ValidationError for a wrong type.
    `flatten`: expand arrays of a row in place and encode text, for struct to pack; `unflatten`: the reverse.
    """

    def __init__(self, types: Mapping[str, FieldType], rules: Sequence[Rule]) -> None:
        names, kinds = tuple(types), types.values()
        accessors = {name: f"values[{index}]" for index, name in enumerate(names)}
        self.passes_rules = compile_lambda(f"lambda values: {expression_of(rules, accessors)}")
        self.values_of: Callable[[Any], Values] = (
            itemgetter(*names) if len(names) > 1 else lambda fields: (fields[names[0]],)
        )
        self.by_name = _compile_by_name(types, "row")
        self._types = types
        self._defaults = {name: kind.absent for name, kind in types.items() if name != "timestamp"}
        # Not the model's schema: Pydantic takes 20 ms to build it for all messages, during which it swallows Ctrl-C.
        tuples = core_schema.tuple_positional_schema(
            [kind.core_schema(from_json=False) for kind in kinds]
        )
        self.validate = SchemaValidator(tuples, CoreConfig(strict=True)).validate_python
        self._struct = struct.Struct("=" + "".join(kind.form for kind in kinds))
        self._flat, nested = _flat_expressions(list(kinds))
        self.flatten: Callable[[Values], Values] = tuple
        self.unflatten: Callable[[Values], Values] = tuple
        if any(kind.length is not None for kind in kinds):
            self.flatten = compile_lambda(f"lambda row: ({self._flat},)", encode_text=encode_text)
            self.unflatten = compile_lambda(f"lambda row: ({nested},)", decode_text=decode_text)
        valid = (
            f"(values := validate(values)) and {expression_of(rules, accessors)} and values or None"
        )
        self._valid_row: Callable[[Values], Values | None] = compile_lambda(
            f"lambda values: {valid}", validate=self.validate
        )

    @cached_property
    def rounded_by_name(self) -> ByName:
        """Return the same as `by_name`, rounded to float32; raise OverflowError beyond its range."""
        functions: dict[str, Callable[..., Any]] = {
            "pack": self._struct.pack,
            "unpack": self._struct.unpack,
        }
        return _compile_by_name(self._types, f"unpack(pack({self._flat}))", **functions)

    def check_row(self, values: Values) -> Values | None:
        """Validate the values of all fields without rounding; return None to let the model decide."""
        try:
            return self._valid_row(values)
        except ValidationError:
            return None

    def row_of(self, fields: Mapping[str, object]) -> Values | None:
        """Validate named fields, and return the values of all fields in order, as `check_row` does.

        Omitted fields except `timestamp` get their defaults.
        """
        if len(fields) < len(self._types):
            fields = {**self._defaults, **fields}
        if len(fields) != len(self._types):
            return None
        try:
            return self._valid_row(self.values_of(fields))
        except (ValidationError, KeyError):  # KeyError: an unknown field in place of a missing one
            return None

    def unpack(self, packed: bytes) -> Values:
        """Unpack the values of all fields from bytes in native order, without padding."""
        return self.unflatten(self._struct.unpack(packed))

    def overflows(self, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield the name and the reason for each number beyond the range of its float32 field."""
        for name, kind in self._types.items():
            for number in (
                (values[name] if kind.is_array else (values[name],))
                if kind.base == "float32"
                else ()
            ):
                if math.isfinite(number) and abs(number) > _FLOAT32_MAX:
                    yield name, f"is beyond the range of float32 (+-{_FLOAT32_MAX:.9g})"


def _compile_by_name(
    types: Mapping[str, FieldType], source: str, **functions: Callable[..., Any]
) -> ByName:
    """Return a function that assigns the values of `source`, an expression, to the items of a copied dict.

    This takes half the time of `dict.update`. With `functions`, for the source, its values are flattened.
    """
    targets, arrays = list[str](), list[str]()
    for position, (name, kind) in enumerate(types.items()):
        item = f"values[{name!r}]"
        parts = (
            [f"part{position}_{index}" for index in range(kind.values)]
            if functions and kind.is_array
            else [item]
        )
        targets += parts
        if functions and kind.length is not None:
            arrays.append(
                f" {item} = "
                + (f"decode_text({item})" if kind.is_text else f"({', '.join(parts)},)")
            )
    lines = [
        "def by_name(row):",
        " values = copy()",
        f" {', '.join(targets)}, = {source}",
        *arrays,
        " return values",
    ]
    texts = {"encode_text": encode_text, "decode_text": decode_text}
    namespace: dict[str, Any] = {"copy": dict.fromkeys(types).copy, **texts, **functions}
    exec(compile("\n".join(lines), "<fields>", "exec"), namespace)  # noqa: S102 - names are identifiers, quoted by repr
    by_name: ByName = namespace["by_name"]
    return by_name


def positions_of(types: Mapping[str, FieldType]) -> dict[str, int | slice]:
    """Return the position of each field in flattened values, of which each element of an array is one."""
    positions, count = dict[str, int | slice](), 0
    for name, kind in types.items():
        positions[name] = slice(count, count + kind.values) if kind.is_array else count
        count += kind.values
    return positions


def accessors_of(types: Mapping[str, FieldType]) -> dict[str, str]:
    """Return an expression for each field of flattened values."""
    found = positions_of(types).items()
    return {
        name: f"values[{at}]" if isinstance(at, int) else f"values[{at.start}:{at.stop}]"
        for name, at in found
    }


def _flat_expressions(kinds: Sequence[FieldType]) -> tuple[str, str]:
    """Return expressions of the values of a flattened and of a restored `row` with fields of these types."""
    flat, nested = [], []
    index = flat_index = 0  # indices of the first value after the last array, in row and flat tuple
    for position, kind in enumerate(kinds):
        if kind.length is not None:
            start = flat_index + position - index
            one, back = f"*row[{position}]", f"row[{start}:{start + kind.values}]"
            if kind.is_text:
                one, back = f"encode_text(row[{position}])", f"decode_text(row[{start}])"
            flat += [f"*row[{index}:{position}]", one]
            nested += [f"*row[{flat_index}:{start}]", back]
            index, flat_index = position + 1, start + kind.values
    return ", ".join([*flat, f"*row[{index}:]"]), ", ".join([*nested, f"*row[{flat_index}:]"])
