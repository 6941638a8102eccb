"""Messages as structured NumPy arrays: decode, encode and validate in bulk.

Types, offsets and rules come from the same definition as for single messages.
Import this module only where arrays are used: NumPy takes longer to load than everything else.
"""

import struct
import sys
from collections.abc import Iterable, Sequence
from itertools import groupby
from typing import Any, Final, Generic

import numpy as np
import numpy.typing as npt

from .codecs.cdr import cdr_layout
from .codecs.msgpack import codec_of
from .definitions import DEFAULT, M, definition_of
from .errors import InvalidMessageError
from .frames import DERIVED, Functions, is_rotation
from .model.declaration import Layout, cached_on_owner
from .model.definition import MESSAGES, Definition
from .model.message import Message
from .model.px4_types import BASES, FieldType, encode_text
from .model.rules import column_checks, compile_lambda, expression_of, squared_norm
from .model.validation import Values, accessors_of

MessageArray = npt.NDArray[np.void]
"""A structured array: one element per message, one column per field, such as `array["x"]`."""

FEW_PAYLOADS: Final = 12
"""Number of payloads up to which `decode_few` is faster than `decode` in a reader that mostly waits."""

_COLUMNAR: Final = 20  # messages from which checking rules by column is faster than by message

_WINDOW: Final = 256  # bytes, the length of a table of bytes.translate


def _numpy_type(kind: FieldType) -> Any:
    if kind.is_text:
        return np.dtype(f"S{kind.size}")
    code = BASES[kind.base].code
    return np.dtype((code, kind.length or ()))


class Arrays(Generic[M]):
    """Converter between the messages of one definition and structured arrays.

    `dtype`: the fields in model order, with PX4's types; text is UTF-8, such as `S127`.
    """

    def __init__(self, definition: Definition[M]) -> None:
        types = definition.types
        codec = codec_of(definition)
        size = codec.size
        self.definition = definition
        self.dtype = np.dtype([(name, _numpy_type(kind)) for name, kind in types.items()])
        self._codec = codec
        self._size = size
        self._from_wire = self._wire_offsets()
        self._windows = _windows_of(self._from_wire)
        self._to_wire = np.zeros(size, np.intp)
        self._to_wire[self._from_wire] = np.arange(self.dtype.itemsize)
        self._tags = np.frombuffer(codec.tags.to_bytes(size, "big"), np.uint8)
        self._tag_mask = np.frombuffer(codec.tag_mask.to_bytes(size, "big"), np.uint8)
        self._value_mask = ~self._tag_mask

        # A struct that unpacks only the fields with rules from an element, and an expression for each unpacked field.
        checked: dict[str, FieldType] = {}
        form = "="
        fields_of_rules = {name for rule in definition.rules for name in rule.fields}
        for name, kind in types.items():
            if name in fields_of_rules:
                checked[name] = kind
                form += kind.form
            else:
                form += f"{self.dtype[name].itemsize}x"
        self._checked = struct.Struct(form)
        rules = expression_of(definition.rules, accessors_of(checked))
        self._passes_rules = compile_lambda(f"lambda values: {rules}")
        self._column_checks = column_checks(
            definition.rules,
            isfinite=np.isfinite,
            any=np.logical_or.reduce,
            squared_norm=lambda quaternions: squared_norm(quaternions.astype(float)),
        )

    def _wire_offsets(self) -> npt.NDArray[np.intp]:
        """Return the payload offset of each byte of an element."""
        offsets: list[int] = []
        for name, _, first in self._codec.offsets:
            kind = self.definition.types[name]
            of_value = range(first, first + kind.size)
            if sys.byteorder == "little" and not kind.is_text:
                of_value = of_value[::-1]
            offsets.extend(of_value)
        return np.array(offsets, np.intp)

    def decode(self, payloads: bytes) -> tuple[MessageArray, npt.NDArray[np.bool_]]:
        """Decode concatenated full-width payloads; return the messages and a mask of the valid ones.

        A payload masked as invalid may still be valid: decode it with the codec to find out.
        """
        # The XOR turns correct tags into 0, and bools into 0 or 1.
        wire = np.frombuffer(payloads, np.uint8).reshape(-1, self._size) ^ self._tags
        wrong = wire & self._tag_mask
        is_damaged = np.count_nonzero(wrong) > 0
        if is_damaged:
            wire &= self._value_mask
        array = np.ndarray(len(wire), self.dtype, wire.take(self._from_wire, axis=1))
        valid = self.valid_mask(array)
        if is_damaged:
            valid = valid & ~wrong.any(axis=1)
        return array, valid

    def decode_few(self, payloads: Iterable[bytes]) -> MessageArray | None:
        """Decode up to FEW_PAYLOADS payloads one by one; return None if one may be invalid."""
        size = self._size
        tags = self._codec.tags
        tag_mask = self._codec.tag_mask
        elements = bytearray()
        for payload in payloads:
            if len(payload) != size:
                return None
            number = int.from_bytes(payload, "big")
            if number & tag_mask != tags:
                return None
            wire = (number ^ tags).to_bytes(size, "big")
            # `translate` maps each offset to the byte of the window at this offset.
            parts = [
                offsets.translate(wire[start : start + _WINDOW].ljust(_WINDOW))
                for start, offsets in self._windows
            ]
            element = b"".join(parts)
            if not self._passes_rules(self._checked.unpack(element)):
                return None
            elements += element
        return np.frombuffer(elements, self.dtype)

    def encode(self, array: MessageArray) -> bytes:
        """Encode messages as concatenated payloads, without validating them."""
        native = np.frombuffer(array.tobytes(), np.uint8).reshape(-1, self.dtype.itemsize)
        wire = native.take(self._to_wire, axis=1)
        wire &= self._value_mask  # in place: two more arrays would take half of the time
        wire |= self._tags
        return wire.tobytes()

    def valid_mask(self, array: MessageArray) -> npt.NDArray[np.bool_]:
        """Return a mask of the messages that pass the rules."""
        if len(array) < _COLUMNAR:
            rows = self._checked.iter_unpack(array.tobytes())
            return np.fromiter(map(self._passes_rules, rows), np.bool_, len(array))
        invalid = np.zeros(len(array), np.bool_)
        for is_wrong in self._column_checks:
            invalid |= is_wrong(array)
        return ~invalid

    def require_valid(self, array: MessageArray) -> None:
        """Raise InvalidMessageError with the index of the first message that breaks a rule."""
        for index in np.flatnonzero(~self.valid_mask(array)).tolist():
            try:
                self._codec.encode_row(self.to_row(array[index]))
            except InvalidMessageError as exc:
                raise InvalidMessageError(
                    exc.reason, exc.violations, message=self.definition.name, index=index
                ) from exc

    def of(self, messages: Sequence[M]) -> MessageArray:
        """Convert messages to a structured array."""
        elements = [self.to_element(tuple(message.__dict__.values())) for message in messages]
        return np.array(elements, self.dtype)

    def absent(self, count: int) -> MessageArray:
        """Return `count` messages with every field "not provided": NaN, false or 0."""
        values = tuple(kind.absent for kind in self.definition.types.values())
        return np.full(count, np.array(values, self.dtype))

    def to_row(self, element: np.void) -> Values:
        """Return the values of one element in PX4's order, arrays as tuples."""
        return self.definition.validation.unpack(element.tobytes())

    def to_element(self, row: Values) -> Values:
        """Convert a row for assignment to an array: text becomes UTF-8, because NumPy rejects non-ASCII strings."""
        if not self.definition.has_text:
            return row
        return tuple(encode_text(value) if isinstance(value, str) else value for value in row)

    def to_message(self, element: np.void) -> M:
        """Return one element as a message; raise pydantic.ValidationError if it is invalid."""
        fields: dict[str, Any] = self.definition.validation.by_name(self.to_row(element))
        return self.definition.model(**fields)

    def encode_cdr(self, array: MessageArray, layout: Layout) -> npt.NDArray[np.void]:
        """Encode messages as CDR payloads without validating them; the model must have all fields of the layout."""
        cdr = cdr_layout(layout)
        names = list(layout.types)
        formats = [_numpy_type(kind).newbyteorder("<") for kind in layout.types.values()]
        offsets = [cdr.offsets[name] for name in names]
        dtype = np.dtype(
            {"names": names, "formats": formats, "offsets": offsets, "itemsize": cdr.size}
        )
        payloads = np.frombuffer(bytearray(cdr.zeros * len(array)), dtype)
        for name in layout.types:
            payloads[name] = array[name]
        return payloads


