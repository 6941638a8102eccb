"""Base class of all messages: a validated, immutable Pydantic model with PX4's fields."""

import operator
from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from typing import TYPE_CHECKING, Any, ClassVar, Final, Self, cast

from pydantic import (
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from .declaration import Layout, RenamedField, Topic
from .definition import Definition, M, register
from .px4_types import FieldType, Timestamp, decode_text, field_type
from .rules import Rule, violations

_FLOAT_NAMES: Final = frozenset({"NaN", "Infinity", "-Infinity"})


class Message(BaseModel):
    """A message of a vehicle; each subclass declares the fields of one PX4 message.

    Numbers in float32 fields are rounded to the nearest float32, like a C float, so a message is received bit for bit
    as it was created; numbers beyond the range of float32, such as 1e39, are rejected.
    An omitted field is "not provided": NaN, false or 0, and absent from `model_fields_set`.

    Raises pydantic.ValidationError, with field and reason, for a wrong type, an unknown field or a broken rule.
    """

    model_config = ConfigDict(
        frozen=True, strict=True, extra="forbid", ser_json_inf_nan="strings", defer_build=True, protected_namespaces=(),
        ignored_types=(int,),  # constants
    )  # fmt: skip
    TOPICS: ClassVar[Sequence[Topic]] = ()
    LAYOUTS: ClassVar[Sequence[Layout]] = ()
    OLDER: ClassVar[Sequence[RenamedField]] = ()
    RULES: ClassVar[Sequence[Rule]] = ()
    ALWAYS: ClassVar[str] = "timestamp"
    DEFINITION: ClassVar[Definition[Any]]

    timestamp: Timestamp = Field(
        description="Time since boot [us] (Unix time with uXRCE time sync and in some SITL logs)"
    )

    if not TYPE_CHECKING:

        def __init__(self, /, **fields: object) -> None:
            definition = self.DEFINITION
            validation = definition.validation
            # A subclass may have its own validators, which only Pydantic runs.
            values = None
            if type(self) is definition.model:
                values = validation.rounded(fields)
            if values is None:
                super().__init__(**fields)
            elif len(fields) == len(values):
                fill(self, values, definition.all_fields)
            else:
                fill(self, values, frozenset(fields))

        # Marks this constructor as Pydantic's own, so that validation of dicts and JSON bypasses it.
        __init__.__pydantic_base_init__ = True

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Define and register the message if this class declares topics."""
        super().__pydantic_init_subclass__(**kwargs)
        if "TOPICS" in vars(cls):
            cls.DEFINITION = Definition(cls)
            register(cls.DEFINITION)

    @model_validator(mode="wrap")
    @classmethod
    def _accept_equivalents(cls, fields: object, validate: ModelWrapValidatorHandler[Self]) -> Self:
        """Validate; if that fails, retry with NumPy and JSON values converted to Python types."""
        try:
            return validate(fields)
        except ValidationError:
            if not isinstance(fields, dict):
                raise
            types = cls.DEFINITION.types
            converted = {name: _to_python(value, types.get(name)) for name, value in fields.items()}
            if all(map(operator.is_, converted.values(), fields.values())):
                raise
        return validate(converted)

    @model_validator(mode="after")
    def _round_and_check(self) -> Self:
        """Round float32 fields, then check the rules."""
        values = self.__dict__
        validation = self.DEFINITION.validation
        row = validation.values_of(values)
        try:
            values.update(validation.rounded_by_name(row))
        except OverflowError:
            raise self._error(validation.overflows(values)) from None
        if not validation.passes_rules(row):
            broken = list(violations(self.DEFINITION.rules, values))
            if broken:
                raise self._error(broken)
        return self

    def __eq__(self, other: object) -> bool:
        """Compare all fields; NaN equals NaN."""
        if not isinstance(other, Message) or other.DEFINITION is not self.DEFINITION:
            return NotImplemented
        return all(map(_is_same, self.__dict__.values(), other.__dict__.values()))

    def __hash__(self) -> int:
        return hash((self.timestamp, self.__dict__.get("timestamp_sample")))

    def model_copy(self, *, update: Mapping[str, object] | None = None, deep: bool = False) -> Self:
        """Return a copy; unlike with Pydantic's own method, updates are validated."""
        if not update:
            return super().model_copy(deep=deep)
        given = {name: self.__dict__[name] for name in self.model_fields_set}
        return type(self).model_validate({**given, **update})

    def _error(self, broken: Iterable[tuple[str, str]]) -> ValidationError:
        """Create an error with one entry per field, like Pydantic's own."""
        details = list[InitErrorDetails]()
        for name, reason in broken:
            error = PydanticCustomError("px4_rule", "{reason}", {"reason": reason})
            details.append({"type": error, "loc": (name,), "input": self.__dict__[name]})
        return ValidationError.from_exception_data(self.DEFINITION.name, details)


def _is_same(one: object, other: object) -> bool:
    if isinstance(one, tuple) and isinstance(other, tuple):
        return all(map(_is_same, one, other))
    is_nan = repr(one) == repr(other) == "nan"
    return one == other or is_nan


def _to_python(value: Any, kind: FieldType | None) -> object:
    """Convert a NumPy scalar or array, a list, a char array, or a float as text, such as "NaN", to a Python value.

    Anything else is returned unchanged, for the model to reject.
    """
    if type(value).__module__ == "numpy":
        value = value.tolist()
    if kind is None:
        return value
    if kind.is_text and isinstance(value, bytes):
        return decode_text(value)
    if kind.is_array and isinstance(value, list | tuple):
        elements = tuple(_to_python(element, field_type(kind.base)) for element in value)
        is_unchanged = isinstance(value, tuple) and all(map(operator.is_, elements, value))
        if is_unchanged:
            return value
        return elements
    if kind.is_float and isinstance(value, str) and value in _FLOAT_NAMES:
        return float(value)
    return value


def fill(message: M, values: dict[str, object], given: Set[str]) -> M:
    """Set the fields of a new message to valid, rounded values, without validating them; return the message."""
    _set_dict(message, values)
    _set_fields_set(message, given)
    _set_extra(message, None)
    _set_private(message, None)
    return message


# The slots that Pydantic's own validator sets (since 2.12); set directly because models are frozen.
def _setter_of(slot: str) -> Callable[[Message, object], None]:
    return cast("Callable[[Message, object], None]", vars(BaseModel)[slot].__set__)


_set_dict = _setter_of("__dict__")
_set_fields_set = _setter_of("__pydantic_fields_set__")
_set_extra = _setter_of("__pydantic_extra__")
_set_private = _setter_of("__pydantic_private__")
