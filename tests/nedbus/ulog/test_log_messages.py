"""Log messages from logged strings and events: compared with pyulog on real logs, and with hostile input."""

from __future__ import annotations

import json
import lzma
import struct
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import pytest
from pyulog import ULog
from pyulog.px4_events import PX4Events

import nedbus
from nedbus import limits
from nedbus.ulog import LogMessageBuilder, to_log_text
from tests.flights.ulogs import LOGS, UlogWriter, log_messages_in

REAL = [*LOGS.glob("*.ulg"), *(LOGS.parent / "px4").rglob("*.ulg")]
ARMED: Final = {
    "arguments": [{"name": "by", "type": "by_t"}],
    "message": "Armed by {1}",
    "name": "armed",
}
LIMIT: Final = {
    "arguments": [{"name": "a", "type": "float"}, {"name": "b", "type": "px4::bits_t"}],
    "message": 'At {1:.1m/s} \\{<profile name="dev">{2}</profile><profile name="x">no</profile><a href="x">b</a>\\}',
    "name": "limit",
}
CHECK: Final = {
    "arguments": [{"name": "modes", "type": "navigation_mode_group_t"}, {"name": "index", "type": "uint8_t"}],
    "message": "No offboard signal", "name": "check",
}  # fmt: skip
FAILSAFE: Final = {
    "arguments": [{"name": "mode", "type": "uint32_t"}], "message": "Failsafe warning:", "name": "failsafe",
    "type": "append_health_and_arming_messages",
}  # fmt: skip
SUMMARY: Final = {"message": "summary", "name": "summary", "type": "summary"}
METADATA: Final = {
    "version": 2,
    "components": {
        "1": {
            "namespace": "px4",
            "enums": {
                "by_t": {"type": "uint8_t", "entries": {"2": {"description": "RC switch", "name": "rc"}}},
                "bits_t": {
                    "type": "uint8_t", "is_bitfield": True, "separator": ", ",
                    "entries": {"1": {"description": "one", "name": "a"}, "4": {"description": "four", "name": "b"}},
                },
                "navigation_mode_group_t": {"type": "uint32_t", "is_bitfield": True, "entries": {}},
            },
            "navigation_mode_groups": {"groups": {"14": [393216]}},
            "event_groups": {
                "default": {"events": {"1": ARMED, "2": LIMIT, "3": FAILSAFE}},
                "arming_check": {"events": {"10": CHECK, "11": SUMMARY}},
            },
        }
    },
}  # fmt: skip
FORMAT = b"event:uint64_t timestamp;uint32_t id;uint16_t event_sequence;uint8_t[25] arguments;uint8_t log_levels;"


class Log(UlogWriter):
    """A log with logged strings and events."""

    def __init__(self, metadata: bytes | Mapping[str, Any] = METADATA) -> None:
        super().__init__()
        packed = (
            metadata
            if isinstance(metadata, bytes)
            else lzma.compress(json.dumps(metadata).encode())
        )
        for at in range(0, len(packed), 60_000):
            key = f"uint8_t[{len(packed[at : at + 60_000])}] metadata_events".encode()
            self.put("M", bytes([at > 0, len(key)]) + key + packed[at : at + 60_000])
        self.put("F", FORMAT)
        self.put("F", b"vehicle_status:uint64_t timestamp;uint8_t nav_state;")
        for number, topic in enumerate((b"event", b"event", b"vehicle_status")):
            self.put("A", struct.pack("<BH", 0, number) + topic)
        self.sequence = 0

    def text(self, timestamp: int, text: bytes, level: int = 6) -> None:
        """Add a logged string."""
        self.put("L", b"%d" % level + struct.pack("<Q", timestamp) + text)

    def event(
        self,
        timestamp: int,
        number: int,
        arguments: bytes = b"",
        level: int = 6,
        *,
        twice: bool = False,
    ) -> None:
        """Add an event."""
        self.sequence += 1
        body = struct.pack(
            "<QIH25sB", timestamp, 1 << 24 | number, self.sequence, arguments, level << 4 | 1
        )
        for message_id in range(1 + twice):
            self.put("D", struct.pack("<H", message_id) + body)

    def mode(self, nav_state: int) -> None:
        """Add a vehicle_status."""
        self.put("D", struct.pack("<HQB", 2, 0, nav_state))

    def log_messages(self, texts: LogMessageBuilder | None = None) -> list[tuple[int, int, str]]:
        """Return timestamp, severity and text of each log message."""
        return log_messages_in(bytes(self.data), texts)


