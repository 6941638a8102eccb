"""Replay an MCAP file, paced by its log times."""

from collections.abc import Iterable, Iterator
from heapq import heappop, heappush
from typing import Final

from nedbus.errors import ConfigError, DecodeError, SourceError
from nedbus.recording import RecordedMessage, RecordedStream, RecordingReader
from nedbus_msgs import Address, decode_with

from .options import RecordedOptions
from .source import ReplayRun, SourceContext, SourceMessage

_MAX_GAP: Final = 60 * 10**9  # ns; a longer step is a pause or a damaged time, and is skipped
_REORDERED: Final = 8192  # messages in the reorder buffer
_INPUT: Final = "mcap-input"  # `sample.source` of messages to a vehicle


class McapSource:
    """An MCAP file, read chunk by chunk."""

    def __init__(self, path: str, options: RecordedOptions, context: SourceContext) -> None:
        self._path, self._default_vehicle = path, context.vehicle
        self._options, self._vehicle, self._topics = options, options.vehicle, options.chosen_topics
        self.finite, self.loop = not options.loop, options.loop
        self.speed, self.wait = options.speed, options.wait

    def open(self) -> ReplayRun:
        """Check the file; raise SourceError if it is not an MCAP file or has none of the requested topics."""
        with self._reader() as reader:
            reader.check()
        counts = {stream: count for stream, count in reader.counts.items() if self._delivers(stream)}
        definitions = {stream.address: stream.definition for stream in counts}
        addresses = sorted(definitions)
        vehicles = sorted({address.vehicle for address in addresses})
        if not addresses:
            found = ", ".join(sorted({stream.address.topic for stream in reader.counts}))
            raise SourceError(self._path, f"this recording has none of the requested topics; it has {found}")
        if self._vehicle is not None and len(vehicles) > 1:
            raise ConfigError("vehicle", f"{self._path} has several vehicles ({', '.join(vehicles)}): remove it")
        total = sum(counts.values())
        absent = self._options.absent_from({each.topic for each in addresses}, "this recording")
        return ReplayRun(
            messages=self._messages(),
            addresses={self._rename(address): definitions[address] for address in addresses},
            total=total,
            summary=f"vehicle {', '.join(vehicles[:5])}, {total} messages of {len(addresses)} streams",
            warnings=(*reader.warnings, *absent),
            damage=f"{self._path}: messages lost to damage: {'; '.join(reader.warnings)}" if reader.damaged else None,
        )

    def _reader(self) -> RecordingReader:
        return RecordingReader(self._path, vehicle=self._default_vehicle)

    def _delivers(self, stream: RecordedStream) -> bool:
        return self._topics is None or stream.address.topic in self._topics

    def _rename(self, address: Address) -> Address:
        return Address(self._vehicle, address.topic, address.instance) if self._vehicle else address

    def _messages(self) -> Iterator[SourceMessage]:
        latest, due = None, 0
        with self._reader() as reader:
            for number, recorded in _in_order(enumerate(reader.messages(), 1)):
                if not self._delivers(recorded.stream):
                    continue
                step = 0 if latest is None else recorded.logged - latest
                if 0 < step <= _MAX_GAP:
                    due += step
                if latest is None or step > 0 or step < -_MAX_GAP:
                    latest = recorded.logged
                yield self._decode(recorded, number, due / 1e9)

    def _decode(self, recorded: RecordedMessage, number: int, due: float) -> SourceMessage:
        address, definition = self._rename(recorded.stream.address), recorded.stream.definition
        try:
            fields = decode_with(definition, recorded.payload, recorded.stream.layout)
        except DecodeError as exc:
            error = f"message {number} of the recording: {exc}"
            return SourceMessage(due, address, {}, error=error, definition=definition)
        for name in recorded.stream.missing & definition.all_fields:
            fields.pop(name, None)
        source = _INPUT if recorded.stream.is_input else None
        return SourceMessage(due, address, fields, definition=definition, source=source)


def _in_order(messages: Iterable[tuple[int, RecordedMessage]]) -> Iterator[tuple[int, RecordedMessage]]:
    """Yield messages in order of log time; writers batch a few hundred messages of one stream at a time.

    When time goes back by more than _MAX_GAP (a damaged time, another clock), flush the buffer first.
    """
    waiting: list[tuple[int, int, RecordedMessage]] = []
    newest = 0
    for number, recorded in messages:
        if recorded.logged < newest - _MAX_GAP:
            while waiting:
                yield heappop(waiting)[1:]
            newest = 0
        newest = max(newest, recorded.logged)
        heappush(waiting, (recorded.logged, number, recorded))
        if len(waiting) > _REORDERED:
            yield heappop(waiting)[1:]
    while waiting:
        yield heappop(waiting)[1:]
