"""Replay the local position topics of an MCAP file, at the times at which they were published."""

from __future__ import annotations

from collections.abc import Iterator

from nedbus.errors import ConfigError, SourceError
from nedbus.recording import RecordingReader
from nedbus_msgs import FIELD_TYPES, Address, decode_cdr

from .options import RecordedOptions
from .source import ReplayRun, SourceContext, SourceMessage


class McapSource:
    """An MCAP file, read one chunk at a time."""

    def __init__(self, path: str, options: RecordedOptions, context: SourceContext) -> None:
        self._path = path
        self._vehicle = options.vehicle
        self._default_vehicle = context.vehicle
        self.finite = not options.loop
        self.loop = options.loop
        self.speed = None if options.speed == "max" else options.speed
        self.wait = options.wait

    def open(self) -> ReplayRun:
        """Read the file's index; raise SourceError when it is not an MCAP file, or has none of the topics."""
        reader = RecordingReader(self._path, vehicle=self._default_vehicle)
        addresses = sorted({stream.address for stream in reader.counts})
        vehicles = sorted({address.vehicle for address in addresses})
        if not addresses:
            reader.close()
            raise SourceError(self._path, "no message of the local position topics is in this recording")
        if self._vehicle is not None and len(vehicles) > 1:
            reader.close()
            raise ConfigError("vehicle", f"{self._path} has several vehicles ({', '.join(vehicles)}): leave it out")
        total = sum(reader.counts.values())
        return ReplayRun(
            messages=self._messages(reader),
            addresses=tuple(sorted({self._rename(address) for address in addresses})),
            total=total,
            summary=f"vehicle {', '.join(vehicles[:5])}, {total} messages of {len(addresses)} streams",
            warnings=tuple(reader.warnings),
        )

    def _rename(self, address: Address) -> Address:
        return Address(self._vehicle, address.topic, address.instance) if self._vehicle else address

    def _messages(self, reader: RecordingReader) -> Iterator[SourceMessage]:
        start, due = None, 0.0
        with reader:
            for recorded in reader.messages():
                if start is None:
                    start = recorded.published
                due = max(due, (recorded.published - start) / 1e9)
                fields = decode_cdr(recorded.payload, layout=recorded.stream.layout)
                for name in recorded.stream.missing & FIELD_TYPES.keys():
                    fields.pop(name, None)
                yield SourceMessage(due, self._rename(recorded.stream.address), fields)
