"""PX4's logged strings and events as `log_message` messages, without duplicates.

The event metadata of a log, which is untrusted, defines the sentence for an event's id and arguments.
Its format: https://github.com/mavlink/libevents
"""

import json
import lzma
import re
import struct
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from itertools import islice
from typing import Any, Final, NamedTuple

from nedbus_msgs import field_type

from .layout import BASIC_TYPES, PayloadField, PayloadLayout
from .records import Data, Information, LoggedText, Record, Subscription

_STRUCT: Final = struct.Struct("<QB127s")
_FIELDS: Final = (("timestamp", "uint64", 0), ("severity", "uint8", 8), ("text", "char[127]", 9))
_LAYOUT: Final = PayloadLayout(
    tuple(PayloadField(a, field_type(b), c) for a, b, c in _FIELDS), _STRUCT.size, 0
)
LOG_MESSAGE: Final = Subscription(-1, 0, "log_message", _LAYOUT)
"""Subscription of the messages that `LogMessageBuilder` generates."""

_INFO: Final = 6
_PROTOCOL: Final = 8  # lowest log level of events meant for ground stations, not for display
_ALL_MODES: Final = 2**32 - 1
_WINDOW: Final = 50_000  # us between an event and its logged string; up to 4 ms were observed
_MAX_PER_SECOND: Final = 100  # messages; PX4 logs 20 at boot
_SECOND: Final = 1_000_000  # us
_MAX_RETURNS: Final = 10  # to an earlier time, in one log or stream
_MAX_BYTES: Final = 127
_MAX_CHARACTERS: Final = 1000  # characters read, including colour codes
_COLOUR = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")
_PREFIX = re.compile(r"\[[\w-]+\] |preflight(?: fail)?: ", re.IGNORECASE)
_MAX_PACKED: Final = 2**18  # bytes; PX4's take 17,000
_MAX_UNPACKED: Final = 2**21  # bytes; PX4's take 170,000
_MAX_MEMORY: Final = 2**27  # bytes for the xz dictionary
# components, event groups, enums, mode groups, and modes per group; PX4 has 30
_MAX_PARTS: Final = 64
_MAX_EVENTS: Final = 5000  # of all components; PX4 has 400
_TOO_MANY_ARGUMENTS: Final = 26  # of an event, which has 25 bytes for them; PX4's have up to 6
_MAX_SEPARATOR: Final = 10  # characters between the names of a bit field
# characters of a template, or of an argument; PX4's longest template has 120
_MAX_TEXT: Final = 200
_CHECKS: Final = ("arming_check", "health")
_MARKUP = re.compile(
    r"\\(?P<escaped>.)"
    r'|<(?P<tag>[a-z]+)(?: [a-z]+="(?P<value>[^"]*)")?>(?P<content>.*?)</(?P=tag)>'
    r"|\{(?P<number>\d{1,2})(?::(?:\.(?P<digits>\d))?)?(?P<unit>m_v|m/s|m\^2|m|C)?\}",
    re.DOTALL,
)
_DAMAGED: Final = (
    LookupError,
    TypeError,
    ValueError,
    AttributeError,
    RecursionError,
    struct.error,
    lzma.LZMAError,
)


def to_log_text(text: str) -> str:
    """Return a string as one printable line of at most 127 bytes in UTF-8."""
    short = _COLOUR.sub("", text[:_MAX_CHARACTERS])
    plain = "".join(c if c.isprintable() else " " if c.isspace() else "" for c in short).strip()
    data = plain.encode()
    return (
        plain if len(data) <= _MAX_BYTES else data[: _MAX_BYTES - 3].decode(errors="ignore") + "..."
    )


class _Event(NamedTuple):
    """A decoded event.

    `modes`: bit mask of the navigation states for which a check fails; None for other events.
    `lists_checks_of`: bit mask of the navigation states whose failed checks are appended to the text.
    """

    group: str
    text: str
    modes: int | None
    lists_checks_of: int


