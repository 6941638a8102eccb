"""Validation and encoding of what sources receive: fields by name, or records of fixed size, such as those of a log."""

from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import Any, NamedTuple, cast

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
    if (values := validation.row_of(upgraded)) is not None:
        with suppress(OverflowError):  # beyond float32
            payload = codec.encode_flat(validation.flatten(values))
            return Encoded(
                tuple.__new__(definition.row, values), payload, plan.provided, plan.missing
            )
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
    new = tuple.__new__
    values_of = _compile(definition, types)
    provided = plan.provided
    missing = plan.missing
    row_class: type[Row | FlatRow] = definition.row if definition.has_text else definition.flat_row
    unflatten = definition.validation.unflatten if definition.has_text else None

    def encode(record: bytes) -> Encoded | None:
        try:
            if not (values := values_of(record, unpack)):
                return None
            payload = encode_flat(values)
        except (ValidationError, TypeError, OverflowError):  # a value does not fit its field
            return None
        row = new(row_class, values if unflatten is None else unflatten(values))
        return new(Encoded, (row, payload, provided, missing))

    return encode


def _compile(
    definition: Definition[Any], types: Mapping[str, FieldType]
) -> Callable[[bytes, Callable[[bytes], Values]], Values | None]:
    """Compile a function from a record to the valid values of a message; false or an exception if it is not valid."""
    plan = definition.plan(tuple(types))
    validation = definition.validation
    fields = definition.types
    copied = [(types[old], fields[name]) for name, old in plan.names.items()]
    if "timestamp" not in plan.provided or any(
        (a.values, a.is_text) != (b.values, b.is_text) for a, b in copied
    ):
        return lambda *_: None
    functions: dict[str, Callable[..., Any]] = {
        "encode_text": encode_text, "decode_text": decode_text,
        "flatten": validation.flatten, "unflatten": validation.unflatten, "validate": validation.validate,
    }  # fmt: skip
    text = _conversion(definition, types, functions)
    if plan.converted or any(a != b for a, b in copied):
        text = f"flatten(validate(unflatten({text})))"
    else:  # the types of the record prove those of the message
        functions["squared_norm"] = squared_norm
    rules = expression_of(definition.rules, accessors_of(fields))
    steps = f"(values := unpack(record)) and (values := {text}) and {rules} and values"
    return compile_lambda(f"lambda record, unpack: {steps}", **functions)


def _conversion(
    definition: Definition[Any],
    types: Mapping[str, FieldType],
    functions: dict[str, Callable[..., Any]],
) -> str:
    """Return the expression of a message's values in those of a record; add the functions that convert fields."""
    plan = definition.plan(tuple(types))
    positions = positions_of(types)
    accessors = accessors_of(types)
    # values[begin:end] is the last part, if it only copies values
    parts = list[str]()
    begin = 0
    end = -1
    for name, kind in definition.types.items():
        old, star = plan.names.get(name), "*" * kind.is_array
        if old is not None and not kind.is_text:
            start = cast("int", getattr(positions[old], "start", positions[old]))
            parts, begin = (parts[:-1], begin) if start == end else (parts, start)
            end = start + kind.values
            parts.append(f"*values[{begin}:{end}]" if end - begin > 1 else f"values[{begin}]")
            continue
        text, end = repr(kind.absent) if old is None else f"decode_text({accessors[old]})", -1
        if name in plan.converted:
            olds, functions[f"convert{len(functions)}"] = plan.converted[name]
            values = ", ".join("nan" if each is None else accessors[each] for each in olds)
            text = f"{[*functions][-1]}({values})"
        parts.append(f"encode_text({text})" if kind.is_text else star + text)
    is_same = parts == [f"*values[0:{sum(kind.values for kind in types.values())}]"]
    return "values" if is_same else f"({', '.join(parts)},)"