def _windows_of(wire_offsets: npt.NDArray[np.intp]) -> list[tuple[int, bytes]]:
    """Split payload offsets into runs within one window: the first byte of the window, and the offsets from there."""
    windows: list[tuple[int, bytes]] = []
    runs = groupby(wire_offsets.tolist(), lambda offset: offset - offset % _WINDOW)
    for start, offsets in runs:
        windows.append((start, bytes([offset - start for offset in offsets])))
    return windows


@cached_on_owner
def arrays_of(definition: Definition[M]) -> Arrays[M]:
    """Return the cached array converter of a definition."""
    return Arrays(definition)


DTYPE: Final = arrays_of(DEFAULT).dtype
"""The dtype of an array of VehicleLocalPosition: PX4's fields in PX4's order, with PX4's types."""


def dtype_of(message: type[Message] | str) -> np.dtype[Any]:
    """Return the dtype of an array of a message, given its class, its name or one of its topics."""
    return arrays_of(definition_of(message)).dtype


def to_array(messages: Sequence[M]) -> MessageArray:
    """Return messages of one class as a structured array."""
    if messages:
        definition = messages[0].DEFINITION
    else:
        definition = DEFAULT
    return arrays_of(definition).of(messages)


def to_message(element: np.void, message: type[M] = DEFAULT.model) -> M:  # type: ignore[assignment] # default of M
    """Return one element as a message; raise pydantic.ValidationError if it is invalid."""
    return arrays_of(definition_of(message)).to_message(element)


def mask_invalid(messages: MessageArray) -> MessageArray:
    """Return a copy with NaN in each field whose flag, such as `xy_valid`, is false or not provided."""
    masked = messages.copy()
    fields = messages.dtype.names or ()
    for definition in MESSAGES.values():
        for flag, guarded in definition.flags.items():
            if flag not in fields:
                continue
            for name in guarded:
                masked[name][~masked[flag]] = np.nan
    return masked


def derive_column(messages: MessageArray, name: str) -> npt.NDArray[np.float64]:
    """Return a quantity of `frames.DERIVED` of each message, shape (n,); NaN where it is invalid."""
    derived = DERIVED[name]
    values = [messages[field].astype(np.float64).T for field in derived.fields]
    if derived.flag:
        is_valid = messages[derived.flag]
    else:
        is_valid = is_rotation(values[0])
    functions = Functions(np.sqrt, np.arctan2)
    with np.errstate(invalid="ignore", over="ignore"):  # of invalid values, which are replaced
        computed = derived.compute(functions, *values)
        column: npt.NDArray[np.float64] = np.where(is_valid, computed, np.nan)
    return column
