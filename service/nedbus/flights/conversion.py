"""Convert flights to an MCAP recording, validating each message."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Final

from pydantic import ValidationError

from nedbus.atomic_write import atomic_write
from nedbus.errors import ConfigError, OutputError, SourceError
from nedbus.extras import import_optional
from nedbus.log_event import about
from nedbus.samples import SourceMessage
from nedbus_msgs import (
    BY_TOPIC,
    Address,
    Message,
    Provenance,
    check_vehicle,
    describe,
    upgrade_with,
    vehicle_name,
)
from nedbus_msgs.text import counted

from .flight import Flight, boot_utc_of, open_messages
from .readers import ReadOptions, check_recording
from .selection import absent_topics, parse_topics, topics_of

if TYPE_CHECKING:
    from .writer import RecordingWriter

_log = logging.getLogger(__name__)

_LATEST_START: Final = 2**63  # ns; leaves room for later times in 64 bits
_CHUNK: Final = 1024  # messages per write
_CHUNK_BYTES: Final = 2**18  # per MCAP chunk: damage to one loses a few seconds of a typical flight
_LOGGED: Final = 5  # rejected messages of a file; all are counted


@dataclass(frozen=True, slots=True)
class Conversion:
    """What `nedbus.convert` has done.

    `summary`: the numbers of messages written and rejected, as text. `warnings`: damage to the files, with the parts
    that were skipped, and requested topics that they lack. `damaged`: messages were lost by damage.
    """

    summary: str
    warnings: tuple[str, ...]
    damaged: bool


def convert_files(
    source: str | Path | Sequence[str | Path],
    output: str | Path,
    *,
    topics: str | Sequence[str] = (),
    vehicle: str | int | None = None,
    on_progress: Callable[[int, int], object] = lambda done, total: None,
) -> Conversion:
    """Convert flight logs to an MCAP recording, as `nedbus convert` does; every message is validated.

    `source`: a .ulg log, an .mcap recording or a .tlog, or several, which are merged by UTC. `output`: a new file,
    whose name ends with .mcap. `topics`: topics or names of messages, "*" for all; by default those of all built-in
    messages. `vehicle`: the vehicle id for a log of one vehicle. `on_progress`: called with the number of bytes read so
    far, and that of all.

    Raises the errors of `nedbus.open` for the files, AddressError for an invalid topic or vehicle, ConfigError for an
    output with another suffix, or `vehicle` with several files, OutputError if the output exists or cannot be written,
    SourceError if all messages are rejected. No partial file is left behind. Needs the extra `mcap`, else raises
    ConfigError.
    """
    sources = [source] if isinstance(source, str | Path) else source
    paths = [Path(path).expanduser() for path in sources]
    _load_writer()  # raises ConfigError without the extra, before the files are read
    names = parse_topics(topics if isinstance(topics, str) else ",".join(topics))
    if vehicle is None:
        name = None
    else:
        name = check_vehicle(vehicle_name(vehicle))
        if len(paths) > 1:
            raise ConfigError("vehicle", "one id would join several files; remove this option")
    with open_messages(paths, ReadOptions(topics_of(names), name)) as flight:
        summary = convert_flight(flight, Path(output).expanduser(), on_progress=on_progress)
        known = {address.topic for address in flight.definitions}
        absent = absent_topics(names, known, "this file")
    warnings = [*flight.warnings]
    warnings += [f"{paths[0]}: {text}" for text in absent]
    return Conversion(summary, tuple(warnings), flight.damaged)


def convert_flight(flight: Flight, path: Path, *, on_progress: Callable[[int, int], object]) -> str:
    """Write the messages of a flight to a new MCAP file as `convert` does, and return a summary.

    `on_progress`: called with the number of bytes read so far, and that of the files.
    """
    readers = flight._readers
    total = sum(reader.total for reader in readers)
    return convert(
        flight._messages(),
        path,
        boot_utc=boot_utc_of(readers),
        starts=flight._first_stamps,
        on_progress=lambda _: on_progress(sum(reader.position for reader in readers), total),
    )


def convert(
    messages: Iterable[SourceMessage],
    path: Path,
    *,
    source: str = "",
    boot_utc: int = 0,
    starts: Mapping[str, int] | None = None,
    on_progress: Callable[[int], object],
) -> str:
    """Write the messages of a replay to a new MCAP file and return a summary; leave no file behind on failure.

    The publish time of a message is its PX4 timestamp; its log time is that of the first message, by the
    vehicle's clock, plus `at`.
    `source`: the kind of source of messages that name none. `boot_utc`: Unix time of the boot [us].
    `starts`: the timestamp of each vehicle at the first message [us].
    `on_progress`: called with the number of messages handled so far.

    Raises ConfigError for a suffix other than .mcap, OutputError if the file exists or cannot be written, SourceError
    if all messages are rejected.
    """
    check_recording(path)
    try:
        with atomic_write(path) as part:
            new_writer = _load_writer()
            with new_writer(
                part, chunk_size=_CHUNK_BYTES, boot_utc=boot_utc, starts=starts
            ) as writer:
                rejections = _write(
                    messages, writer, starts or {}, source=source, on_progress=on_progress
                )
                if rejections.count and not writer.messages:
                    raise SourceError(str(path), rejections.problem)
    except OSError as exc:  # an OutputError names the temporary file
        if isinstance(exc.__cause__, OSError):
            cause = exc.__cause__
        else:
            cause = exc
        raise OutputError(path, cause) from exc
    written = counted(writer.messages, "message")
    if rejections.count:
        return f"{written}, {rejections.count} rejected"
    return written


@dataclass(slots=True)
class _Rejections:
    """Number of rejected messages, and the reason of the first."""

    count: int = 0
    reason: str = ""

    @property
    def problem(self) -> str:
        """Why nothing is written."""
        return f"not written, because all {self.count} messages are rejected: {self.reason}"


def _load_writer() -> type[RecordingWriter]:
    """Import the writer, which needs the extra `mcap`; raise ConfigError without it."""
    writer: type[RecordingWriter] = import_optional("mcap", f"{__package__}.writer").RecordingWriter
    return writer


def _write(
    messages: Iterable[SourceMessage],
    writer: RecordingWriter,
    starts: Mapping[str, int],
    *,
    source: str,
    on_progress: Callable[[int], object],
) -> _Rejections:
    """Write the valid messages; return the rejected ones."""
    pending: list[tuple[Message, Address, Provenance, int]] = []
    rejections = _Rejections()
    start = None
    for done, received in enumerate(messages, 1):
        address = received.address
        definition = received.definition or BY_TOPIC[address.topic]
        try:
            message = upgrade_with(definition, received.fields)
        except ValidationError as exc:
            rejections.count += 1
            if rejections.count <= _LOGGED:
                reason = received.error or describe(exc, definition)
                rejections.reason = rejections.reason or reason
                extra = about("rejected", address, source=source, reason=reason)
                _log.warning("%s rejected: %s", address, reason, extra=extra)
            continue
        if start is None:
            first = starts.get(address.vehicle, message.timestamp)
            start = min(first * 1000, _LATEST_START)
        missing = definition.all_fields - message.model_fields_set
        provenance = Provenance(received.source or source, missing)
        logged = start + round(received.at * 1e9)
        pending.append((message, address, provenance, logged))
        if len(pending) == _CHUNK:
            writer.write_messages(pending)
            pending.clear()
            on_progress(done)
    writer.write_messages(pending)
    return rejections
