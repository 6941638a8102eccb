"""Messages as lines of a terminal: columns under a heading, as many as have room."""

from __future__ import annotations

import math
import shutil
from collections.abc import Sequence
from itertools import zip_longest
from typing import Any, Final

from nedbus.client import Sample
from nedbus_msgs import ANY, TOPICS, Selection, get_topic

from .format import is_position, to_line, to_state, to_value
from .table import terminal_width

_SHARE: Final = 3  # of a line without columns: what its address gets at most
_GAP: Final = "  "
_STATE: Final = "STATE"
_LEAST_PAGE: Final = 10  # lines between two headings, on the lowest terminal
_HEAD, _TAIL = 3, 4  # characters that are kept of a topic at least
_DIGITS: Final = (3, 2)  # after the point, where there is room for them
_OPTIONAL: Final = 3  # columns at the right that a narrow terminal leaves out: velocity, heading, eph
# Characters of a value; a longer one widens its column.
_FIELD_WIDTHS: Final = {"uint64": 12, "int64": 12, "uint8": 3, "int8": 3, "bool": 5, "float32": 13, "float64": 18}
_OTHER_WIDTH: Final = 10


class Lines:
    """Format samples as lines; with a heading at first, once in each screenful, and when the columns change.

    What a terminal has no room for is left out in a fixed order: digits, eph, heading, velocity, and last the middle of
    the topic; position, doubts and loss never. Where stdout is no terminal, a line is complete and has no heading.
    """

    def __init__(self, selection: Selection) -> None:
        topics = TOPICS.values() if selection.topic == ANY else [get_topic(selection.topic)]
        self._stream = max(len(f"/{topic.name}{'/0' * (topic.instances is not False)}") for topic in topics)
        self._address = self._least_address = 0
        self._widths: dict[int, list[int]] = {digits: [] for digits in _DIGITS}
        self._state = self._page_state = 0  # characters of the longest state: for which there is room, of this page
        self._left = 0  # lines of this page
        self._layout: tuple[int, list[int]] | None = None

    def __call__(self, sample: Sample, fields: Sequence[str] = ()) -> str:
        """Return the line of a sample, after a heading if one is due."""
        width = terminal_width()
        if width is None:
            return to_line(sample, fields)
        address, state = str(sample.address), to_state(sample)
        if not fields and not is_position(sample.message):  # it has no columns: all that fits into a line
            self._left -= 1
            room = min(max(self._stream + len(sample.vehicle), len(address)), width // _SHARE)
            line = to_line(sample, address=f"{shorten_address(address, room):<{room}}")
            return line if len(line) <= width else f"{line[: width - 1]}…"
        cells = {digits: _cells(sample, fields, digits) for digits in _DIGITS}
        if not self._left:
            self._state, self._page_state = self._page_state, 0
        self._address = max(self._address, len(address), len(sample.vehicle) + self._stream)
        self._least_address = max(self._least_address, len(shorten_address(address, 0)))
        self._state = max(self._state, len(state), len(_STATE))
        self._page_state = max(self._page_state, len(state))
        for digits in _DIGITS:
            needed = (
                max(len(cell), len(head)) for cell, head in zip(cells[digits], _head(fields, digits), strict=True)
            )
            self._widths[digits] = [max(pair) for pair in zip_longest(self._widths[digits], needed, fillvalue=0)]
        layout = digits, widths = self._fit(width, 0 if fields else _OPTIONAL)
        line = _join(shorten_address(address, widths[0]), cells[digits], state, widths)
        self._left -= 1
        if layout == self._layout and self._left >= 0:
            return line
        self._layout = layout
        self._left = max(_LEAST_PAGE, shutil.get_terminal_size().lines - 1) - 2
        return f"{_join('VEHICLE/TOPIC'[: widths[0]], _head(fields, digits), _STATE, widths)}\n{line}"

    def _fit(self, width: int, optional: int) -> tuple[int, list[int]]:
        """Return the number of digits and the widths of the columns that fit, the address first."""
        most, least = _DIGITS
        count = len(self._widths[most])
        for digits, shown in ((most, count), *((least, count - left_out) for left_out in range(optional + 1))):
            widths = self._widths[digits][:shown]
            room = width - self._state - sum(widths) - len(_GAP) * (shown + 1)
            if room >= self._address:
                return digits, [self._address, *widths]
        return digits, [max(room, self._least_address), *widths]


def shorten_address(address: str, width: int) -> str:
    """Return an address without the middle of its topic that does not fit; the topics of positions stay different."""
    vehicle, _, topic = address.partition("/")
    room = max(_HEAD + 1 + _TAIL, width - len(vehicle) - 1)
    if len(topic) <= room:
        return address
    tail = _TAIL + (room - _HEAD - 1 - _TAIL) // 2
    return f"{vehicle}/{topic[: room - 1 - tail]}…{topic[-tail:]}"


def _join(address: str, cells: Sequence[str], state: str, widths: Sequence[int]) -> str:
    """Return the cells that have a width in their columns, and the state."""
    numbers = (f"{cell:>{width}}" for cell, width in zip(cells, widths[1:], strict=False))
    return _GAP.join([f"{address:<{widths[0]}}", *numbers, state])


def _cells(sample: Sample[Any], fields: Sequence[str], digits: int) -> list[str]:
    """Return the columns of a sample: time, then these fields, or position, velocity, heading and eph; NED, degrees."""
    message = sample.message
    time = f"{message.timestamp / 1e6:{digits + 6}.{digits}f}"
    if fields:
        return [time, *(f"{to_value(sample, name):>{_width_of(sample, name)}}" for name in fields)]
    position = " ".join(f"{value:{digits + 5}.{digits}f}" for value in (message.x, message.y, message.z))
    velocity = " ".join(f"{value:{digits + 4}.{digits}f}" for value in (message.vx, message.vy, message.vz))
    return [time, position, velocity, f"{math.degrees(message.heading):.1f}", f"{message.eph:.2f}"]


def _width_of(sample: Sample[Any], name: str) -> int:
    kind = sample.message.DEFINITION.types.get(name)
    return kind.count * (_FIELD_WIDTHS.get(kind.base, _OTHER_WIDTH) + 1) - 1 if kind else 1


def _head(fields: Sequence[str], digits: int) -> list[str]:
    if fields:
        return ["TIME s", *fields]
    position = " ".join(f"{name:>{digits + 5}}" for name in ("X m", "Y m", "Z m"))
    velocity = " ".join(f"{name:>{digits + 4}}" for name in ("VX m/s", "VY m/s", "VZ m/s"))
    return ["TIME s", position, velocity, "HDG deg", "EPH m"]
