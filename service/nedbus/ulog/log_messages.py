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
from typing import Any, Final, NamedTuple

from nedbus import limits
from nedbus_msgs import field_type

from .layout import BASIC_TYPES, PayloadField, PayloadLayout
from .records import Data, Information, LoggedText, Record, Subscription

_STRUCT: Final = struct.Struct("<QB127s")
_TEXT_BYTES: Final = 127  # of the field `text`
_LAYOUT: Final = PayloadLayout(
    (
        PayloadField("timestamp", field_type("uint64"), 0),
        PayloadField("severity", field_type("uint8"), 8),
        PayloadField("text", field_type("char[127]"), 9),
    ),
    _STRUCT.size,
    0,
)
LOG_MESSAGE: Final = Subscription(-1, 0, "log_message", _LAYOUT)
"""Subscription of the messages that `LogMessageBuilder` generates."""

_INFO: Final = 6
_PROTOCOL: Final = 8  # lowest log level of events meant for ground stations, not for display
_ALL_MODES: Final = 2**32 - 1
_WINDOW: Final = 50_000  # us between an event and its logged string; up to 4 ms were observed
_REMEMBERED: Final = 100  # events and texts that may still repeat each other
_SECOND: Final = 1_000_000  # us
_BELIEVED_RETURNS: Final = 10  # to an earlier time, in one log or stream
_CHECKS: Final = ("arming_check", "health")
_COLOUR = re.compile(r"\x1b\[[0-9;]*[A-Za-z]")
_PREFIX = re.compile(r"\[[\w-]+\] |preflight(?: fail)?: ", re.IGNORECASE)
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
    characters: list[str] = []
    for character in _COLOUR.sub("", text):
        if character.isprintable():
            characters.append(character)
        elif character.isspace():
            characters.append(" ")
    plain = "".join(characters).strip()
    data = plain.encode()
    if len(data) <= _TEXT_BYTES:
        return plain
    return data[: _TEXT_BYTES - 3].decode(errors="ignore") + "..."


class _Event(NamedTuple):
    """A decoded event.

    `modes`: bit mask of the navigation states for which a check fails; None for other events.
    `lists_checks_of`: bit mask of the navigation states whose failed checks are appended to the text.
    """

    group: str
    text: str
    modes: int | None
    lists_checks_of: int

    @property
    def is_check(self) -> bool:
        """Whether it reports a failed check."""
        return self.group in _CHECKS


class _ArgumentType(NamedTuple):
    """Type of an argument; `code`: struct format; `names`: of an enum; `separator`: of the names of a bit field."""

    code: str
    names: Mapping[str, str] | None = None
    separator: str | None = None

    def show(self, value: Any) -> Any:
        """Return a number as it is, and the name of an enum's value, or of each bit set."""
        if self.names is None:
            return value
        unknown = f"(unknown: {value})"
        if self.separator is None:
            return self.names.get(str(value), unknown)
        bits = [1 << bit for bit in range(64) if value >> bit & 1]
        names = [self.names.get(str(bit), unknown) for bit in bits]
        return _cut(self.separator.join(names))


def _cut(text: str) -> str:
    return text[: limits.PEER_TEXT]


class _EventMetadata:
    """Valid event definitions of one firmware; raises ValueError if the metadata is damaged or oversized."""

    def __init__(self, packed: bytes) -> None:
        self._types = {name: _ArgumentType(kind.form) for name, kind in BASIC_TYPES.items()}
        self._decoders: dict[tuple[str, str], Callable[[bytes], _Event]] = {}  # by component and id
        try:
            components = _unpack(packed)
            for component in components.values():
                for name, enum in component.get("enums", {}).items():
                    self._add_enum(f"{component['namespace']}::{name}", enum)
            for number, component in components.items():
                self._add_events(number, component)
        except (ValueError, lzma.LZMAError) as exc:
            raise ValueError(f"the event metadata cannot be read ({exc})") from exc
        except _DAMAGED as exc:
            reason = "unexpected structure"
            raise ValueError(f"the event metadata cannot be read ({reason})") from exc

    def decode(self, number: int, arguments: bytes) -> _Event | None:
        """Return the event with this id; None if the id is unknown, or the arguments do not match."""
        component = str(number >> 24)
        event = str(number & 0xFFFFFF)
        with suppress(*_DAMAGED):
            return self._decoders[component, event](arguments)
        return None

    def _add_enum(self, name: str, enum: Mapping[str, Any]) -> None:
        with suppress(*_DAMAGED):
            code = BASIC_TYPES[enum["type"]].form
            names = {key: _cut(entry["description"]) for key, entry in enum["entries"].items()}
            separator = None
            if enum.get("is_bitfield"):
                separator = _cut(enum.get("separator", "|"))
            self._types.setdefault(name, _ArgumentType(code, names, separator))

    def _add_events(self, number: str, component: Mapping[str, Any]) -> None:
        states = _states(component)
        for group, part in component["event_groups"].items():
            for key, event in part["events"].items():
                with suppress(*_DAMAGED):
                    decoder = self._decoder(event, group, component["namespace"], states)
                    self._decoders.setdefault((number, key), decoder)

    def _decoder(
        self, event: Mapping[str, Any], group: str, namespace: str, states: Mapping[Any, int]
    ) -> Callable[[bytes], _Event]:
        """Return the function that decodes the arguments of an event."""
        types: list[_ArgumentType] = []
        code = "<"
        modes_argument: int | None = None
        for index, argument in enumerate(event.get("arguments", [])):
            name = argument["type"]
            kind = self._types.get(name) or self._types[f"{namespace}::{name}"]
            types.append(kind)
            code += kind.code
            is_modes = "navigation_mode_group_t" in name and group in _CHECKS
            if is_modes and modes_argument is None:
                modes_argument = index
        unpack = struct.Struct(code).unpack_from
        lists_checks = event.get("type") == "append_health_and_arming_messages"
        template = _cut(event["message"])

        def decode(data: bytes) -> _Event:
            values = unpack(data)
            shown = [kind.show(value) for kind, value in zip(types, values, strict=True)]
            text = _fill(template, shown)
            modes = None if modes_argument is None else values[modes_argument]
            listed = states.get(values[0], 0) if lists_checks else 0
            return _Event(group, text, modes, listed)

        return decode


