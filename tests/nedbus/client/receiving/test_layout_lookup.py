"""Layout lookups: backoff, limits and waiting threads, with a fake query."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection, Sequence
from contextlib import suppress

import msgpack
import pytest

import nedbus
from nedbus.client.receiving import LayoutLookup, layout_lookup
from nedbus.client.receiving.layout_lookup import SchemaId, Schemas
from nedbus.timings import Timings
from nedbus_msgs import DEFAULT, codec_of
from tests.waits import DEADLINE, wait_for


def look_up(lookup: LayoutLookup, payloads: Sequence[bytes]) -> None:
    """Look up the unknown layouts of the payloads, and wait for the replies."""
    for payload in payloads:
        with suppress(nedbus.errors.DecodeError):
            lookup.check(codec_of(DEFAULT), payload)
    lookup.wait()


def test_failed_layout_lookups_back_off() -> None:
    """A failed lookup of a layout is repeated after growing intervals, because its publisher may start later."""
    now, queried = 0.0, list[tuple[float, SchemaId]]()
    payloads = [msgpack.packb([layout, 1, 2]) for layout in range(9, 40)]

    def find(schema_ids: Collection[SchemaId]) -> Schemas:
        queried.extend((now, each) for each in schema_ids)
        return {}

    lookup = LayoutLookup(find, now=lambda: now)
    while now < 250.0:
        look_up(lookup, payloads)
        now += 0.5
    assert sorted({when for when, _ in queried}) == [0.0, 0.5, 2.5, 7.5, 17.5, 47.5, 107.5, 167.5, 227.5]
    assert len(queried) == len(set(queried)) == 9 * len(payloads)


def test_only_requested_layouts_are_stored() -> None:
    """From a reply with thousands of layouts, only the requested ones are stored, up to a limit."""
    fields = {"timestamp": "uint64", "x": "float32"}
    known: Schemas = {("VehicleLocalPosition", number): fields for number in range(9, 2000)}
    lookup = LayoutLookup(lambda _: known)
    for layout in range(1500, 1520):
        look_up(lookup, [msgpack.packb([layout, 1, 2.0])])
    assert list(lookup.newer(DEFAULT)) == list(range(1500, 1516))


def test_long_field_names_are_truncated_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    """A layout with a field name of 100,000 characters is logged as one short line."""
    known: Schemas = {("VehicleLocalPosition", 1500): {"timestamp": "uint64", 100_000 * "x": "float32"}}
    look_up(LayoutLookup(lambda _: known), [msgpack.packb([1500, 1, 2])])
    [line] = caplog.messages
    assert line.startswith("layout 1500 of VehicleLocalPosition is newer than this reader; ignored fields: xxx")
    assert len(line) < 1000


def test_receiving_thread_does_not_wait_for_a_lookup() -> None:
    """A check on the receiving thread starts a lookup without waiting for the reply; closing waits for it."""
    queried, answering = threading.Event(), threading.Event()

    def find(_: Collection[SchemaId]) -> Schemas:
        queried.set()
        answering.wait(DEADLINE)
        return {("VehicleLocalPosition", 9): {"timestamp": "uint64", "x": "float32"}}

    lookup = LayoutLookup(find)
    with pytest.raises(nedbus.errors.UnknownLayoutError):
        lookup.check(codec_of(DEFAULT), msgpack.packb([9, 1, 2.0]))
    assert queried.wait(DEADLINE)
    assert not lookup.newer(DEFAULT)
    answering.set()
    lookup.close()
    lookup.check(codec_of(DEFAULT), msgpack.packb([9, 1, 2.0]))


def test_definition_requested_during_a_lookup_is_looked_up_next() -> None:
    """A definition requested during another lookup is looked up next, and readers wait for both.

    A definition in the first reply is not looked up again, even if more of its messages have arrived.
    """
    answering, queried = threading.Event(), list[set[SchemaId]]()

    def find(schema_ids: Collection[SchemaId]) -> Schemas:
        queried.append(set(schema_ids))
        answering.wait(DEADLINE)
        return {each: {"timestamp": "uint64", "x": "float32"} for each in schema_ids}

    lookup = LayoutLookup(find)
    for name in ("First", "First", "Second"):
        assert lookup.codec(name, "hash") is None
        wait_for(lambda: queried, what="the first lookup")
    answering.set()
    found = [lookup.codec(name, "hash", wait=True) for name in ("First", "Second")]
    assert [codec.definition.name for codec in found if codec] == ["First", "Second"]
    assert queried == [{("First", "hash")}, {("Second", "hash")}]


def test_wait_for_unanswered_lookups_is_bounded() -> None:
    """Lookups of definitions that no peer knows make readers wait for 3 s in total, then for 10 % of the time.

    Definitions from other peers are still looked up, and memory for failed lookups is bounded.
    """

    def find(schema_ids: Collection[SchemaId]) -> Schemas:
        return {each: {"timestamp": "uint64"} for each in schema_ids if each[0] == "Honest"}

    lookup = LayoutLookup(find)
    lookup._wait_budget, lookup._budget_time = 0.0, time.monotonic()  # the state after 3 s of futile waits
    start = time.monotonic()
    for number in range(5000):
        assert lookup.codec("Evil", str(number), wait=True) is None
    assert len(lookup._open) <= 2 * layout_lookup._MAX_UNKNOWN
    assert len(lookup._failed) <= layout_lookup._MAX_FAILED
    assert start <= lookup._budget_time <= time.monotonic()
    wait_for(lambda: lookup.codec("Honest", "hash"), what="the definition")
    lookup.close()


def test_wait_for_an_unanswered_lookup_uses_up_the_budget(timings: Timings) -> None:
    """After a reader has waited for the full timeout, the next waits are short until time has passed."""
    timings.definition_timeout, closed = 0.1, threading.Event()

    def find(_: Collection[SchemaId]) -> Schemas:
        closed.wait(DEADLINE)
        return {}

    lookup = LayoutLookup(find)
    assert lookup._wait_budget == 0.1
    assert lookup.codec("Evil", "hash", wait=True) is None
    assert lookup._wait_budget == 0.0
    closed.set()
    lookup.close()


def test_memory_for_definitions_is_bounded(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """The total number of fields is bounded; definitions that exceed the bound are rejected, and logged once.

    Definitions no longer in use are evicted, least recently used first.
    """
    now = 0.0
    monkeypatch.setattr(layout_lookup, "_MAX_FIELDS", 10 * (1 + layout_lookup._BASE))
    lookup = LayoutLookup(lambda schema_ids: {each: {"timestamp": "uint64"} for each in schema_ids}, now=lambda: now)
    known = [lookup.codec("Honest", str(number), wait=True) for number in range(20)]
    assert [codec is not None for codec in known] == [True] * 10 + [False] * 10
    assert lookup.codec("Honest", "0") is known[0]
    assert caplog.text.count("too many definitions from publishers are in use") == 1
    now += 3600.0
    assert lookup.codec("Honest", "0") is known[0]
    assert lookup.codec("Honest", "new", wait=True)
    assert [lookup.codec("Honest", str(number)) is known[number] for number in (0, 2)] == [True, True]
    assert len(lookup._codecs) == len(lookup._used) == 10
