"""Where messages come from, as the encoding says it."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from nedbus_msgs import ENCODING, FIELD_TYPES, AddressError, Origin, encoding_of, origin_of


@given(st.none() | st.from_regex(r"[a-z0-9_-]{1,32}", fullmatch=True), st.sets(st.sampled_from(list(FIELD_TYPES))))
def test_origin_comes_back(source: str | None, provided: set[str]) -> None:
    """Any source and any set of fields is said by an encoding, and read back."""
    encoding = encoding_of(source, frozenset(provided))
    assert encoding.startswith(ENCODING)
    assert origin_of(encoding) == Origin(source, frozenset(FIELD_TYPES.keys() - provided))


def test_all_fields_need_no_word() -> None:
    """What provides everything adds only its name; a publisher that says nothing has the plain encoding."""
    assert encoding_of(None) == ENCODING
    assert encoding_of("sim") == f"{ENCODING};source=sim" == encoding_of("sim", frozenset(FIELD_TYPES))
    assert encoding_of("x", frozenset(FIELD_TYPES.keys() - {"timestamp", "x"})) == f"{ENCODING};source=x;missing=41"


@pytest.mark.parametrize(
    "encoding",
    [
        "",
        "zenoh/bytes",
        *(
            ENCODING + rest
            for rest in ("", ";", ";source=", ";source=Ä", ";a=b;=;;", f";source={'x' * 33}", ";source=a b")
        ),
        f"{ENCODING};missing=-1",
        f"{ENCODING};missing={'f' * 15}",
    ],
)
def test_what_is_not_understood_tells_nothing(encoding: str) -> None:
    """An encoding may be anybody's: what is odd in it is left out."""
    assert origin_of(encoding) == Origin()


def test_bits_without_a_field_are_ignored() -> None:
    """A mask may be of a newer layout."""
    assert origin_of(f"{ENCODING};missing={'f' * 14};new=1").missing == FIELD_TYPES.keys()


@pytest.mark.parametrize("source", ["", "A", "a b", "x" * 33, "a;b"])
def test_source_is_a_plain_word(source: str) -> None:
    """A source that could not be written in an encoding is refused."""
    with pytest.raises(AddressError, match="1 to 32 of a-z"):
        Origin(source)