class _ArgumentType(NamedTuple):
    """Type of an argument; `code`: struct format; `names`: of an enum; `separator`: of the names of a bit field."""

    code: str
    names: Mapping[str, str] | None = None
    separator: str | None = None

    def show(self, value: Any) -> Any:
        """Return a number as it is, and the name of an enum's value, or of each bit set."""
        if self.names is None:
            return value
        bits = (
            [value]
            if self.separator is None
            else [1 << bit for bit in range(64) if value >> bit & 1]
        )
        names = (self.names.get(str(each), f"(unknown: {value})") for each in bits)
        return (self.separator or "").join(names)[:_MAX_TEXT]


class _EventMetadata:
    """Valid event definitions of one firmware; raises ValueError if the metadata is damaged or oversized."""

    def __init__(self, packed: bytes) -> None:
        self._types = {name: _ArgumentType(kind.form) for name, kind in BASIC_TYPES.items()}
        self._decoders: dict[tuple[str, str], Callable[[bytes], _Event]] = {}  # by component and id
        try:
            xz = lzma.LZMADecompressor(memlimit=_MAX_MEMORY)
            unpacked = xz.decompress(packed, _MAX_UNPACKED)
            if not xz.eof:
                raise ValueError(f"incomplete, or more than {_MAX_UNPACKED} bytes")
            components: Mapping[str, Any] = json.loads(unpacked)["components"]
            groups = [each["event_groups"] for each in components.values()]
            enums = [each.get("enums", {}) for each in components.values()]
            if max(map(len, [components, *groups, *enums])) > _MAX_PARTS:
                raise ValueError(f"more than {_MAX_PARTS} components, event groups or enums")
            if (
                sum(len(part["events"]) for group in groups for part in group.values())
                > _MAX_EVENTS
            ):
                raise ValueError(f"more than {_MAX_EVENTS} events")
            for component, content in zip(components.values(), enums, strict=True):
                for name, enum in content.items():
                    self._add_enum(f"{component['namespace']}::{name}", enum)
            for number, component in components.items():
                states = _states(component)
                for group, part in component["event_groups"].items():
                    for key, event in part["events"].items():
                        with suppress(*_DAMAGED):
                            decoder = self._decoder(event, group, component["namespace"], states)
                            self._decoders.setdefault((number, key), decoder)
        except _DAMAGED as exc:
            reason = (
                str(exc) if isinstance(exc, ValueError | lzma.LZMAError) else "unexpected structure"
            )
            raise ValueError(f"the event metadata cannot be read ({reason})") from exc

    def decode(self, number: int, arguments: bytes) -> _Event | None:
        """Return the event with this id; None if the id is unknown, or the arguments do not match."""
        with suppress(*_DAMAGED):
            return self._decoders[str(number >> 24), str(number & 0xFFFFFF)](arguments)
        return None

    def _add_enum(self, name: str, enum: Mapping[str, Any]) -> None:
        with suppress(*_DAMAGED):
            names = {
                key: entry["description"][:_MAX_TEXT] for key, entry in enum["entries"].items()
            }
            separator = (
                enum.get("separator", "|")[:_MAX_SEPARATOR] if enum.get("is_bitfield") else None
            )
            self._types.setdefault(
                name, _ArgumentType(BASIC_TYPES[enum["type"]].form, names, separator)
            )

    def _decoder(
        self, event: Mapping[str, Any], group: str, namespace: str, states: Mapping[Any, int]
    ) -> Callable[[bytes], _Event]:
        """Return the function that decodes the arguments of an event."""
        names = [each["type"] for each in event.get("arguments", [])[:_TOO_MANY_ARGUMENTS]]
        types = [self._types.get(name) or self._types[f"{namespace}::{name}"] for name in names]
        unpack = struct.Struct("<" + "".join(each.code for each in types)).unpack_from
        masks = [
            index
            for index, name in enumerate(names)
            if "navigation_mode_group_t" in name and group in _CHECKS
        ]
        lists_checks = event.get("type") == "append_health_and_arming_messages"
        template = event["message"][:_MAX_TEXT]

        def decode(data: bytes) -> _Event:
            values = unpack(data)
            text = _fill(
                template, [each.show(value) for each, value in zip(types, values, strict=True)]
            )
            listed = states.get(values[0], 0) if lists_checks else 0
            return _Event(group, text, values[masks[0]] if masks else None, listed)

        return decode


