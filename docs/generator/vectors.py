"""The test vectors of the wire format, docs/vectors.json: kept as they are, and completed for new messages."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from nedbus_msgs import MESSAGES, Definition, FieldType, codec_of, define, encoding_of, field_type

ROOT: Final = Path(__file__).parents[2]
VECTORS: Final = ROOT / "docs" / "vectors.json"
_GOLDEN: Final = ROOT / "tests" / "data" / "golden_messages.json"
_WIDE: Final = ("int64", "uint64")  # as strings: JSON parsers may support only doubles


def vectors_text() -> str:
    """Return the file with a vector for each message; compute the payload of entries without one."""
    vectors = json.loads(VECTORS.read_text())
    definitions: dict[str, Any] = vectors["definitions"]
    for name, golden in json.loads(_GOLDEN.read_text()).items():
        definition = MESSAGES[name]
        wire = definition.current.wire
        definitions.setdefault(f"{name}/{wire}", [[*each] for each in definition.types.items()])
        title = f"{name}: a flight"
        if title not in {each["name"] for each in vectors["exact"]}:
            message = definition.model.model_validate_json(json.dumps(golden["fields"]))
            values = to_json(message.__dict__, definition.types)
            vectors["exact"].append(
                {"name": title, "message": name, "layout": wire, "values": values}
            )
    for entry in vectors["exact"]:
        if "payload" not in entry:
            definition, provided = (
                definition_of(entry["message"], definitions),
                entry.pop("provided", None),
            )
            model = definition.model(**from_json(entry["values"], definition.types))
            entry["encoding"] = encoding_of(
                definition, "vectors", None if provided is None else frozenset(provided)
            )
            entry["missing"] = (
                []
                if provided is None
                else [each for each in definition.names if each not in provided]
            )
            entry["payload"] = codec_of(definition).encode(model).hex()
    parts = ",\n".join(
        f'"{key}": {_lines(value, "{}")}'
        if isinstance(value, dict)
        else f'"{key}": {_lines(value, "[]")}'
        for key, value in vectors.items()
    )
    return f"{{\n{parts}\n}}\n"


def definition_of(name: str, definitions: Mapping[str, Any]) -> Definition[Any]:
    """Return the definition of a message from nedbus, or from the file if nedbus does not have the message."""
    return MESSAGES.get(name) or define(
        name, ((field, field_type(kind)) for field, kind in definitions[f"{name}/0"])
    )


def to_json(fields: Mapping[str, Any], types: Mapping[str, FieldType]) -> list[Any]:
    """Return the values of a message in the format of the file."""
    return [_map(fields[name], kind, _to_json) for name, kind in types.items()]


def from_json(values: Iterable[Any], types: Mapping[str, FieldType]) -> dict[str, Any]:
    """Return the fields of a message."""
    return {
        name: _map(value, kind, _from_json)
        for value, (name, kind) in zip(values, types.items(), strict=True)
    }


def _map(value: Any, kind: FieldType, convert: Any) -> Any:
    return tuple(convert(each, kind) for each in value) if kind.is_array else convert(value, kind)


def _to_json(value: Any, kind: FieldType) -> Any:
    if isinstance(value, float) and not math.isfinite(value):
        return "NaN" if math.isnan(value) else "Infinity" if value > 0 else "-Infinity"
    return str(value) if kind.base in _WIDE else value


def _from_json(value: Any, kind: FieldType) -> Any:
    return float(value) if kind.is_float else int(value) if kind.base in _WIDE else value


def _lines(value: Any, brackets: str) -> str:
    if isinstance(value, dict):
        lines = [
            f"{json.dumps(key)}: {json.dumps(each, ensure_ascii=False)}"
            for key, each in value.items()
        ]
    else:
        lines = [json.dumps(each, ensure_ascii=False) for each in value]
    return brackets[0] + "\n" + ",\n".join(lines) + "\n" + brackets[1]
