"""The definition of a message: fields and types, layouts, rules, validation; made from its file in `messages/`."""

from .declaration import Layout, Older, Topic
from .message import Message
from .px4_types import (
    Bool,
    Float32,
    Float32x2,
    Float32x3,
    Float32x4,
    Float32x14,
    Float64,
    Int8,
    Int32,
    Int64,
    Timestamp,
    Uint8,
    Uint16,
    Uint32,
    Uint64,
    field,
)
from .rules import FLOAT32_PI, FiniteWhile, InRange, NotLater, NotNegative, UnitQuaternion, Within

__all__ = [
    "FLOAT32_PI", "Bool", "FiniteWhile", "Float32", "Float32x2", "Float32x3", "Float32x4", "Float32x14", "Float64",
    "InRange", "Int8", "Int32", "Int64", "Layout", "Message", "NotLater", "NotNegative", "Older", "Timestamp", "Topic",
    "Uint8", "Uint16", "Uint32", "Uint64", "UnitQuaternion", "Within", "field",
]  # fmt: skip