def _states(component: Mapping[str, Any]) -> Mapping[int, int]:
    """Return the bit mask of the navigation state of each custom mode."""
    with suppress(*_DAMAGED):
        groups = component["navigation_mode_groups"]["groups"].items()
        return {
            mode: 1 << int(bit) % 32
            for bit, modes in islice(groups, _MAX_PARTS)
            for mode in modes[:_MAX_PARTS]
        }
    return {}


def _fill(template: str, values: Sequence[Any]) -> str:
    """Insert the arguments into a template, and remove its markup."""

    def replaced(found: re.Match[str]) -> str:
        if found["escaped"] or found["tag"]:
            # other profiles are for end users
            shows = {"profile": found["value"] == "dev", "a": True, "param": True}
            return found["escaped"] or (
                _fill(found["content"], values) if shows.get(found["tag"]) else ""
            )
        if not 0 < int(found["number"]) <= len(values):
            return found[0]
        value = values[int(found["number"]) - 1]
        text = (
            f"{value:.{found['digits']}f}"
            if found["digits"] and not isinstance(value, str)
            else str(value)
        )
        return f"{text} {found['unit'].removesuffix('_v')}" if found["unit"] else text

    return _MARKUP.sub(replaced, template).strip()


class RateLimit:
    """Limit of 100 messages per second; `omitted`: number of messages above it.

    Earlier messages count in the newest second, because a log with alternating times would otherwise have no limit. Up
    to ten times they show instead that the newest second was wild, or that the vehicle rebooted.
    """

    def __init__(self) -> None:
        self.omitted = self._begin = self._count = self._returns = 0
        self._before: tuple[int, int] | None = None  # begin and count of the second before

    def admits(self, time: int) -> bool:
        """Return whether a message at this time [us] is below the limit."""
        if time - self._begin >= _SECOND:
            self._before = self._begin, self._count
            self._begin, self._count = time, 0
        elif self._begin - time >= _SECOND and self._returns < _MAX_RETURNS:
            self._return_to(time)
        self._count += 1
        self.omitted += self._count > _MAX_PER_SECOND
        return self._count <= _MAX_PER_SECOND

    def _return_to(self, time: int) -> None:
        """Continue the second before the newest one; after a reboot, continue the count at an earlier time."""
        self._returns += 1
        if self._before is None:
            self._begin = time
        else:
            self._begin, self._count = self._before
            self._before = None
        if time - self._begin >= _SECOND:
            self._begin, self._count = time, 0