def _unpack(packed: bytes) -> Mapping[str, Any]:
    """Return the components in the metadata; raise ValueError if it is too large."""
    xz = lzma.LZMADecompressor(memlimit=limits.EVENT_METADATA_DICTIONARY)
    unpacked = xz.decompress(packed, limits.EVENT_METADATA)
    if not xz.eof:
        raise ValueError(f"incomplete, or more than {limits.EVENT_METADATA} bytes")
    components: Mapping[str, Any] = json.loads(unpacked)["components"]
    count = 0
    for component in components.values():
        for group in component["event_groups"].values():
            count += len(group["events"])
    if count > limits.EVENT_DEFINITIONS:
        raise ValueError(f"more than {limits.EVENT_DEFINITIONS} events")
    return components


def _states(component: Mapping[str, Any]) -> Mapping[int, int]:
    """Return the bit mask of the navigation state of each custom mode."""
    states: dict[int, int] = {}
    try:
        for bit, modes in component["navigation_mode_groups"]["groups"].items():
            for mode in modes:
                states[mode] = 1 << int(bit) % 32
    except _DAMAGED:
        return {}
    return states


def _fill(template: str, values: Sequence[Any]) -> str:
    """Insert the arguments into a template, and remove its markup."""

    def replacement(markup: re.Match[str]) -> str:
        if markup["escaped"]:
            return markup["escaped"]
        if markup["tag"]:
            is_shown = markup["tag"] in ("a", "param")
            if markup["tag"] == "profile":  # other profiles are for end users
                is_shown = markup["value"] == "dev"
            return _fill(markup["content"], values) if is_shown else ""
        number = int(markup["number"])
        if not 0 < number <= len(values):
            return markup[0]
        value = values[number - 1]
        text = str(value)
        if markup["digits"] and not isinstance(value, str):
            text = f"{value:.{markup['digits']}f}"
        if markup["unit"]:
            text += f" {markup['unit'].removesuffix('_v')}"
        return text

    return _MARKUP.sub(replacement, template).strip()


class RateLimit:
    """Limit of 100 messages per second; `omitted`: number of messages above it.

    Earlier messages count in the newest second, because a log with alternating times would otherwise have no limit. Up
    to ten times they show instead that the newest second was wild, or that the vehicle rebooted.
    """

    def __init__(self) -> None:
        self.omitted = 0
        self._begin = 0  # us, of the newest second
        self._count = 0  # messages in the newest second
        self._returns = 0
        self._before: tuple[int, int] | None = None  # begin and count of the second before

    def admits(self, time: int) -> bool:
        """Return whether a message at this time [us] is below the limit."""
        if time - self._begin >= _SECOND:
            self._before = self._begin, self._count
            self._start_at(time)
        elif self._begin - time >= _SECOND and self._returns < _BELIEVED_RETURNS:
            self._return_to(time)
        self._count += 1
        if self._count > limits.LOG_MESSAGES:
            self.omitted += 1
            return False
        return True

    def _return_to(self, time: int) -> None:
        """Continue the second before the newest one; after a reboot, continue the count at an earlier time."""
        self._returns += 1
        if self._before is None:
            self._begin = time
        else:
            self._begin, self._count = self._before
            self._before = None
        if time - self._begin >= _SECOND:
            self._start_at(time)

    def _start_at(self, time: int) -> None:
        self._begin = time
        self._count = 0


class _ReportedEvent(NamedTuple):
    """An event that became a message; `check`: the first words of a failed check, "" for another event."""

    timestamp: int
    check: str


class _ReportedText(NamedTuple):
    """A logged string that became a message; `checks`: what an event that repeats it may have as `check`."""

    timestamp: int
    checks: tuple[str, str]


