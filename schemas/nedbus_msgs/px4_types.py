"""PX4's types as Pydantic sees them."""

from __future__ import annotations

import math
import struct
from typing import Annotated, Final, Literal

from pydantic import Field, GetCoreSchemaHandler
from pydantic_core import CoreSchema, core_schema

TypeName = Literal["uint64", "uint8", "bool", "float32", "float32[2]", "float64"]

NAN: Final = math.nan
FLOAT32_MAX: Final = struct.unpack("<f", b"\xff\xff\x7f\x7f")[0]


class Px4Type:
    """Mark a field with PX4's name of its type; floats also read "NaN" and "Infinity" in JSON."""

    def __init__(self, name: TypeName) -> None:
        self.name = name

    def __get_pydantic_core_schema__(self, source: object, handler: GetCoreSchemaHandler) -> CoreSchema:
        schema = handler(source)
        if schema["type"] != "float":
            return schema
        words = core_schema.literal_schema(["NaN", "Infinity", "-Infinity"])
        spelled = core_schema.no_info_after_validator_function(float, words)
        return core_schema.json_or_python_schema(
            json_schema=core_schema.union_schema([schema, spelled]), python_schema=schema
        )


Uint64 = Annotated[int, Field(ge=0, le=2**64 - 1), Px4Type("uint64")]
Uint8 = Annotated[int, Field(ge=0, le=2**8 - 1), Px4Type("uint8")]
Bool = Annotated[bool, Px4Type("bool")]
Float64 = Annotated[float, Px4Type("float64")]
Float32 = Annotated[float, Px4Type("float32")]
Float32x2 = Annotated[tuple[Float32, Float32], Px4Type("float32[2]")]
