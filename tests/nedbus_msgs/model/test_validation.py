"""Fast path of validation: the printed examples of its generated code are what is compiled."""

from collections.abc import Mapping
from typing import Any

import pytest

from nedbus_msgs import FieldType, field_type
from nedbus_msgs.model import validation
from tests.nedbus_msgs.docstrings import printed_block, printed_inline

TIMES_QUATERNION_TEXT = [
    field_type(name) for name in ("uint64", "uint64", "float32[4]", "char[10]")
]


@pytest.fixture
def sources(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Record the source of each function that is compiled."""
    recorded: list[str] = []

    def record(source: str, *arguments: Any) -> Any:
        recorded.append(source)
        return compile(source, *arguments)

    monkeypatch.setattr(validation, "compile", record, raising=False)
    return recorded


def types_of(**types: str) -> Mapping[str, FieldType]:
    return {name: field_type(kind) for name, kind in types.items()}


def test_printed_flat_and_restored_values_are_what_is_compiled() -> None:
    """The docstrings show the expressions for two times, a quaternion and a text; one reverses the other."""
    flat = validation._flat_values(TIMES_QUATERNION_TEXT)
    assert flat == printed_inline(validation._flat_values)
    restored = validation._restored_values(TIMES_QUATERNION_TEXT)
    assert restored == printed_inline(validation._restored_values)
    kinds = dict(zip("abcd", TIMES_QUATERNION_TEXT, strict=True))
    built = validation.Validation(kinds, ())
    values = (1, 2, (0.5, 0.5, 0.5, 0.5), "text")
    assert built.flatten(values) == (1, 2, 0.5, 0.5, 0.5, 0.5, b"text")
    assert built.unflatten((1, 2, 0.5, 0.5, 0.5, 0.5, b"text\0?")) == values


def test_printed_assignment_of_a_row_is_what_is_compiled(sources: list[str]) -> None:
    """The docstring shows the function for two fields."""
    by_name = validation._compile_by_name(types_of(timestamp="uint64", q="float32[2]"))
    assert sources == [printed_block(validation._compile_by_name)]
    assert by_name((1, (2.0, 3.0))) == {"timestamp": 1, "q": (2.0, 3.0)}


def test_printed_assignment_of_a_rounded_row_is_what_is_compiled(sources: list[str]) -> None:
    """The docstring shows the function for a time, an array and a text; it rounds the elements to float32."""
    built = validation.Validation(types_of(t="uint64", q="float32[2]", s="char[10]"), ())
    sources.clear()
    rounded = built.rounded_by_name((1, (0.1, 3.0), "text"))
    assert sources == [printed_block(validation._compile_rounded_by_name)]
    assert rounded == {"t": 1, "q": (0.10000000149011612, 3.0), "s": "text"}
