"""Lifetime of definitions made at run time, which any peer may send."""

from __future__ import annotations

import gc
import weakref

import pytest

from nedbus_msgs import (
    Definition,
    Message,
    codec_of,
    define,
    encoding_of,
    field_type,
    provenance_of,
)
from nedbus_msgs.arrays import arrays_of
from nedbus_msgs.codecs.cdr import cdr_layout


def use_all_codecs(name: str) -> Definition[Message]:
    """Return a definition after using all of its codecs."""
    definition = define(
        name, [("timestamp", field_type("uint64")), ("q", field_type("float32[4]"))]
    )
    codec, message = codec_of(definition), definition.model(timestamp=1)
    assert codec.decode(codec.encode(message)) == message
    assert codec.decode_row(codec.encode(message))._fields == definition.names  # type: ignore[attr-defined] # a Row
    assert len(arrays_of(definition).of([message])) == 1
    assert cdr_layout(definition.current).zeros
    assert provenance_of(
        definition, encoding_of(definition, "sim", frozenset({"timestamp"}))
    ).missing == {"q"}
    assert definition.plan(definition.names).provided == definition.all_fields
    return definition


@pytest.mark.slow
def test_unused_definition_is_freed_with_its_codecs() -> None:
    """No cache keeps a definition alive; the codecs of a definition in use are cached."""
    used = use_all_codecs("Used")
    unused = [weakref.ref(use_all_codecs(f"Unused{number}")) for number in range(50)]
    gc.collect()
    assert not any(each() for each in unused)
    assert codec_of(used) is codec_of(used)
    assert arrays_of(used) is arrays_of(used)
    assert cdr_layout(used.current) is cdr_layout(used.current)
