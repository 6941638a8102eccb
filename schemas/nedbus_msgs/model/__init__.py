"""The definition of a message, built from its file in `messages/`: fields, types, layouts, rules and validation."""

from .declaration import Layout, Older, Topic
from .message import Message
from .rules import FLOAT32_PI, FiniteWhile, InRange, NotLater, NotNegative, UnitQuaternion, Within
