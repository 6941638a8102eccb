"""Provenance of messages in their Zenoh encoding."""

from __future__ import annotations

import pytest
from hypothesis import given, strategies as st

from nedbus_msgs import (
    MESSAGES,
    ArgumentError,
    Provenance,
    encoding_of as encoding_with,
    identity_of,
    short_hash,
)
from tests.flights.local_position import (
    ENCODING,
    FIELD_TYPES,
    encoding_of,
    next_release,
    provenance_of,
)


@pytest.mark.slow
@given(
    st.none() | st.from_regex(r"[a-z0-9_-]{1,32}", fullmatch=True),
    st.sets(st.sampled_from(list(FIELD_TYPES))),
)
def test_provenance_round_trip(source: str | None, provided: set[str]) -> None:
    """Any source and set of fields is unchanged after encoding and parsing."""
    encoding = encoding_of(source, frozenset(provided))
    assert encoding.startswith(ENCODING)
    assert provenance_of(encoding) == Provenance(source, frozenset(FIELD_TYPES.keys() - provided))


def test_encoding_without_missing_fields_has_no_mask() -> None:
    """If all fields are provided, the encoding has no `missing` part, and without a source nothing is appended."""
    assert encoding_of(None) == ENCODING
    assert (
        encoding_of("sim") == f"{ENCODING};source=sim" == encoding_of("sim", frozenset(FIELD_TYPES))
    )
    assert (
        encoding_of("x", frozenset(FIELD_TYPES.keys() - {"timestamp", "x"}))
        == f"{ENCODING};source=x;missing=41"
    )


def test_only_layouts_of_the_first_version_have_no_hash(monkeypatch: pytest.MonkeyPatch) -> None:
    """Encodings of the layouts that every reader has are unchanged; a newer layout carries the hash of its fields."""
    with_hash = [name for name, each in MESSAGES.items() if ";hash=" in encoding_with(each, None)]
    assert [
        name for name in with_hash if MESSAGES[name].model.__module__.startswith("nedbus_msgs.")
    ] == ["LogMessage"]
    newer = next_release()
    monkeypatch.setitem(MESSAGES, newer.name, newer)
    expected = f"{ENCODING};hash={short_hash(newer.name, newer.types)};source=sim"
    assert encoding_with(newer, "sim") == expected
    assert identity_of(expected) == (newer.name, short_hash(newer.name, newer.types))


@pytest.mark.parametrize(
    "encoding",
    ["", "zenoh/bytes", ENCODING]
    + [
        f"{ENCODING};{rest}"
        for rest in ("", "source=", "source=Ä", "a=b;=;;", f"source={'x' * 33}", "source=a b")
    ]
    + [f"{ENCODING};missing={mask}" for mask in ("-1", "f" * 15)],
)
def test_invalid_parts_of_an_encoding_are_ignored(encoding: str) -> None:
    """Unknown or invalid parts, which other programs may send, are ignored."""
    assert provenance_of(encoding) == Provenance()


def test_mask_bits_beyond_the_last_field_are_ignored() -> None:
    """Mask bits beyond the last field, which a newer layout may have, are ignored."""
    assert provenance_of(f"{ENCODING};missing={'f' * 14};new=1").missing == FIELD_TYPES.keys()


@pytest.mark.parametrize("source", ["", "A", "a b", "x" * 33, "a;b"])
def test_invalid_source_raises(source: str) -> None:
    """A source that cannot be part of an encoding raises ArgumentError."""
    with pytest.raises(ArgumentError, match="1 to 32 of a-z"):
        Provenance(source)