@pytest.mark.logs
@pytest.mark.parametrize("path", REAL, ids=lambda path: path.stem)
def test_real_log_yields_each_string_and_event_once(path: Path) -> None:
    """Each event that pyulog finds and each string without an event is one message; the others are failed checks."""
    log = ULog(str(path))
    logged = [
        *log.logged_messages,
        *(each for tagged in log.logged_messages_tagged.values() for each in tagged),
    ]
    has_metadata = "metadata_events" in log.msg_info_multiple_dict
    events = {
        (int(time), text)
        for time, _, text in (PX4Events().get_logged_events(log) if has_metadata else ())
    }
    left = log_messages_in(path)
    for time, text in events:
        [one] = [each for each in left if each[0] == time and each[2].startswith(text)]
        left.remove(one)
    unpaired = 0
    for each in logged:
        expected = (each.timestamp, int(chr(each.log_level)), to_log_text(each.message))
        if expected in left:
            left.remove(expected)
        else:
            assert has_metadata
            assert each.message.endswith("\t") or "Preflight" in each.message, each.message
            unpaired += "Preflight" not in each.message
    assert unpaired <= len(events)
    assert {text for *_, text in left} <= CHECKS
    assert len(left) <= 20


CHECKS = {
    "No heading reference", "No offboard signal", "Navigation error: No valid position estimate", "GPS fix too low",
    "Navigation error: No valid global position estimate", "No valid mission available", "No manual control input",
    "No connection to the ground control station", "Offboard requires local position", "Home position not set",
    "No valid attitude estimate", "Attitude failure detected", "Horizontal position unstable",
    "No valid global position estimate", "No valid local position estimate", "No valid data from barometer 0",
    "No valid data from Compass 0",
}  # fmt: skip


def test_string_that_duplicates_an_event_is_dropped() -> None:
    """A logged string with a trailing tab is dropped if its event precedes it; other strings become messages."""
    log = Log()
    log.event(5_000_000, 1, b"\2", twice=True)
    log.text(5_000_400, b"[commander] Armed by RC switch\t")
    log.text(5_000_500, b"[commander] \x1b[32mReady!\x1b[0m")
    log.text(6_000_000, b"[commander] Armed by RC switch\t")  # no event precedes it
    assert log.log_messages() == [
        (5_000_000, 6, "Armed by RC switch"), (5_000_500, 6, "[commander] Ready!"),
        (6_000_000, 6, "[commander] Armed by RC switch"),
    ]  # fmt: skip


def test_event_that_duplicates_a_string_is_dropped() -> None:
    """Each event matches one string with a trailing tab, whichever comes first, as in a log sorted by time."""
    log = Log()
    log.text(5_000_000, b"[commander] Armed by RC switch\t")
    log.event(5_000_001, 1, b"\2")
    log.event(5_000_500, 1, b"\3")  # another one
    log.text(6_000_000, b"[commander] Armed by RC switch\t")
    log.event(6_100_000, 1, b"\2")  # too late
    assert [each[0] for each in log.log_messages()] == [5_000_000, 5_000_500, 6_000_000, 6_100_000]


def test_event_arguments_are_formatted() -> None:
    """Numbers with digits and units, enums, bit fields, profiles, links and escapes are formatted as by libevents."""
    log = Log()
    log.event(1, 2, struct.pack("<fB", 2.25, 5))
    log.event(2, 2, struct.pack("<fB", float("nan"), 8))
    log.event(3, 1, b"\7")
    log.event(4, 99)
    assert [text for *_, text in log.log_messages()] == [
        "At 2.2 m/s {one, fourb}", "At nan m/s {(unknown: 8)b}", "Armed by (unknown: 7)"
    ]  # fmt: skip


