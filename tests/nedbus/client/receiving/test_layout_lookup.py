"""Layout lookups: backoff, limits and waiting threads, with a fake query."""

from __future__ import annotations

import threading
import time
from collections.abc import Collection, Iterable
from functools import partial

import pytest

from nedbus import limits
from nedbus.client.receiving import LayoutLookup, layout_lookup
from nedbus.client.receiving.layout_lookup import SchemaId, Schemas
from nedbus.timings import Timings
from tests.waits import DEADLINE, wait_for

FIELDS = {"timestamp": "uint64", "x": "float32"}


def look_up(
    lookup: LayoutLookup, hashes: Iterable[str], name: str = "VehicleLocalPosition"
) -> None:
    """Look up the definitions with these hashes, and wait for the replies."""
    for each in hashes:
        lookup.codec(name, each)
    lookup.wait()


def only(known: Schemas, _: Collection[SchemaId]) -> Schemas:
    """Reply to every query with these definitions."""
    return known


@pytest.mark.slow
def test_failed_lookups_back_off() -> None:
    """A failed lookup of a definition is repeated after growing intervals, because its publisher may start later."""
    now, queried = 0.0, list[tuple[float, SchemaId]]()
    hashes = [str(number) for number in range(9, 40)]

    def find(schema_ids: Collection[SchemaId]) -> Schemas:
        queried.extend((now, each) for each in schema_ids)
        return {}

    lookup = LayoutLookup(find, now=lambda: now)
    while now < 250.0:
        look_up(lookup, hashes)
        now += 0.5
    assert sorted({when for when, _ in queried}) == [
        0.0,
        0.5,
        2.5,
        7.5,
        17.5,
        47.5,
        107.5,
        167.5,
        227.5,
    ]
    assert len(queried) == len(set(queried)) == 9 * len(hashes)


def test_only_requested_definitions_are_stored() -> None:
    """From a reply with thousands of definitions, only the requested ones are stored."""
    known: Schemas = {("VehicleLocalPosition", str(number)): FIELDS for number in range(9, 2000)}
    lookup = LayoutLookup(partial(only, known))
    look_up(lookup, map(str, range(1500, 1520)))
    assert [int(which) for _, which in lookup._known] == list(range(1500, 1520))


def test_unknown_fields_are_truncated_in_the_log(caplog: pytest.LogCaptureFixture) -> None:
    """The unknown fields of a newer layout are logged as one short line, and an invalid name is truncated."""
    many = FIELDS | {f"x{number}_{40 * 'x'}": "uint8" for number in range(100)}
    for fields, start in (
        (
            many,
            "a layout of VehicleLocalPosition is newer than this reader; ignored fields: x0_xxx",
        ),
        (
            FIELDS | {100_000 * "x": "uint8"},
            "ignored a peer's definition of VehicleLocalPosition: invalid field name",
        ),
    ):
        caplog.clear()
        known: Schemas = {("VehicleLocalPosition", "hash"): fields}
        look_up(LayoutLookup(partial(only, known)), ["hash"])
        [line] = caplog.messages
        assert line.startswith(start)
        assert len(line) < 1000


def test_lookups_continue_after_an_unexpected_error(caplog: pytest.LogCaptureFixture) -> None:
    """After a panic of Zenoh, which is a BaseException, definitions are still looked up; the error is logged once."""

    def find(ids: Collection[SchemaId]) -> Schemas:
        if ("First", "hash") in ids:
            raise BaseException("panic")  # noqa: TRY002 - like pyo3's PanicException, it is not an Exception
        return dict.fromkeys(ids, FIELDS)

    lookup = LayoutLookup(find)
    for name in ("First", "Second"):
        look_up(lookup, ["hash"], name)
    wait_for(lambda: lookup.codec("Second", "hash"), what="the definition")
    assert [text for text in caplog.messages if "unexpected" in text] == [
        "unexpected error in a lookup of definitions (logged once)"
    ]
    lookup.close()


