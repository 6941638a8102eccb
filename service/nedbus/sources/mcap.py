"""Replay an MCAP file, paced by its log times."""

from collections.abc import Iterable, Iterator
from heapq import heappop, heappush
from typing import Final

from nedbus.errors import ConfigError, DecodeError, SourceError
from nedbus.recording import RecordedMessage, RecordingReader
from nedbus_msgs import Address, decode_with, is_vehicle_input

from .options import RecordedOptions
from .source import ReplayRun, SourceMessage

_MAX_GAP: Final = 60 * 10**9  # ns; a longer step is a pause or a damaged time, and is skipped
_REORDER_BUFFER: Final = 8192  # messages
_INPUT: Final = "mcap-input"  # `sample.source` of messages to a vehicle


def open_mcap(path: str, options: RecordedOptions, default_vehicle: str) -> ReplayRun:
    """Check a recording for damage; raise SourceError if it is not an MCAP file or has none of the requested topics."""
    topics = options.chosen_topics
    with RecordingReader(path, vehicle=default_vehicle) as reader:
        reader.check()
    counts = {each: count for each, count in reader.counts.items() if topics is None or each.address.topic in topics}
    definitions = {stream.address: stream.definition for stream in counts}
    addresses = sorted(definitions)
    vehicles = sorted({address.vehicle for address in addresses})
    if not addresses:
        found = ", ".join(sorted({stream.address.topic for stream in reader.counts}))
        raise SourceError(path, f"this recording has none of the requested topics; it has {found}")
    if options.vehicle is not None and len(vehicles) > 1:
        raise ConfigError("vehicle", f"{path} has several vehicles ({', '.join(vehicles)}); remove this option")
    total, plural = sum(counts.values()), "s" * (len(addresses) > 1)
    absent = options.absent_from({each.topic for each in addresses}, "this recording")
    return ReplayRun(
        messages=_messages(path, options, default_vehicle),
        addresses={_rename(address, options): definitions[address] for address in addresses},
        total=total,
        summary=f"vehicle {', '.join(vehicles[:5])}, {total} messages of {len(addresses)} stream{plural}",
        warnings=(*reader.warnings, *absent),
        damage=f"{path}: some messages are lost to damage; {'; '.join(reader.warnings)}" if reader.damaged else None,
    )


def _rename(address: Address, options: RecordedOptions) -> Address:
    return Address(options.vehicle, address.topic, address.instance) if options.vehicle else address


def _messages(path: str, options: RecordedOptions, default_vehicle: str) -> Iterator[SourceMessage]:
    latest, due, topics = None, 0, options.chosen_topics
    with RecordingReader(path, vehicle=default_vehicle) as reader:
        for number, recorded in _in_order(enumerate(reader.messages(), 1)):
            if topics is not None and recorded.stream.address.topic not in topics:
                continue
            step = 0 if latest is None else recorded.logged - latest
            if 0 < step <= _MAX_GAP:
                due += step
            if latest is None or step > 0 or step < -_MAX_GAP:
                latest = recorded.logged
            yield _decode(recorded, number, due / 1e9, options)


def _decode(recorded: RecordedMessage, number: int, due: float, options: RecordedOptions) -> SourceMessage:
    address, definition = _rename(recorded.stream.address, options), recorded.stream.definition
    try:
        fields = decode_with(definition, recorded.payload, recorded.stream.layout)
    except DecodeError as exc:
        error = f"{exc} (message {number} of the recording)"
        return SourceMessage(due, address, {}, error=error, definition=definition)
    for name in recorded.stream.missing & definition.all_fields:
        fields.pop(name, None)
    source = _INPUT if is_vehicle_input(recorded.stream.ros2_topic) else None
    return SourceMessage(due, address, fields, definition=definition, source=source)


def _in_order(messages: Iterable[tuple[int, RecordedMessage]]) -> Iterator[tuple[int, RecordedMessage]]:
    """Sort messages by log time, because writers batch them by stream; flush if the time goes back by over _MAX_GAP."""
    waiting: list[tuple[int, int, RecordedMessage]] = []
    newest = 0
    for number, recorded in messages:
        if recorded.logged < newest - _MAX_GAP:
            while waiting:
                yield heappop(waiting)[1:]
            newest = 0
        newest = max(newest, recorded.logged)
        heappush(waiting, (recorded.logged, number, recorded))
        if len(waiting) > _REORDER_BUFFER:
            yield heappop(waiting)[1:]
    while waiting:
        yield heappop(waiting)[1:]
