"""Lifetime of definitions made at run time, which any peer may send."""

from __future__ import annotations

import gc
import weakref

from nedbus_msgs import Definition, Message, codec_of, define, encoding_of, field_type, provenance_of
from nedbus_msgs.arrays import arrays_of
from nedbus_msgs.codecs.cdr import cdr_layout


def use(name: str) -> Definition[Message]:
    """Return a definition after using all of its codecs."""
    definition = define(name, [("timestamp", field_type("uint64")), ("q", field_type("float32[4]"))])
    codec, message = codec_of(definition), definition.model(timestamp=1)
    assert codec.decode(codec.encode(message)) == message
    assert codec.decode_row(codec.encode(message))._fields == definition.names  # type: ignore[attr-defined] # a Row
    assert len(arrays_of(definition).of([message])) == 1
    assert cdr_layout(definition.current).zeros
    assert provenance_of(definition, encoding_of(definition, "sim", frozenset({"timestamp"}))).missing == {"q"}
    assert definition.plan(definition.names).provided == definition.all_fields
    return definition


def test_unused_definition_is_freed_with_its_codecs() -> None:
    """No cache keeps a definition alive, and its codecs are cached while it is in use."""
    kept = use("Kept")
    departed = [weakref.ref(use(f"Departed{number}")) for number in range(50)]
    gc.collect()
    assert not any(each() for each in departed)
    assert codec_of(kept) is codec_of(kept)
    assert arrays_of(kept) is arrays_of(kept)
    assert cdr_layout(kept.current) is cdr_layout(kept.current)
