"""Streaming reader of PX4 .ulg logs."""

from collections import Counter
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Final
from zlib import crc32

from nedbus import ulog
from nedbus.errors import AddressError, SourceError
from nedbus_msgs import TOPICS, Address

from .flight_files import open_flight

_CHUNK: Final = 2**17  # bytes read at a time
_MAX_NAMED: Final = 5  # damaged locations listed in the warnings
_MAX_TOPICS: Final = 10  # topics listed in an error


class UlogReader:
    """Read the messages of a log in file order, with memory independent of its size.

    `topics`: the topics to read, None for all. `vehicle`: by default the log's MAV_SYS_ID, else `default_vehicle`.
    `start`: when logging began [us]. `boot_utc`: Unix time of the boot [us], 0 if unknown. `position`: bytes read.
    `dropout`: seconds lost by the logger since the caller last reset it. `streams`: all streams with a message so far.
    `damaged`: True if damage may have cost messages so far.
    """

    def __init__(
        self, path: Path, *, topics: Collection[str] | None, vehicle: str | None, default_vehicle: str
    ) -> None:
        self._path, self._topics = path, topics
        self._vehicle, self._system_id = vehicle, default_vehicle
        self._parser, self._texts = ulog.UlogParser(verify=True), ulog.LogMessageBuilder()
        self._damages = self.start = self.boot_utc = self.position = 0
        self._warnings: list[str] = []
        self._opened: dict[ulog.Subscription, ulog.LoggedStream | None] = {}
        self._subscribed: Counter[str] = Counter()  # subscriptions of each topic
        # PX4 can log a topic twice. `_checksums`: of the messages of such topics; `_firsts`: first stream by duplicate.
        self._checksums: dict[ulog.LoggedStream, int] = {}
        self._firsts: dict[ulog.LoggedStream, ulog.LoggedStream] = {}
        self.streams: dict[Address, ulog.LoggedStream] = {}
        self._unset_bools: Counter[str] = Counter()  # by topic
        self.dropout, self.damaged, self._is_read = 0.0, False, False

    @property
    def warnings(self) -> list[str]:
        """Damage found and parts skipped so far; counts are listed once the log has been read."""
        warnings = self._warnings + [reason for stream in self.streams.values() for reason in stream.omitted.values()]
        counts = {
            "further damaged locations": self._damages - _MAX_NAMED,
            "skipped messages without a definition": self._parser.undecodable,
            "left out log messages above 100 per second": self._texts.limit.omitted,
            **{ulog.UNSET_BOOLS.format(topic): count for topic, count in self._unset_bools.items()},
        }
        warnings += [f"{text} ({count})" for text, count in counts.items() if count > 0 and self._is_read]
        return [*warnings, *filter(None, [self._texts.problem])]

    def messages(self) -> Iterator[tuple[ulog.LoggedStream, bytes]]:
        """Yield each message as its stream and payload.

        Raises SourceError if the file is not a ULog file, or has none of the topics.
        """
        streams, checksums, firsts, data = self._opened, self._checksums, self._firsts, ulog.Data
        to_int = int.from_bytes
        for records in self._records():
            for record in self._texts.merge(records):
                if not isinstance(record, data):
                    self._process(record)
                    continue
                subscription, payload = record
                try:
                    stream = streams[subscription]
                except KeyError:
                    stream = streams[subscription] = self._open(subscription)
                if stream is not None:
                    if stream in checksums:
                        checksums[stream] = crc32(payload, checksums[stream])
                    if stream not in firsts:
                        if (mask := subscription.layout.bool_mask) and to_int(payload, "little") & mask:
                            self._unset_bools[subscription.name] += subscription.layout.count_unset_bools(payload)
                        yield stream, payload
        for second, first in firsts.items():
            if checksums.get(second) != checksums.get(first):
                number = second.subscription.multi_id
                self._warnings.append(f"skipped a duplicate {second.address.topic} [{number}] with different messages")
                self.damaged |= second.address.instance is not None or number == 0
        if not self.streams:
            topics = self._topics
            what = "any topic" if topics is None else "these topics" if len(topics) < len(TOPICS) else "built-in topics"
            reason = f"this log has no message of {what}"
            if topics is not None and self._subscribed:
                names = ", ".join(sorted(self._subscribed)[:_MAX_TOPICS])
                reason += f", but of {names}; choose them by name, or all with topics=* or read(path, ['*'])"
            raise SourceError(str(self._path), "; ".join([reason, *self.warnings[:3]]))

    def _records(self) -> Iterator[list[ulog.Record]]:
        try:
            with open_flight(self._path) as file:
                while chunk := file.read(_CHUNK):
                    self.position += len(chunk)
                    yield self._parser.feed(chunk)
            yield self._parser.close()
            self._is_read = True
            self.damaged |= self._parser.undecodable > 0 or bool(self._texts.problem)
        except ulog.UlogError as exc:
            raise SourceError(str(self._path), f"not a readable ULog file ({exc})") from exc
        except OSError as exc:
            raise SourceError(str(self._path), (exc.strerror or str(exc)).lower()) from exc

    def _process(self, record: ulog.Record) -> None:
        if isinstance(record, ulog.Header):
            self.start = record.timestamp
        elif isinstance(record, ulog.Information):
            if record.key == "boot_time_utc_us" and isinstance(record.value, int):
                self.boot_utc = record.value
        elif isinstance(record, ulog.Dropout):
            self.dropout += record.duration / 1e3
        elif isinstance(record, ulog.Parameter) and record.key == "MAV_SYS_ID" and record.value in range(1, 256):
            self._system_id = str(record.value)
        elif isinstance(record, ulog.Subscription):
            self._subscribed[record.name] += 1
        elif isinstance(record, ulog.Damage):
            self._damages += not record.is_end
            self.damaged |= not record.is_end
            if self._damages <= _MAX_NAMED:
                self._warnings.append(f"{'truncated' if record.is_end else 'damaged'} ({record.reason})")

    def _open(self, subscription: ulog.Subscription) -> ulog.LoggedStream | None:
        """Return the stream of a subscription at its first message, None if it is not selected or not usable."""
        topic = subscription.name
        if self._topics is not None and topic not in self._topics:
            return None
        self._vehicle = self._vehicle or self._system_id
        try:
            stream = ulog.LoggedStream(self._vehicle, subscription)
        except ValueError as exc:
            self._warnings.append(f"skipped {topic} ({exc})")
            self.damaged |= topic in TOPICS or isinstance(exc, AddressError)
            return None
        if lacking := ", ".join(sorted(stream.definition.always.difference(stream.names))):
            self._warnings.append(f"the definition of {lacking} in {topic} [{subscription.multi_id}] is damaged")
            self.damaged = True
        if "timestamp" not in stream.names:
            return None
        if self._subscribed[topic] > 1:
            self._checksums[stream] = 0
        first = self.streams.setdefault(stream.address, stream)
        if first is not stream:
            self._firsts[stream] = first
        return stream