class LogMessageBuilder:
    """Add `log_message` messages to the records of a log or a stream.

    A logged string with a trailing tab repeats an event in more detail: whichever of the two comes second is dropped.
    PX4 reports all failed checks when one changes: only new ones become messages, with severity info if they do not
    affect the current mode.

    `problem`: why the event metadata is unusable; "" if it is usable.
    """

    TOPICS: Final = ("event", "vehicle_status")
    """The topics that it needs."""

    def __init__(self) -> None:
        self.limit = RateLimit()
        self.problem = ""
        self._packed = b""
        self._metadata: _EventMetadata | None = None
        # unmatched events: time, first words of a check
        self._events: deque[tuple[int, str]] = deque(maxlen=100)
        # unmatched texts: time, and what may match them
        self._texts: deque[tuple[Any, ...]] = deque(maxlen=100)
        self._seen: deque[tuple[object, ...]] = deque(maxlen=100)  # PX4 may log an event twice
        # checks in the current report: level, blocked modes
        self._failed: dict[str, tuple[int, int]] = {}
        self._earlier: dict[str, tuple[int, int]] = {}
        self._nav_state = -1

    def merge(self, records: Iterable[Record]) -> Iterator[Record]:
        """Yield the records, and each log message after the last record that it is derived from."""
        for record in records:
            name = record.subscription.name if isinstance(record, Data) else ""
            if name != LOG_MESSAGE.name:  # PX4 may also log the topic itself
                yield record
            if name and name not in self.TOPICS:
                continue
            # the topic may have other fields
            with suppress(LookupError, TypeError, ValueError, struct.error):
                if (text := self._read(record)) and self.limit.admits(text.timestamp):
                    yield Data(
                        LOG_MESSAGE,
                        _STRUCT.pack(text.timestamp, text.level, to_log_text(text.text).encode()),
                    )

    def _read(self, record: Record) -> LoggedText | None:
        """Return the text that a record completes; None if it completes none, or repeats an event."""
        if isinstance(record, LoggedText):
            return None if self._is_duplicate(record) else record
        if (
            isinstance(record, Information)
            and record.key == "metadata_events"
            and isinstance(record.value, bytes)
        ):
            if self._metadata is None and not self.problem:  # the first metadata is used
                self._packed = ((self._packed if record.continued else b"") + record.value)[
                    :_MAX_PACKED
                ]
        elif isinstance(record, Data) and record.subscription.name == "event":
            return self._read_event(record.subscription.layout.decode(record.payload))
        elif isinstance(record, Data) and record.subscription.name == "vehicle_status":
            self._nav_state = int(record.subscription.layout.decode(record.payload)["nav_state"])
        return None

    def _read_event(self, fields: dict[str, Any]) -> LoggedText | None:
        timestamp = fields["timestamp"]
        level = fields["log_levels"] >> 4
        key = (fields["id"], fields["event_sequence"])
        if (timestamp, *key) in self._seen or (
            event := self._decode(fields["id"], bytes(fields["arguments"]))
        ) is None:
            return None
        self._seen.append((timestamp, *key))
        is_check = event.group in _CHECKS
        if level >= _PROTOCOL and event.group == "arming_check":  # starts a new report
            self._failed, self._earlier = {}, self._failed
        if level >= _PROTOCOL or not (is_check or event.group == "default"):
            return None
        text = event.text
        if is_check:
            modes = _ALL_MODES if event.modes is None else event.modes
            affects_mode = modes == _ALL_MODES or (
                self._nav_state >= 0 and modes >> self._nav_state & 1
            )
            shown = level if affects_mode else max(level, _INFO)
            known = self._failed.get(text, self._earlier.get(text))
            if len(self._failed) < _MAX_PER_SECOND:
                self._failed[text] = shown, modes if level < _INFO else 0
            if known and known[0] <= shown:
                return None
            level = shown
        elif event.lists_checks_of and text.endswith(":"):
            text += " " + ", ".join(
                name for name, (_, modes) in self._failed.items() if modes & event.lists_checks_of
            )
        check = _first_words(text) if is_check else ""
        for time, *words in self._texts:
            if abs(timestamp - time) <= _WINDOW and check in words:
                self._texts.remove((time, *words))
                return None
        self._events.append((timestamp, check))
        return LoggedText(level, timestamp, text)

    def _decode(self, number: int, arguments: bytes) -> _Event | None:
        if self._metadata is None and self._packed and not self.problem:
            try:
                self._metadata = _EventMetadata(self._packed)
            except ValueError as exc:
                self.problem = str(exc)
        return self._metadata.decode(number, arguments) if self._metadata else None

    def _is_duplicate(self, record: LoggedText) -> bool:
        """Return whether an event has already reported this text; each event matches one text."""
        words = _first_words(record.text), "" if record.text.endswith("\t") else "-"
        for timestamp, check in self._events:
            if abs(timestamp - record.timestamp) <= _WINDOW and check in words:
                self._events.remove((timestamp, check))
                return True
        self._texts.append((record.timestamp, *words))
        return False


def _first_words(text: str) -> str:
    """Return the first two words, without the module name and PX4's prefix of failed checks."""
    return " ".join(_PREFIX.sub("", text).casefold().split()[:2])
