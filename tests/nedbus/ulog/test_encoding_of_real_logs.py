"""The compiled encoding of logged messages, compared with that of their fields, for all messages of real logs."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Final

import pytest

from nedbus.ulog import Data, LoggedStream, Subscription, UlogParser
from nedbus_msgs import Encoded, InvalidMessageError, encode_upgraded
from tests.flights.ulogs import LOGS

PX4: Final = LOGS.parent / "px4"
PATHS: Final = sorted([*LOGS.glob("*.ulg"), *PX4.glob("**/*.ulg")])
SIZE: Final = 300_000
"""Bytes of the part of a log with which the quick test begins."""

pytestmark = [pytest.mark.logs, pytest.mark.skipif(not PATHS, reason=f"no logs in {LOGS}")]


def by_fields(stream: LoggedStream, payload: bytes) -> Encoded | None:
    """Encode the fields of a message; None if it is invalid."""
    try:
        return encode_upgraded(stream.definition, stream.decode(payload))
    except InvalidMessageError:
        return None


def compare(log: bytes) -> Counter[str]:
    """Compare both encodings of each message; return the number of valid, invalid and unusual messages."""
    streams, counts, parser = (
        dict[Subscription, LoggedStream](),
        Counter[str](),
        UlogParser(verify=True),
    )
    for record in parser.feed(log):
        if not isinstance(record, Data):
            continue
        if record.subscription not in streams:
            streams[record.subscription] = LoggedStream("1", record.subscription)
        stream = streams[record.subscription]
        if stream.converted:
            counts["converted"] += 1
            continue
        found, expected = stream.encode_valid(record.payload), by_fields(stream, record.payload)
        assert (found and found[1:]) == (expected and expected[1:]), (
            stream.address,
            record.payload,
        )
        counts["invalid" if found is None else "valid"] += 1
    return counts


@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_first_messages_are_encoded_as_their_fields(path: Path) -> None:
    """Payloads and names of provided fields are equal; an invalid message is left to the model, which rejects it."""
    with path.open("rb") as file:
        assert compare(file.read(SIZE))["valid"] > 100


@pytest.mark.long
@pytest.mark.parametrize("path", PATHS, ids=lambda path: path.stem)
def test_all_messages_are_encoded_as_their_fields(path: Path) -> None:
    """As above, for the whole log."""
    assert compare(path.read_bytes())["valid"] > 1000