def test_lookup_goes_on_while_the_link_is_down() -> None:
    """A reader waits for a definition whose publisher is out of reach, and a lookup without a link is no failure."""
    is_linked, queries = threading.Event(), list[bool]()

    def find(ids: Collection[SchemaId]) -> Schemas:
        queries.append(is_linked.is_set())
        if queries.count(False) > 2:
            is_linked.set()
        returned = queries.count(True) > 2  # the publisher returns to the router after the reader
        return dict.fromkeys(ids, FIELDS) if returned else {}

    lookup = LayoutLookup(find, is_linked=is_linked.is_set)
    assert lookup.codec("First", "hash", wait=True)
    lookup.close()


def test_reader_does_not_wait_for_the_end_of_a_long_outage(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """While the link is down, each wait for a definition ends, and the lookup goes on."""
    monkeypatch.setattr(layout_lookup, "_LONGEST_OUTAGE", 0.3)
    is_linked = threading.Event()

    def find(ids: Collection[SchemaId]) -> Schemas:
        return dict.fromkeys(ids, FIELDS) if is_linked.is_set() else {}

    lookup = LayoutLookup(find, is_linked=is_linked.is_set)
    for _ in range(3):
        assert lookup.codec("First", "hash", wait=True) is None
    is_linked.set()
    wait_for(lambda: lookup.codec("First", "hash"), what="the definition")
    lookup.close()


def test_receiving_thread_does_not_wait_for_a_lookup() -> None:
    """A request on the receiving thread starts a lookup without waiting for the reply; closing waits for it."""
    queried, answering = threading.Event(), threading.Event()

    def find(_: Collection[SchemaId]) -> Schemas:
        queried.set()
        answering.wait(DEADLINE)
        return {("VehicleLocalPosition", "hash"): FIELDS}

    lookup = LayoutLookup(find)
    assert lookup.codec("VehicleLocalPosition", "hash") is None
    assert queried.wait(DEADLINE)
    assert lookup.codec("VehicleLocalPosition", "hash") is None
    answering.set()
    lookup.close()
    assert lookup.codec("VehicleLocalPosition", "hash")


def test_definition_requested_during_a_lookup_is_looked_up_next() -> None:
    """A definition requested during another lookup is looked up next, and readers wait for both.

    A definition in the first reply is not looked up again, even if more of its messages have arrived.
    """
    answering, queried = threading.Event(), list[set[SchemaId]]()

    def find(schema_ids: Collection[SchemaId]) -> Schemas:
        queried.append(set(schema_ids))
        answering.wait(DEADLINE)
        return dict.fromkeys(schema_ids, FIELDS)

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
    # the state after 3 s of futile waits
    lookup._wait_budget, lookup._budget_time = 0.0, time.monotonic()
    start = time.monotonic()
    for number in range(5000):
        assert lookup.codec("Evil", str(number), wait=True) is None
    assert len(lookup._open) <= 2 * limits.UNKNOWN_DEFINITIONS
    assert len(lookup._failed) <= limits.FAILED_DEFINITIONS
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


@pytest.mark.slow
def test_memory_for_definitions_is_bounded(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The total number of fields is bounded; definitions that exceed the bound are rejected, and logged once.

    Definitions no longer in use are evicted, least recently used first.
    """
    now = 0.0
    monkeypatch.setattr(limits, "DEFINITION_FIELDS", 10 * (1 + layout_lookup._BASE))
    lookup = LayoutLookup(
        lambda schema_ids: {each: {"timestamp": "uint64"} for each in schema_ids}, now=lambda: now
    )
    known = [lookup.codec("Honest", str(number), wait=True) for number in range(20)]
    assert [codec is not None for codec in known] == [True] * 10 + [False] * 10
    assert lookup.codec("Honest", "0") is known[0]
    assert caplog.text.count("too many definitions from publishers are in use") == 1
    now += 3600.0
    assert lookup.codec("Honest", "0") is known[0]
    assert lookup.codec("Honest", "new", wait=True)
    assert [lookup.codec("Honest", str(number)) is known[number] for number in (0, 2)] == [
        True,
        True,
    ]
    assert len(lookup._known) == 10
