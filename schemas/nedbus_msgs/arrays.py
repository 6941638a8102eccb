"""Messages as NumPy arrays, as functions: of the first message unless another one is named.

Import this module only where arrays are used: NumPy takes longer to load than all the rest.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, cast

import numpy as np

from .codecs.arrays import Arrays, MessageArray, arrays_of
from .functions import DEFAULT, M, definition_of
from .model.message import Message

__all__ = [
    "DTYPE", "Arrays", "MessageArray", "arrays_of", "dtype_of", "to_array", "to_message",
]  # fmt: skip

DTYPE: Final = arrays_of(DEFAULT).dtype
"""The dtype of an array of VehicleLocalPosition: PX4's fields in PX4's order, with PX4's types."""


def dtype_of(message: type[Message] | str) -> np.dtype[Any]:
    """Return the dtype of an array of a message, given its class, its name or one of its topics."""
    return arrays_of(definition_of(message)).dtype


def to_array(messages: Sequence[M]) -> MessageArray:
    """Return messages of one class as a structured array."""
    return arrays_of(messages[0].DEFINITION if messages else DEFAULT).of(messages)


def to_message(element: np.void, message: type[M] = DEFAULT.model) -> M:  # type: ignore[assignment] # any, by default
    """Return one element as a message; raise pydantic.ValidationError if it is invalid."""
    return cast("M", arrays_of(definition_of(message)).to_message(element))
