"""Validation and encoding of what sources receive: fields by name, or records of fixed size, such as those of a log."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple

from pydantic import ValidationError

from nedbus_msgs.model.definition import Definition, FlatRow, Row, upgrade_fields
from nedbus_msgs.model.px4_types import FieldType, decode_text, encode_text
from nedbus_msgs.model.rules import compile_lambda, expression_of, squared_norm
from nedbus_msgs.model.validation import Values, accessors_of, positions_of

from .msgpack import codec_of


class Encoded(NamedTuple):
    """A valid message; `provided`: the names of the fields that its source provides, `missing`: those of all others."""

    row: Row | FlatRow
    payload: bytes
    provided: frozenset[str]
    missing: frozenset[str]


def encode_upgraded(definition: Definition[Any], fields: Mapping[str, object]) -> Encoded:
    """Encode the fields of any PX4 release, as `upgrade_with` accepts them; raise InvalidMessageError."""
    plan = definition.plan(tuple(fields))
    codec = codec_of(definition)
    validation = definition.validation
    upgraded = upgrade_fields(definition, fields)
    values = validation.row_of(upgraded)
    if values is not None:
        with suppress(OverflowError):  # beyond float32
            payload = codec.encode_flat(validation.flatten(values))
            row = tuple.__new__(definition.row, values)
            return Encoded(row, payload, plan.provided, plan.missing)
    payload = codec.encode_fields(upgraded)  # the model decides
    return Encoded(codec.decode_row(payload), payload, plan.provided, plan.missing)


def record_encoder(
    definition: Definition[Any], types: Mapping[str, FieldType], unpack: Callable[[bytes], Values]
) -> Callable[[bytes], Encoded | None]:
    """Compile a function that encodes records with these fields, of any PX4 release, as messages of a definition.

    It applies the model's types and rules, and returns None for a record that it does not accept: pass the fields of
    this record to `encode_upgraded`, which decides and reports the reasons.
    `unpack`: return the values of a record; each element of an array is a value.
    """
    plan = definition.plan(tuple(types))
    encode_flat = codec_of(definition).encode_flat
    new = tuple.__new__  # needs half the time of a NamedTuple's constructor
    values_of = _compile(definition, types)
    provided = plan.provided
    missing = plan.missing
    row_class: type[Row | FlatRow] = definition.flat_row
    unflatten: Callable[[Values], Values] = tuple  # which returns a tuple itself
    if definition.has_text:
        row_class = definition.row
        unflatten = definition.validation.unflatten

    def encode(record: bytes) -> Encoded | None:
        try:
            values = values_of(record, unpack)
            if not values:
                return None
            payload = encode_flat(values)
        except (ValidationError, TypeError, OverflowError):  # a value does not fit its field
            return None
        row = new(row_class, unflatten(values))
        return new(Encoded, (row, payload, provided, missing))

    return encode


def _compile(
    definition: Definition[Any], types: Mapping[str, FieldType]
) -> Callable[[bytes, Callable[[bytes], Values]], Values | None]:
    """Compile a function from a record to the valid values of a message; false or an exception if it is not valid.

    For records with the fields and types of a VehicleAttitude, the source is, in one line:

        lambda record, unpack: (values := unpack(record)) and (values := values)
            and not ((values[1] > values[0]))
            and not (((values[2:6][0] == values[2:6][0])
                and (not (abs(squared_norm(values[2:6]) - 1.000001) <= 0.0019999999999998352))))
            and values

    Where a type differs, or a field is converted, the types are not proved: the second `values` is then
    `flatten(validate(unflatten(values)))`, with the tuple of a `_Conversion` in place of `values` if there is one.
    """
    plan = definition.plan(tuple(types))
    validation = definition.validation
    fields = definition.types
    is_copied_exactly = True
    for name, old in plan.names.items():
        given = types[old]
        wanted = fields[name]
        if (given.values, given.is_text) != (wanted.values, wanted.is_text):
            return _reject
        is_copied_exactly = is_copied_exactly and given == wanted
    if "timestamp" not in plan.provided:
        return _reject
    conversion = _Conversion(definition, types)
    functions: dict[str, Callable[..., Any]] = {
        "encode_text": encode_text,
        "decode_text": decode_text,
        "flatten": validation.flatten,
        "unflatten": validation.unflatten,
        "validate": validation.validate,
        **conversion.functions,
    }
    converted = conversion.text
    if plan.converted or not is_copied_exactly:
        converted = f"flatten(validate(unflatten({converted})))"
    else:  # the types of the record prove those of the message
        functions["squared_norm"] = squared_norm
    rules = expression_of(definition.rules, accessors_of(fields))
    steps = f"(values := unpack(record)) and (values := {converted}) and {rules} and values"
    return compile_lambda(f"lambda record, unpack: {steps}", **functions)


def _reject(record: bytes, unpack: Callable[[bytes], Values]) -> None:
    """Do not accept a record whose fields cannot be copied."""


class _Conversion:
    """The expression of a message's values in the flattened values of a record.

    `text`: "values" if they are the same, or else a tuple with a part for each run of values that are copied, and for
    each other field. For a VehicleLocalPosition from a record of PX4 1.15, which has dist_bottom before its flag:

        (*values[0:39], values[40], values[39], nan, nan, 0, *values[41:51], values[50],)

    `functions`: the functions that it calls to convert fields, by name.
    """

    def __init__(self, definition: Definition[Any], types: Mapping[str, FieldType]) -> None:
        self._plan = definition.plan(tuple(types))
        self._accessors = accessors_of(types)
        self.functions: dict[str, Callable[..., Any]] = {}
        positions = positions_of(types)
        parts: list[str] = []
        run: tuple[int, int] | None = (
            None  # begin and end of the copied values that are the last part
        )
        for name, kind in definition.types.items():
            old = self._plan.names.get(name)
            if old is None or kind.is_text:
                parts.append(self._part(name, kind))
                run = None
                continue
            position = positions[old]
            if isinstance(position, slice):
                begin = position.start
            else:
                begin = position
            end = begin + kind.values
            if run is not None and run[1] == begin:
                begin = run[0]
                parts.pop()
            run = begin, end
            if end - begin == 1:
                parts.append(f"values[{begin}]")
            else:
                parts.append(f"*values[{begin}:{end}]")
        count = sum(kind.values for kind in types.values())
        self.text = f"({', '.join(parts)},)"
        if parts == [f"*values[0:{count}]"]:
            self.text = "values"

    def _part(self, name: str, kind: FieldType) -> str:
        """Return the part of a field that is text, converted or absent, such as `*(nan, nan)`."""
        if name in self._plan.converted:
            value = self._call(name)
        elif name in self._plan.names:
            value = f"decode_text({self._accessors[self._plan.names[name]]})"
        else:
            value = repr(kind.absent)
        if kind.is_text:
            return f"encode_text({value})"
        if kind.is_array:
            return f"*{value}"
        return value

    def _call(self, name: str) -> str:
        """Return the call that converts a field, such as `convert0(values[3], nan)`; add its function."""
        conversion = self._plan.converted[name]
        function = f"convert{len(self.functions)}"
        self.functions[function] = conversion.convert
        arguments = ["nan" if old is None else self._accessors[old] for old in conversion.sources]
        return f"{function}({', '.join(arguments)})"