def test_failed_check_is_reported_once() -> None:
    """A failed check, which PX4 repeats in each report, is reported once; it is info if it does not affect the mode."""
    log = Log()
    check = struct.pack("<IB", 1 << 14, 0)
    for time, mode in enumerate((4, 4, 14)):
        log.mode(mode)
        log.event(time, 11, level=8)
        if time != 1:
            log.event(time, 10, check, level=3)
            log.text(time, b"[health_and_arming_checks] Preflight Fail: no offboard signal", 4)
    log.event(3, 11, level=8)
    log.event(3, 10, check, level=3)
    log.event(4, 3, struct.pack("<I", 393216), level=4)
    log.event(5, 3, struct.pack("<I", 1), level=4)
    assert log.log_messages() == [
        (0, 6, "No offboard signal"), (2, 3, "No offboard signal"), (4, 4, "Failsafe warning: No offboard signal"),
        (5, 4, "Failsafe warning:"),
    ]  # fmt: skip


def changed(change: Callable[[dict[str, Any]], object]) -> bytes:
    """Return the metadata after a change."""
    copy = json.loads(json.dumps(METADATA))
    change(copy["components"]["1"])
    return lzma.compress(json.dumps(copy).encode())


@pytest.mark.parametrize(
    "metadata",
    [
        b"", b"not xz", lzma.compress(b"{"), lzma.compress(b"[" * 2000), lzma.compress(b'{"components": []}'),
        lzma.compress(b" " * 2**21 + json.dumps(METADATA).encode()), lzma.compress(json.dumps(METADATA).encode())[:-9],
        lzma.compress(b'{"components": {"1": ' + b"[" * 900 + b"]" * 900 + b"}}"),
        changed(lambda px4: px4["event_groups"]["default"]["events"]["1"].update(message=5)),
        changed(lambda px4: px4["event_groups"]["default"]["events"]["1"].update(arguments=[{"type": "uint64_t"}] * 4)),
        changed(lambda px4: px4["event_groups"]["default"]["events"]["1"].update(arguments="long")),
        changed(lambda px4: px4["enums"]["by_t"].update(entries=7)),
        changed(lambda px4: px4["enums"]["by_t"].update(type="by_t")),
        changed(lambda px4: px4.update(event_groups=[])),
        changed(lambda px4: px4["event_groups"]["default"].update(events=["1"])),
        changed(lambda px4: px4["event_groups"]["default"]["events"].update({str(n): {} for n in range(9, 5010)})),
        changed(lambda px4: px4["event_groups"]["default"]["events"]["1"].update(arguments=[{"type": "by_t"}] * 26)),
    ],
    ids=map(str, range(17)),
)  # fmt: skip
def test_invalid_event_metadata_loses_only_events(metadata: bytes) -> None:
    """Metadata that is too large or deep, incomplete or of wrong types disables events, but no logged strings."""
    log = Log(metadata)
    log.event(1, 1, b"\2")
    log.text(2, b"still here")
    assert log.log_messages() == [(2, 6, "still here")]


@pytest.mark.parametrize(
    ("metadata", "reason"),
    [
        (b"not xz", "Input format not supported by decoder"),
        (lzma.compress(b" " * (2**21 + 1)), "incomplete, or more than 2097152 bytes"),
        (changed(lambda px4: px4.update(event_groups=[])), "unexpected structure"),
        (changed(lambda px4: px4["enums"].update(dict.fromkeys("abcdefghij" * 7))), ""),
        (
            changed(
                lambda px4: px4["event_groups"].update(x={"events": dict.fromkeys(range(5000))})
            ),
            "more than 5000 e",
        ),
    ],
)
def test_unreadable_event_metadata_has_reason(metadata: bytes, reason: str) -> None:
    """Metadata that cannot be used at all is reported; an enum or event that is invalid does not affect others."""
    texts, log = LogMessageBuilder(), Log(metadata)
    log.event(1, 1, b"\2")
    messages = log.log_messages(texts)
    assert (texts.problem == "") == (reason == "") == bool(messages)
    assert reason in texts.problem


