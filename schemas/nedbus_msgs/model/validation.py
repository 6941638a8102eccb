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

_LARGEST_FLOAT32: Final = struct.unpack("<f", b"\xff\xff\x7f\x7f")[0]

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
        self._types = types
        names = tuple(types)
        kinds = list(types.values())
        accessors = {name: f"values[{index}]" for index, name in enumerate(names)}
        passes = expression_of(rules, accessors)
        self.passes_rules = compile_lambda(f"lambda values: {passes}")
        self.values_of: Callable[[Any], Values] = lambda fields: (fields[names[0]],)
        if len(names) > 1:
            self.values_of = itemgetter(*names)
        self.by_name = _compile_by_name(types)
        self._defaults = {name: kind.absent for name, kind in types.items() if name != "timestamp"}
        # Not the model's schema: Pydantic takes 20 ms to build it for all messages, during which it swallows Ctrl-C.
        fields = [kind.core_schema(from_json=False) for kind in kinds]
        schema = core_schema.tuple_positional_schema(fields)
        self.validate = SchemaValidator(schema, CoreConfig(strict=True)).validate_python
        self._struct = struct.Struct("=" + "".join(kind.form for kind in kinds))
        self._flat = _flat_values(kinds)
        self.flatten: Callable[[Values], Values] = tuple
        self.unflatten: Callable[[Values], Values] = tuple
        if any(kind.length is not None for kind in kinds):
            restored = _restored_values(kinds)
            self.flatten = compile_lambda(f"lambda row: ({self._flat},)", encode_text=encode_text)
            self.unflatten = compile_lambda(f"lambda row: ({restored},)", decode_text=decode_text)

    @cached_property
    def rounded_by_name(self) -> ByName:
        """Return the same as `by_name`, rounded to float32; raise OverflowError beyond its range."""
        return _compile_rounded_by_name(self._types, self._flat, self._struct)

    def check_row(self, values: Values) -> Values | None:
        """Validate the values of all fields without rounding; return None to let the model decide."""
        try:
            row: Values = self.validate(values)
        except ValidationError:
            return None
        if self.passes_rules(row):
            return row
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
            values = self.values_of(fields)
        except KeyError:  # an unknown field in place of a missing one
            return None
        return self.check_row(values)

    def rounded(self, fields: Mapping[str, object]) -> dict[str, object] | None:
        """Validate named fields, and return the values of all fields, rounded to float32, as `row_of` does."""
        row = self.row_of(fields)
        if row is None:
            return None
        try:
            return self.rounded_by_name(row)
        except OverflowError:
            return None

    def unpack(self, packed: bytes) -> Values:
        """Unpack the values of all fields from bytes in native order, without padding."""
        return self.unflatten(self._struct.unpack(packed))

    def overflows(self, values: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
        """Yield the name and the reason for each number beyond the range of its float32 field."""
        for name, kind in self._types.items():
            if kind.base != "float32":
                continue
            if kind.is_array:
                numbers = values[name]
            else:
                numbers = (values[name],)
            for number in numbers:
                if math.isfinite(number) and abs(number) > _LARGEST_FLOAT32:
                    yield name, f"is beyond the range of float32 (+-{_LARGEST_FLOAT32:.9g})"


def _compile_by_name(types: Mapping[str, FieldType]) -> ByName:
    """Compile a function that assigns the values of a row to the items of a copied dict.

    This takes half the time of `dict.update`. For two fields, the source is:

        def by_name(row):
         values = copy()
         values['timestamp'], values['q'], = row
         return values
    """
    targets = [f"values[{name!r}]" for name in types]
    return _compile_assignment(types, targets, "row", [])


def _compile_rounded_by_name(
    types: Mapping[str, FieldType], flat: str, packed: struct.Struct
) -> ByName:
    """Compile a function that rounds the values of a row, and assigns them to the items of a copied dict.

    `flat`: the expression of the flattened values. For a time, a float32[2] and a text, the source is:

        def by_name(row):
         values = copy()
         values['t'], part1_0, part1_1, values['s'], = unpack(pack(*row[0:1], *row[1], encode_text(row[2]), *row[3:]))
         values['q'] = (part1_0, part1_1,)
         values['s'] = decode_text(values['s'])
         return values
    """
    targets: list[str] = []
    restored: list[str] = []
    for position, (name, kind) in enumerate(types.items()):
        item = f"values[{name!r}]"
        if kind.is_array:
            elements = [f"part{position}_{index}" for index in range(kind.values)]
            targets += elements
            restored.append(f" {item} = ({', '.join(elements)},)")
            continue
        targets.append(item)
        if kind.is_text:
            restored.append(f" {item} = decode_text({item})")
    source = f"unpack(pack({flat}))"
    return _compile_assignment(types, targets, source, restored, packed)


def _compile_assignment(
    types: Mapping[str, FieldType],
    targets: Sequence[str],
    source: str,
    restored: Sequence[str],
    packed: struct.Struct | None = None,
) -> ByName:
    lines = ["def by_name(row):", " values = copy()"]
    lines.append(f" {', '.join(targets)}, = {source}")
    lines.extend(restored)
    lines.append(" return values")
    namespace: dict[str, Any] = {
        "copy": dict.fromkeys(types).copy,
        "encode_text": encode_text,
        "decode_text": decode_text,
    }
    if packed is not None:
        namespace["pack"] = packed.pack
        namespace["unpack"] = packed.unpack
    exec(compile("\n".join(lines), "<fields>", "exec"), namespace)  # noqa: S102 - names are identifiers, quoted by repr
    by_name: ByName = namespace["by_name"]
    return by_name


def positions_of(types: Mapping[str, FieldType]) -> dict[str, int | slice]:
    """Return the position of each field in flattened values, of which each element of an array is one."""
    positions: dict[str, int | slice] = {}
    count = 0
    for name, kind in types.items():
        if kind.is_array:
            positions[name] = slice(count, count + kind.values)
        else:
            positions[name] = count
        count += kind.values
    return positions


def accessors_of(types: Mapping[str, FieldType]) -> dict[str, str]:
    """Return an expression for each field of flattened values, such as `values[3]` or `values[4:8]`."""
    accessors: dict[str, str] = {}
    for name, position in positions_of(types).items():
        if isinstance(position, slice):
            accessors[name] = f"values[{position.start}:{position.stop}]"
        else:
            accessors[name] = f"values[{position}]"
    return accessors


def _flat_values(kinds: Sequence[FieldType]) -> str:
    """Return the expression of the flattened values of `row`, which has fields of these types.

    For two times, a quaternion and a text: `*row[0:2], *row[2], encode_text(row[3]), *row[4:]`.
    """
    parts: list[str] = []
    begin = 0  # of the single values after the last array or text
    for position, kind in enumerate(kinds):
        if kind.length is None:
            continue
        if begin < position:
            parts.append(f"*row[{begin}:{position}]")
        value = f"row[{position}]"
        if kind.is_text:
            parts.append(f"encode_text({value})")
        else:
            parts.append(f"*{value}")
        begin = position + 1
    parts.append(f"*row[{begin}:]")
    return ", ".join(parts)


def _restored_values(kinds: Sequence[FieldType]) -> str:
    """Return the expression of the values of fields of these types, of which `row` has the flattened ones.

    For two times, a quaternion and a text: `*row[0:2], row[2:6], decode_text(row[6]), *row[7:]`.
    """
    parts: list[str] = []
    begin = 0  # of the single values after the last array or text
    position = 0
    for kind in kinds:
        end = position + kind.values
        if kind.length is not None:
            if begin < position:
                parts.append(f"*row[{begin}:{position}]")
            restored = f"row[{position}:{end}]"
            if kind.is_text:
                restored = f"decode_text(row[{position}])"
            parts.append(restored)
            begin = end
        position = end
    parts.append(f"*row[{begin}:]")
    return ", ".join(parts)
