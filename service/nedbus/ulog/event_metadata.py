"""The metadata of PX4's events, which a log contains: they make a sentence of an event's number and arguments.

Format: https://github.com/mavlink/libevents. Everything in them may be hostile.
"""

import json
import lzma
import re
import struct
from collections.abc import Mapping, Sequence
from itertools import islice
from typing import Any, Final, NamedTuple

MAX_PACKED: Final = 2**18  # bytes; PX4's have 17,000
_MAX_UNPACKED: Final = 2**21  # bytes; PX4's have 170,000
_MAX_MEMORY: Final = 2**27  # bytes for the dictionary of xz
_MAX_PARTS: Final = 64  # components, groups of events or modes, and modes of a group; PX4 has 30
_MAX_TEXT: Final = 200  # characters of a template, and of one argument; PX4's longest template has 120
_TYPES: Final = {
    "int8_t": "<b", "uint8_t": "<B", "int16_t": "<h", "uint16_t": "<H", "int32_t": "<i", "uint32_t": "<I",
    "int64_t": "<q", "uint64_t": "<Q", "float": "<f",
}  # fmt: skip
_CHECKS: Final = ("arming_check", "health")
_MARK = re.compile(
    r"\\(?P<escaped>.)"
    r'|<(?P<tag>[a-z]+)(?: [a-z]+="(?P<value>[^"]*)")?>(?P<content>.*?)</(?P=tag)>'
    r"|\{(?P<number>\d{1,2})(?::(?:\.(?P<digits>\d))?)?(?P<unit>m_v|m/s|m\^2|m|C)?\}",
    re.DOTALL,
)
_DAMAGED: Final = (LookupError, TypeError, ValueError, AttributeError, RecursionError, struct.error, lzma.LZMAError)


class Event(NamedTuple):
    """An event as a sentence.

    `modes`: navigation states for which a check fails, as bits; None for any other event.
    `lists_checks_of`: the navigation states whose failed checks belong behind the text, as bits.
    """

    group: str
    text: str
    modes: int | None
    lists_checks_of: int


class EventMetadata:
    """The events of one firmware; raises ValueError for metadata that are damaged, or larger than any of PX4's."""

    def __init__(self, packed: bytes) -> None:
        try:
            xz = lzma.LZMADecompressor(memlimit=_MAX_MEMORY)
            unpacked = xz.decompress(packed, _MAX_UNPACKED)
            if not xz.eof:
                raise ValueError(f"incomplete, or more than {_MAX_UNPACKED} bytes")
            self._components: Mapping[str, Any] = json.loads(unpacked)["components"]
            parts = [self._components, *(each["event_groups"] for each in self._components.values())]
            if max(map(len, parts)) > _MAX_PARTS:
                raise ValueError(f"more than {_MAX_PARTS} components, or groups of events")
        except _DAMAGED as exc:
            raise ValueError(f"the metadata of events cannot be read: {str(exc) or type(exc).__name__}") from exc

    def decode(self, number: int, arguments: bytes) -> Event | None:
        """Return the event with this id; None if it is unknown, or does not fit its arguments."""
        try:
            component, key = self._components[str(number >> 24)], str(number & 0xFFFFFF)
            group = next(name for name, each in component["event_groups"].items() if key in each["events"])
            event = component["event_groups"][group]["events"][key]
            types = [each["type"] for each in event.get("arguments", ())]
            values, shown = self._read(types, component["namespace"], arguments)
            masks = [value for name, value in zip(types, values, strict=True) if "navigation_mode_group_t" in name]
            modes = masks[0] if masks and group in _CHECKS else None
            listed = 0
            if event.get("type") == "append_health_and_arming_messages":
                of_modes = islice(component["navigation_mode_groups"]["groups"].items(), _MAX_PARTS)
                listed = next((1 << int(bit) % 32 for bit, custom in of_modes if values[0] in custom[:_MAX_PARTS]), 0)
            return Event(group, _fill(event["message"][:_MAX_TEXT], shown), modes, listed)
        except (StopIteration, *_DAMAGED):
            return None

    def _read(self, types: Sequence[str], namespace: str, data: bytes) -> tuple[list[Any], list[Any]]:
        """Return the arguments as numbers, and as they are shown."""
        values: list[Any] = []
        shown: list[Any] = []
        offset = 0
        for name in types:
            space, _, base = name.rpartition("::")
            parts = (part for part in self._components.values() if part["namespace"] == (space or namespace))
            enum = None if name in _TYPES else next(parts)["enums"][base]
            code = _TYPES[enum["type"] if enum else name]
            values += struct.unpack_from(code, data, offset)
            offset += struct.calcsize(code)
            shown.append(_describe(enum, values[-1]) if enum else values[-1])
        return values, shown


def _describe(enum: Mapping[str, Any], value: int) -> str:
    """Return the names of a value of an enumeration, or of its bits."""
    bits = [1 << bit for bit in range(64) if value >> bit & 1] if enum.get("is_bitfield") else [value]
    entries = enum["entries"]
    names = (entries[str(each)]["description"] if str(each) in entries else f"(unknown: {value})" for each in bits)
    return str(enum.get("separator", "|")).join(names)[:_MAX_TEXT]


def _fill(template: str, values: Sequence[Any]) -> str:
    """Return a text with its arguments, without marks."""

    def replaced(found: re.Match[str]) -> str:
        if found["escaped"] or found["tag"]:
            shows = {"profile": found["value"] == "dev", "a": True, "param": True}  # other profiles are of end users
            return found["escaped"] or (_fill(found["content"], values) if shows.get(found["tag"]) else "")
        if not 0 < int(found["number"]) <= len(values):
            return found[0]
        value = values[int(found["number"]) - 1]
        text = f"{value:.{found['digits']}f}" if found["digits"] and not isinstance(value, str) else str(value)
        return f"{text} {found['unit'].removesuffix('_v')}" if found["unit"] else text

    return _MARK.sub(replaced, template).strip()
