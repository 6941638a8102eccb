"""PX4's field types as annotations for Pydantic."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal

from pydantic import Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

TypeName = Literal["uint64", "uint8", "bool", "float32", "float32[2]", "float64"]

NAN: Final = math.nan


class Px4Type:
    """Mark a field with PX4's name of its type; floats also read "NaN" and "Infinity" in JSON."""

    def __init__(self, name: TypeName) -> None:
        self.name = name

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        schema = handler(source)
        if schema["type"] != "float":
            return schema
        names = core_schema.literal_schema(["NaN", "Infinity", "-Infinity"])
        from_name = core_schema.no_info_after_validator_function(float, names)
        return core_schema.json_or_python_schema(
            json_schema=core_schema.union_schema([schema, from_name]), python_schema=schema
        )


Uint64 = Annotated[int, Field(ge=0, le=2**64 - 1), Px4Type("uint64")]
Uint8 = Annotated[int, Field(ge=0, le=2**8 - 1), Px4Type("uint8")]
Bool = Annotated[bool, Px4Type("bool")]
Float64 = Annotated[float, Px4Type("float64")]
Float32 = Annotated[float, Px4Type("float32")]
Float32x2 = Annotated[tuple[Float32, Float32], Px4Type("float32[2]")]


def type_name(annotation: Any) -> TypeName:
    """Return PX4's name of one of these types."""
    return next(mark.name for mark in reversed(annotation.__metadata__) if isinstance(mark, Px4Type))


TYPES: Final[Mapping[TypeName, Any]] = {
    type_name(each): each for each in (Uint64, Uint8, Bool, Float32, Float32x2, Float64)
}
"""The annotation of each type, by PX4's name of it."""
