"""A message as a named tuple: the same fields, the same checks, faster than a model."""

from __future__ import annotations

from collections import namedtuple
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, ClassVar

from .position import NAMES, VehicleLocalPosition

if TYPE_CHECKING:

    class Row(VehicleLocalPosition):
        """A message as a named tuple, with the fields of VehicleLocalPosition."""

        _fields: ClassVar[tuple[str, ...]]

        def _asdict(self) -> dict[str, Any]: ...

        @classmethod
        def _make(cls, iterable: Sequence[object]) -> Row: ...
else:
    Row = namedtuple("Row", NAMES, module=__name__)
    Row.__doc__ = "A message as a named tuple, with the fields of VehicleLocalPosition."
