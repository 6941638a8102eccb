"""Message definitions: fields, types, layouts, rules and validation, built from the classes in `messages/`."""

from .declaration import Layout, RenamedField, Topic
from .message import Message
from .rules import (
    FLOAT32_PI,
    LONGITUDE_LIMIT,
    FiniteWhile,
    InRange,
    NotLater,
    NotNegative,
    UnitQuaternion,
    Within,
)