class _FailedCheck(NamedTuple):
    """A failed check in a report; `modes`: bit mask of the navigation states that it blocks."""

    level: int
    modes: int


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
        # those that no text or event has repeated yet
        self._events: deque[_ReportedEvent] = deque(maxlen=_REMEMBERED)
        self._texts: deque[_ReportedText] = deque(maxlen=_REMEMBERED)
        # PX4 may log an event twice: its time, id and sequence
        self._seen: deque[tuple[int, int, int]] = deque(maxlen=_REMEMBERED)
        # checks by text, in the current report and in the one before
        self._failed: dict[str, _FailedCheck] = {}
        self._failed_before: dict[str, _FailedCheck] = {}
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
                text = self._read(record)
                if text is not None and self.limit.admits(text.timestamp):
                    data = to_log_text(text.text).encode()
                    yield Data(LOG_MESSAGE, _STRUCT.pack(text.timestamp, text.level, data))

    def _read(self, record: Record) -> LoggedText | None:
        """Return the text that a record completes; None if it completes none, or repeats an event."""
        if isinstance(record, LoggedText):
            return None if self._repeats_event(record) else record
        if isinstance(record, Information) and record.key == "metadata_events":
            self._add_metadata(record)
        elif isinstance(record, Data):
            fields = record.subscription.layout.decode(record.payload)
            if record.subscription.name == "event":
                return self._read_event(fields)
            self._nav_state = int(fields["nav_state"])
        return None

    def _add_metadata(self, record: Information) -> None:
        """Add a part of the metadata; only the first metadata is used."""
        is_decided = self._metadata is not None or self.problem
        if is_decided or not isinstance(record.value, bytes):
            return
        if not record.continued:
            self._packed = b""
        packed = self._packed + record.value
        self._packed = packed[: limits.EVENT_METADATA_PACKED]

    def _read_event(self, fields: dict[str, Any]) -> LoggedText | None:
        event = self._new_event(fields)
        if event is None:
            return None
        level = fields["log_levels"] >> 4
        if level >= _PROTOCOL:
            if event.group == "arming_check":  # starts a new report
                self._failed_before = self._failed
                self._failed = {}
            return None
        shown_level: int | None = None
        text = event.text
        if event.is_check:
            shown_level = self._add_check(event, level)
        elif event.group == "default":
            shown_level = level
            if event.lists_checks_of and text.endswith(":"):
                text += " " + ", ".join(self._checks_of(event.lists_checks_of))
        if shown_level is None or self._repeats_text(fields["timestamp"], text, event):
            return None
        return LoggedText(shown_level, fields["timestamp"], text)

    def _new_event(self, fields: dict[str, Any]) -> _Event | None:
        """Decode an event; None if it is unknown, or was logged before."""
        occurrence = (fields["timestamp"], fields["id"], fields["event_sequence"])
        if occurrence in self._seen:
            return None
        event = self._decode(fields["id"], bytes(fields["arguments"]))
        if event is not None:
            self._seen.append(occurrence)
        return event

    def _add_check(self, event: _Event, level: int) -> int | None:
        """Add a failed check to the report; return the level to show it with, None if it is not new."""
        modes = _ALL_MODES if event.modes is None else event.modes
        affects_mode = modes == _ALL_MODES
        if self._nav_state >= 0 and modes >> self._nav_state & 1:
            affects_mode = True
        shown = level if affects_mode else max(level, _INFO)
        known = self._failed.get(event.text, self._failed_before.get(event.text))
        if len(self._failed) < limits.LOG_MESSAGES:
            blocked = modes if level < _INFO else 0
            self._failed[event.text] = _FailedCheck(shown, blocked)
        if known and known.level <= shown:
            return None
        return shown

    def _checks_of(self, modes: int) -> list[str]:
        """Return the failed checks that block one of these navigation states."""
        return [text for text, check in self._failed.items() if check.modes & modes]

    def _repeats_text(self, timestamp: int, text: str, event: _Event) -> bool:
        """Return whether a logged string has already reported this event; each string matches one event."""
        check = _first_words(text) if event.is_check else ""
        for reported in self._texts:
            if abs(timestamp - reported.timestamp) <= _WINDOW and check in reported.checks:
                self._texts.remove(reported)
                return True
        self._events.append(_ReportedEvent(timestamp, check))
        return False

    def _repeats_event(self, record: LoggedText) -> bool:
        """Return whether an event has already reported this text; each event matches one text."""
        # Only a text with a trailing tab repeats an event that is no check.
        other_event = "" if record.text.endswith("\t") else "-"
        checks = (_first_words(record.text), other_event)
        for reported in self._events:
            if abs(reported.timestamp - record.timestamp) <= _WINDOW and reported.check in checks:
                self._events.remove(reported)
                return True
        self._texts.append(_ReportedText(record.timestamp, checks))
        return False

    def _decode(self, number: int, arguments: bytes) -> _Event | None:
        if self._metadata is None and self._packed and not self.problem:
            try:
                self._metadata = _EventMetadata(self._packed)
            except ValueError as exc:
                self.problem = str(exc)
        if self._metadata is None:
            return None
        return self._metadata.decode(number, arguments)


def _first_words(text: str) -> str:
    """Return the first two words, without the module name and PX4's prefix of failed checks."""
    words = _PREFIX.sub("", text).casefold().split()
    return " ".join(words[:2])
