"""Convert a log to a recording, message by message, validated."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from operator import itemgetter
from pathlib import Path
from typing import Any, Final, Protocol

from pydantic import ValidationError

from nedbus.errors import OutputError
from nedbus.log_event import about
from nedbus.whole_file import whole_file
from nedbus_msgs import BY_TOPIC, Address, Definition, Message, Provenance, describe, upgrade_with
from nedbus_msgs.arrays import arrays_of

from .flight_files import check_recording
from .writer import Encoded, RecordingWriter

_log = logging.getLogger(__name__)

_MAX_TIME: Final = 2**64 - 1  # ns: a damaged log may have any timestamp
_MAX_START: Final = 2**63  # ns: what follows must fit as well
_CHUNK: Final = 1024  # messages that are written together
_CHUNK_SIZE: Final = 2**18  # bytes: what damage costs, some seconds of a flight
_MAX_LOGGED: Final = 5  # rejected messages that are logged


class ConvertibleMessage(Protocol):
    """A message of a source: when it is due [s], its address and its fields, or why it cannot be decoded."""

    @property
    def due(self) -> float: ...  # noqa: D102
    @property
    def address(self) -> Address: ...  # noqa: D102
    @property
    def fields(self) -> Mapping[str, object]: ...  # noqa: D102
    @property
    def error(self) -> str | None: ...  # noqa: D102
    @property
    def definition(self) -> Definition[Any] | None: ...  # noqa: D102


def convert(
    messages: Iterable[ConvertibleMessage],
    path: Path,
    *,
    source: str,
    on_progress: Callable[[int], object],
    flight: str = "flight.ulg",
) -> str:
    """Write messages to a new MCAP file and return a summary; without success there is no file.

    A message is published at PX4's own time, and recorded when it is due, from the first one's time on.
    `source` is the kind of source that they come from; `on_progress` gets the number of messages handled so far,
    and `flight` is the file that the hint of an error names.

    Raises ConfigError for another suffix than .mcap, OutputError when the file exists already or cannot be written.
    """
    check_recording(path, flight=flight)
    try:
        with whole_file(path) as part:
            return _write(messages, part, source=source, on_progress=on_progress)
    except OSError as exc:
        cause = exc.__cause__ if isinstance(exc, OutputError) else exc
        raise OutputError(path, cause if isinstance(cause, OSError) else exc) from exc


def _write(
    messages: Iterable[ConvertibleMessage], path: Path, *, source: str, on_progress: Callable[[int], object]
) -> str:
    pending: dict[Definition[Any], list[tuple[Address, Provenance, Message, int]]] = {}
    count, rejected, start = 0, 0, None
    with RecordingWriter(path, chunk_size=_CHUNK_SIZE) as writer:

        def write_pending() -> None:
            encoded: list[Encoded] = []
            for definition, waiting in pending.items():
                addresses, provenances, written, logged = zip(*waiting, strict=True)
                published = [min(message.timestamp * 1000, _MAX_TIME) for message in written]
                streams = zip(addresses, provenances, strict=True)
                array = arrays_of(definition).of(written)
                encoded += writer.encode(array, definition, streams, logged=logged, published=published)
            writer.add(sorted(encoded, key=itemgetter(0)))  # whoever replays the file reads it from begin to end
            pending.clear()

        for done, each in enumerate(messages, 1):
            definition = each.definition or BY_TOPIC[each.address.topic]
            try:
                message = upgrade_with(definition, each.fields)
            except ValidationError as exc:
                rejected += 1
                if rejected <= _MAX_LOGGED:
                    reason = each.error or describe(exc, definition)
                    extra = about("rejected", each.address, source=source, reason=reason)
                    _log.warning("%s rejected: %s", each.address, reason, extra=extra)
                continue
            if start is None:
                start = min(message.timestamp * 1000, _MAX_START)
            provenance = Provenance(source, definition.all_fields - message.model_fields_set)
            waiting = each.address, provenance, message, start + round(each.due * 1e9)
            pending.setdefault(definition, []).append(waiting)
            count += 1
            if count % _CHUNK == 0:
                write_pending()
                on_progress(done)
        write_pending()
    return f"{writer.messages} messages" + (f", {rejected} rejected" if rejected else "")