def test_long_texts_of_event_metadata_are_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    """The names of a bit field, with the separators between them, are cut to the limit of a text from a peer."""
    monkeypatch.setattr(limits, "PEER_TEXT", 30)

    def change(px4: dict[str, Any]) -> None:
        px4["enums"]["bits_t"].update(separator="+" * 1000)
        px4["event_groups"]["default"]["events"]["2"]["message"] = "{2}"

    log = Log(changed(change))
    log.event(1, 2, struct.pack("<fB", 1.0, 5))
    assert [text for *_, text in log.log_messages()] == ["one" + "+" * 27]


def test_only_first_event_metadata_is_used() -> None:
    """Later metadata is ignored, because each of thousands would need a decompression."""
    log = Log()
    log.event(1, 1, b"\2")
    for piece in (b"", b"damaged", lzma.compress(b"{}")):
        key = f"uint8_t[{len(piece)}] metadata_events".encode()
        log.put("M", bytes([0, len(key)]) + key + piece)
        log.event(2, 1, b"\2")
    assert [text for *_, text in log.log_messages()] == ["Armed by RC switch"] * 4


def test_log_messages_are_sanitised_and_rate_limited() -> None:
    """Control characters, escape sequences and bidirectional marks are removed; of 10,000 texts a second 100 remain."""
    hostile = "a\nb\r\x1b[2Jc\x00\x07\x9b31m\u202ed\u2028e" + "\x1b]0;title\x07" + "µ" * 200
    text = to_log_text(hostile)
    assert text.startswith("a b cd31m"[:5])
    assert text.isprintable()
    assert len(text.encode()) <= 127
    assert text.endswith("...")
    log, texts = Log(), LogMessageBuilder()
    for number in range(10_000):
        log.text(50_000_000 + 100 * number, b"%d" % number)
    log.text(52_000_000, b"later")
    assert len(log_messages := log.log_messages(texts)) == 101
    assert log_messages[-1] == (52_000_000, 6, "later")
    assert texts.limit.omitted == 9_900


def test_texts_that_jump_in_time_are_rate_limited() -> None:
    """A log whose times jump between two seconds has 100 texts for each: jumps in time do not evade the limit."""
    log, texts = Log(), LogMessageBuilder()
    for number in range(1000):
        log.text(50_000_000 if number % 2 else 90_000_000, b"%d" % number)
    log.text(91_000_000, b"later")
    *_, last = log_messages = log.log_messages(texts)
    assert last == (91_000_000, 6, "later")
    assert len(log_messages) <= 201, "100 for each of the two seconds"
    assert texts.limit.omitted >= 800


def test_topics_with_unexpected_fields_are_ignored(tmp_path: Path) -> None:
    """A topic `event` with other fields is ignored, and a logged log_message does not duplicate the strings."""
    log = UlogWriter()
    log.put("F", b"event:float timestamp;")
    log.put("F", b"log_message:uint64_t timestamp;uint8_t severity;char[127] text;")
    for number, topic in enumerate((b"event", b"log_message")):
        log.put("A", struct.pack("<BH", 0, number) + topic)
    log.put("D", struct.pack("<Hf", 0, 1.0))
    log.put("D", struct.pack("<HQB127s", 1, 5, 4, b"[ekf2] text\t"))
    log.put("L", b"4" + struct.pack("<Q", 5) + b"[ekf2] text\t")
    messages = nedbus.read(log.write(tmp_path / "a.ulg"), "log_message")
    assert messages.tolist() == [(5, 4, b"[ekf2] text")]
    frame = nedbus.read(tmp_path / "a.ulg", "log_message", dataframe="pandas")
    assert frame["text"].tolist() == ["[ekf2] text"]


@pytest.mark.parametrize("wild", [10**15, 2**64 - 1, 0])
@pytest.mark.parametrize("count", [1, 3])
def test_wild_times_silence_no_texts(wild: int, count: int) -> None:
    """A text with a wild time, or several in a row, does not let the texts after it count in one second."""
    log = Log()
    for number in range(1, 601):
        is_wild = 50 <= number < 50 + count
        log.text(wild if is_wild else 1_000_000 * number, b"text %d" % number)
    assert len(log.log_messages()) == 600
