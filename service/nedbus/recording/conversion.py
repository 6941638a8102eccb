"""Convert a log to a recording, message by message, validated."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from nedbus_msgs import Address, Provenance, VehicleLocalPosition, upgrade
from nedbus_msgs.arrays import to_array

from .writer import RecordingWriter

_MAX_TIME: Final = 2**64 - 1  # ns: a damaged log may have any timestamp
_CHUNK: Final = 1024  # messages that are written together


def convert(
    messages: Iterable[tuple[Address, Mapping[str, object]]],
    path: Path,
    *,
    source: str,
    on_progress: Callable[[int], object],
) -> str:
    """Write messages, given as address and fields, to a new MCAP file with PX4's own times; return a summary.

    `source` is the kind of source that they come from; `on_progress` gets the number of messages handled so far.

    Raises OutputError when the file exists already or cannot be written.
    """
    pending: list[tuple[Address, Provenance, VehicleLocalPosition]] = []
    rejected = 0
    with RecordingWriter(path) as writer:

        def write_pending() -> None:
            times = [min(message.timestamp * 1000, _MAX_TIME) for *_, message in pending]
            streams = ((address, provenance) for address, provenance, _ in pending)
            writer.write(to_array([message for *_, message in pending]), streams, logged=times, published=times)
            pending.clear()

        for done, (address, fields) in enumerate(messages, 1):
            try:
                message = upgrade(fields)
            except ValidationError:
                rejected += 1
                continue
            missing = frozenset(VehicleLocalPosition.model_fields.keys() - message.model_fields_set)
            pending.append((address, Provenance(source, missing), message))
            if len(pending) >= _CHUNK:
                write_pending()
                on_progress(done)
        write_pending()
    return f"{writer.messages} messages" + (f", {rejected} rejected" if rejected else "")
