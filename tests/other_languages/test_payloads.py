"""The decoders of the documentation in other languages return the values of every test vector."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import pytest

from docs.generator.vectors import ROOT, from_json
from nedbus_msgs import FieldType, field_type
from tests.documents import blocks_of

from .programs import run_program
from .test_vectors import FILE

CASES: Final = [*FILE["exact"], *FILE["decode"]]
PROGRAMS: Final = {
    "go": ("payloads.go", "decode.go", ["github.com/vmihailenco/msgpack/v5@v5.4.1"]),
    "java": ("Payloads.java", "Payload.java", ["org.msgpack:msgpack-core:0.9.8"]),
    "javascript": ("payloads.mjs", "decode.mjs", ["msgpackr@2.1.4"]),
    "python": ("payloads.py", "decode.py", ["msgpack"]),
}


def parse(text: str, kind: FieldType) -> Any:
    """Return a printed value."""
    if kind.base == "char":
        return bytes.fromhex(text).split(b"\0")[0].decode(errors="replace").replace("\ufffd", "?")
    if kind.base == "bool":
        return {"true": True, "false": False}[text.lower()]
    return FieldType.fit(field_type(kind.base), float(text)) if kind.is_float else int(text)


@pytest.mark.long
@pytest.mark.process
@pytest.mark.timeout(420)  # packages may be downloaded and compiled
@pytest.mark.parametrize("language", PROGRAMS)
def test_decoder_of_documentation_returns_every_value(language: str, tmp_path: Path) -> None:
    """The decoder in the documentation returns every value of the vectors that it claims to read."""
    source, name, packages = PROGRAMS[language]
    blocks = [
        each.text
        for each in blocks_of(ROOT / "docs/other-languages.md")
        if each.language == language
    ]
    [snippet] = [each for each in blocks if "decode" in each.lower() and "readPosition" not in each]
    payloads = [case["payload"] for case in CASES]
    lines = run_program(source, packages, payloads, tmp_path, {name: snippet}).splitlines()
    if language == "go":
        # a uint16 of 300 in a uint8: truncated without an error, as documented
        assert lines.pop() == "<nil> 44"
    assert len(lines) == len(CASES)
    for case, line in zip(CASES, lines, strict=True):
        types = {
            each: field_type(kind)
            for each, kind in FILE["definitions"][f"{case['message']}/{case['layout']}"]
        }
        layout, *texts = line.split(" ")[1:]
        assert int(layout) == case["layout"]
        found = dict[str, Any]()
        for field, kind in types.items():
            values = tuple(
                parse(texts.pop(0), kind) for _ in range(1 if kind.is_text else kind.values)
            )
            found[field] = values if kind.is_array else values[0]
        assert not texts
        assert repr(found) == repr(from_json(case["values"], types)), case["name"]
