"""What others on the network answer: the status of services, and layouts. No answer is trusted."""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Iterator, Sequence
from typing import Final

from nedbus.log_event import about
from nedbus.transport import RawSample, Session, query
from nedbus_msgs import ANY, schema_key, status_key

_log = logging.getLogger(__name__)

_MAX_FIELDS: Final = 256  # of a layout
_MAX_TEXT: Final = 300  # characters of a key that are logged
_MAX_ANSWER: Final = 2**18  # bytes of an answer that is read
_MAX_CONTENT: Final = 2**28  # bytes that the status of all services may take up, about: JSON is up to 32 times larger
_MAX_LAYOUTS: Final = 32  # of an answer; there are five


def find_services(session: Session, *, prefix: str, timeout: float) -> list[dict[str, object]]:
    """Return the status of every nedbus service, as it reports it; what would fill the memory is left out."""
    answers: list[RawSample] = []
    size = left_out = 0
    for raw in query(session, status_key(ANY, prefix=prefix), timeout=timeout):
        content = _size_of_content(raw)
        if len(raw.payload) <= _MAX_ANSWER and size + content <= _MAX_CONTENT:
            answers.append(raw)
            size += content
        else:
            left_out += 1
    if left_out:
        _log.warning("%d services are left out: their answers are too large", left_out, extra=about("incomplete"))
    return [status for status in _parse(answers) if isinstance(status, dict)]


def _size_of_content(raw: RawSample) -> int:
    """Return how many bytes an answer takes up at most when it is parsed, about: measured with CPython 3.11."""
    text = raw.payload.to_bytes()
    return 4 * len(text) + 150 * text.count(b"{") + 60 * text.count(b"[") + 40 * text.count(b",")


def find_layouts(session: Session, *, prefix: str) -> dict[int, Sequence[str]]:
    """Ask publishers for the field names of all layouts, by number; of different answers for one the first counts."""
    found: dict[int, Sequence[str]] = {}
    for content in _parse(query(session, schema_key(prefix=prefix), timeout=0.5, newest=False)):
        layouts = content.get("layouts") if isinstance(content, dict) else None
        for layout in layouts[:_MAX_LAYOUTS] if isinstance(layouts, list) else ():
            number = layout.get("wire") if isinstance(layout, dict) else None
            names = _field_names(layout)
            if isinstance(number, int) and names is not None:
                found.setdefault(number, names)
    return found


def _parse(answers: Iterable[RawSample]) -> Iterator[object]:
    """Yield the content of answers; the first that is not JSON is logged, as a peer may send any number."""
    logged = False
    for raw in answers:
        if len(raw.payload) > _MAX_ANSWER:
            continue
        try:
            yield json.loads(raw.payload.to_bytes())
        except (ValueError, RecursionError):
            if not logged:
                key = str(raw.key_expr)[:_MAX_TEXT]
                _log.warning("%r: an answer that is not JSON", key, extra=about("invalid", reason="no JSON"))
            logged = True


def _field_names(layout: object) -> Sequence[str] | None:
    """Return the field names of a layout that is well formed."""
    if not isinstance(layout, dict) or not isinstance(layout.get("fields"), list):
        return None
    named = [field.get("name") for field in layout["fields"] if isinstance(field, dict)]
    names = [name for name in named if isinstance(name, str)]
    return names if len(set(names)) == len(layout["fields"]) <= _MAX_FIELDS else None
