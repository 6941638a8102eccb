"""Recordings: the local position topics of an MCAP file, as they were published."""

from __future__ import annotations

from collections.abc import Iterator

from nedbus.errors import ConfigError, SourceError
from nedbus.playback import Playback
from nedbus_msgs import FIELD_TYPES, Address, decode_cdr

from .record import Flight, Home, Record
from .spec import RecordedOptions


class McapSource:
    """An MCAP file, read one chunk at a time."""

    def __init__(self, path: str, options: RecordedOptions, home: Home) -> None:
        self._path = path
        self._vehicle = options.vehicle
        self._default_vehicle = home.vehicle
        self.finite = not options.loop
        self.loop = options.loop
        self.speed = None if options.speed == "max" else options.speed
        self.wait = options.wait

    def open(self) -> Flight:
        """Look at the file; raise SourceError when it is no MCAP, or has none of the topics."""
        playback = Playback(self._path, vehicle=self._default_vehicle)
        addresses = sorted({stream.address for stream in playback.counts})
        vehicles = sorted({address.vehicle for address in addresses})
        if not addresses:
            playback.close()
            raise SourceError(self._path, "no message of the local position topics is in this recording")
        if self._vehicle is not None and len(vehicles) > 1:
            playback.close()
            raise ConfigError("vehicle", f"{self._path} has several vehicles ({', '.join(vehicles)}): leave it out")
        total = sum(playback.counts.values())
        return Flight(
            records=self._records(playback),
            addresses=tuple(sorted({self._rename(address) for address in addresses})),
            total=total,
            summary=f"vehicle {', '.join(vehicles[:5])}, {total} messages of {len(addresses)} streams",
            warnings=tuple(playback.warnings),
        )

    def _rename(self, address: Address) -> Address:
        return Address(self._vehicle, address.topic, address.instance) if self._vehicle else address

    def _records(self, playback: Playback) -> Iterator[Record]:
        start, due = None, 0.0
        with playback:
            for played in playback.messages():
                if start is None:
                    start = played.published
                due = max(due, (played.published - start) / 1e9)
                fields = decode_cdr(played.payload, layout=played.stream.layout)
                for name in played.stream.missing & FIELD_TYPES.keys():
                    fields.pop(name, None)
                yield Record(due, self._rename(played.stream.address), fields)
