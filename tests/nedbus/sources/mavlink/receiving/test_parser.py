"""The parser of MAVLink frames: the fields that it decodes are those of pymavlink."""

from __future__ import annotations

import re
from typing import Any

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus.mavlink.fields import DECODED
from nedbus.mavlink.parser import new_parser

USED = [each for each in dialect.mavlink_map.values() if each.msgname in DECODED]


def example(kind: Any) -> Any:
    """Return a message whose fields all differ from zero, and from each other."""
    values: list[Any] = []
    for number, (name, c_type) in enumerate(zip(kind.fieldnames, kind.fieldtypes, strict=True)):
        length = kind.array_lengths[kind.ordered_fieldnames.index(name)]
        value = 1 + number % 90
        values.append(
            b"text"
            if c_type == "char"
            else [(value + each) % 100 for each in range(length)]
            if length
            else value
        )
    return kind(*values)


@pytest.mark.parametrize(
    ("kind", "force_mavlink1"),
    [(kind, version == 1) for kind in USED for version in (1, 2) if version == 2 or kind.id < 256],
    ids=lambda each: each if isinstance(each, bool) else each.msgname,
)
def test_all_fields_of_a_used_message_equal_pymavlinks(kind: Any, *, force_mavlink1: bool) -> None:
    """A used message has all fields, ids and the name that pymavlink decodes, in both versions of the protocol."""
    frame = example(kind).pack(dialect.MAVLink(None, 7, 1), force_mavlink1=force_mavlink1)
    (message,) = new_parser().parse_buffer(frame)
    (expected,) = dialect.MAVLink(None).parse_buffer(frame)
    for name in kind.fieldnames:
        if kind.msgname.startswith("LOGGING_DATA") and name == "data":
            assert list(message.data.ljust(249, b"\0")) == expected.data
        elif name == "text":
            assert message._text_raw.rstrip(b"\0") == expected._text_raw
        else:
            assert getattr(message, name) == getattr(expected, name)
    for name in ("get_type", "get_msgId", "get_srcSystem", "get_srcComponent"):
        assert getattr(message, name)() == getattr(expected, name)()
    assert message.instance_field == expected.instance_field
    assert bytes(message.get_msgbuf()) == frame


def test_field_that_a_message_lacks_is_an_attribute_error_except_its_times() -> None:
    """Only the two times, which are asked of each message, have a value in messages without them."""
    (message,) = new_parser().parse_buffer(
        dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3).pack(dialect.MAVLink(None))
    )
    assert (message.time_boot_ms, message.time_usec) == (None, 0)
    with pytest.raises(AttributeError, match=re.escape("time_unix_usec")):
        _ = message.time_unix_usec


def test_message_with_a_wrong_checksum_is_bad_data() -> None:
    """A damaged frame is not decoded, even if none of its fields is ever read."""
    frame = dialect.MAVLink_attitude_message(1, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0).pack(
        dialect.MAVLink(None)
    )
    (message,) = new_parser().parse_buffer(frame[:-1] + bytes([frame[-1] ^ 1]))
    assert message.get_type() == "BAD_DATA"
