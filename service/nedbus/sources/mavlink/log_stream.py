"""Decoder of one vehicle's ULog stream: chunks in, messages out; measures losses and delay, and saves the stream."""

import logging
import math
import os
import struct
import time
from collections import deque
from collections.abc import Collection, Generator, Iterable, Iterator, Mapping
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import BinaryIO, Final

from nedbus import clock, limits, ulog
from nedbus.errors import OutputError
from nedbus.log_event import about
from nedbus.mavlink import Chunk
from nedbus.samples import LogStreamStatus, Rejection, SourceMessage
from nedbus.sources.options import MavlinkOptions
from nedbus_msgs import DEFAULT_TOPIC, Address

from .log_client import LogStatus, LogStreamClient
from .saved_stream import StreamFile

_log = logging.getLogger(__name__)

# `sample.source` of the stream's messages; converted messages have `mavlink`
_SOURCE: Final = "mavlink-ulog"
_CHUNK_SIZE: Final = 249  # bytes of a LOGGING_DATA
_DATA_HEADER: Final = 5  # bytes of a record before its message
_WINDOW: Final = 1.0  # s over which rate and delay are measured
_FILE_HEADER: Final = 16  # bytes
_RECORD_HEADER: Final = 3  # bytes: the size of the rest, and the type
_DROPOUT: Final = struct.Struct("<HBH")  # a record of type O: duration [ms]
_LONGEST_DROPOUT: Final = 2**16 - 1  # ms
_FILE_INTERVAL: Final = 5.0  # s between two files of a vehicle
_MIN_SIZES: Final = 100  # messages until their mean size can be known
_TOLERANCE: Final = 0.02  # of the mean size


class LogStream:
    """ULog stream of one vehicle, used on the thread of the source; `client` is used on the thread of the link.

    `state`: the state file of the stream.
    """

    def __init__(
        self,
        name: str,
        options: MavlinkOptions,
        client: LogStreamClient,
        state: StreamFile | None = None,
    ) -> None:
        self.state = state or StreamFile(None, 0)
        self._name = name
        self._client = client
        self._address = Address(name, DEFAULT_TOPIC)
        self._topics = options.chosen_topics
        self._folder = Path(options.save).expanduser() if options.save else None
        self._file: LogFile | None = None
        # time of the next file, because a vehicle may send one header after another
        self._next_file = -math.inf
        # the stream before its file: gaps [s], and what follows
        self._pending: deque[tuple[float, bytes]] = deque()
        self._pending_size = 0  # bytes
        self._unsaved = 0  # bytes
        self._is_pending = False
        self._logged = LogStatus("idle")
        self._streamed: set[Address] = set()
        self._received = 0  # bytes
        self._gaps = 0
        self._lost = 0  # LOGGING_DATA
        self._undecodable = 0
        self._sizes = _MeanSize()  # of data messages, which estimates the number of lost ones
        self._lost_messages = 0
        self._last_chunk: float | None = None
        self._unreported = 0  # losses to report with the next message
        # times of unanswered TIMESYNC requests [ns]
        self._requests: deque[int] = deque(maxlen=limits.TIMESYNC_REQUESTS)
        self._window_start = 0.0
        self._window_bytes = 0
        self._rate = 0.0  # bytes/s
        self._delays = 0.0  # s, sum of those in the window
        self._delayed = 0
        self._delay: float | None = None
        self._restart()

    def _restart(self) -> None:
        """Discard the definitions and the clock offset, because the vehicle may have rebooted."""
        self._streamed.clear()
        self._has_data = False
        self._parser = ulog.UlogParser(verify=False)
        self._texts = ulog.LogMessageBuilder()
        self._streams: dict[ulog.Subscription, ulog.LoggedStream | None] = {}
        self._damages: set[str] = set()  # reasons for rejected records
        self._dropout = 0.0  # s that the vehicle's logger lost before the next message
        self._offset = 0.0  # vehicle clock minus host clock [s]
        self._round_trip = math.inf  # in which it was measured [s]
        self._new_header = True  # not yet logged

    def serves(self, client: LogStreamClient) -> bool:
        """Return whether this is the stream of a client."""
        return client is self._client

    @property
    def is_streaming(self) -> bool:
        """True while the stream delivers messages."""
        return self._client.status.state == "streaming"

    def delivers(self, address: Address) -> bool:
        """Return whether the stream has messages of an address, which replace those converted from MAVLink."""
        if not self.is_streaming:
            return False
        return address in self._streamed or address.topic == ulog.LOG_MESSAGE.name

    def add(self, chunk: Chunk, now: float) -> Iterator[SourceMessage | Rejection]:
        """Yield the messages that a chunk completes."""
        if chunk.begins:
            self.close()
            self._restart()
        if chunk.lost:
            self._count_gap(chunk.lost)
        self._save(chunk, now)
        if not chunk.data:
            return
        self._received += len(chunk.data)
        self._window_bytes += len(chunk.data)
        omitted = self._texts.limit.omitted
        problem = self._texts.problem
        undecodable = self._parser.undecodable
        try:
            records = self._parser.feed(chunk.data)
        except ulog.UlogError as exc:  # raised once for each stream
            self._client.reject(str(exc))
            return
        self._undecodable += self._parser.undecodable - undecodable
        sizes = [
            _DATA_HEADER + len(record.payload)
            for record in records
            if isinstance(record, ulog.Data)
        ]
        self._add_sizes(sizes)
        yield from self._check_definitions(is_first=not undecodable)
        self._save_definitions(records, now, others=len(records) - len(sizes))
        for record in self._texts.merge(records):
            if isinstance(record, ulog.Data):
                yield from self._messages(*record, now)
            elif isinstance(record, ulog.Dropout):
                self._dropout += record.duration / 1e3
            elif isinstance(record, ulog.Damage):
                yield self._reject(record.reason)
        where = f"{self._name} {ulog.LOG_MESSAGE.name}"
        omitted = self._texts.limit.omitted - omitted
        if omitted:
            reason = f"more than {limits.LOG_MESSAGES} log messages per second"
            yield Rejection(where, reason, count=omitted)
        if self._texts.problem != problem:
            yield Rejection(where, self._texts.problem, count=0)

    def _add_sizes(self, sizes: Iterable[int]) -> None:
        """Add the sizes of messages to their mean; estimate the losses of earlier gaps once it is known."""
        was_known = self._sizes.is_known
        self._sizes.add(sizes)
        if self._sizes.is_known and not was_known:
            # a stream that continues that of an earlier process begins with a gap
            self._estimate_lost()

    def _messages(
        self, subscription: ulog.Subscription, payload: bytes, now: float
    ) -> Iterator[SourceMessage | Rejection]:
        """Yield the message of a data record, unless its topic is not read, and what is rejected on the way."""
        if subscription not in self._streams:
            yield from self._open_stream(subscription)
        stream = self._streams[subscription]
        if stream is None:
            return
        given = None
        if stream.converted or subscription.layout.has_unset_bools(payload):
            given = yield from self._decode(stream, payload)
        yield self._message(stream, payload, given, now)

    def _reject(self, reason: str) -> Rejection:
        """Return the rejection of a damaged record; all beyond the first 100 reasons have the same one."""
        if len(self._damages) < limits.DAMAGE_REASONS:
            self._damages.add(reason)
        if reason not in self._damages:
            reason = "further damage"
        return Rejection(f"{self._name} ULog stream", reason)

    def _check_definitions(self, *, is_first: bool) -> Iterator[Rejection]:
        """Report messages without a definition once; reject a continued stream if a definition does not match."""
        if self._parser.mismatched and self._client.header_seconds is None:
            self._client.reject("its definitions changed while no process received it")
        elif self._parser.undecodable and is_first:
            reason = "messages of topics whose definitions were lost are counted as undecodable until the next stream"
            yield Rejection(f"{self._name} ULog stream, topics", reason, count=0)

    def request_time(self) -> int:
        """Return the time to send in a TIMESYNC request, by which its answer is recognised [ns]."""
        self._requests.append(time.monotonic_ns())
        return self._requests[-1]

    def add_timesync(self, vehicle_time: int, sent: int, now: float) -> None:
        """Measure the clock offset from an answer to TIMESYNC, unless another client on the link sent the request.

        The shortest round trip is the most exact, unless a later one disproves it, as after a reboot.
        """
        if sent not in self._requests:
            return
        self._requests.remove(sent)
        round_trip = now - sent / 1e9
        offset = vehicle_time / 1e9 - (now - round_trip / 2)
        tolerance = (round_trip + self._round_trip) / 2
        if round_trip <= self._round_trip or abs(offset - self._offset) > tolerance:
            self._offset = offset
            self._round_trip = round_trip

    def add_delay(self, timestamp: object, now: float) -> None:
        """Measure the age of a message that is published at time `now`, by the vehicle's clock."""
        if self._round_trip < math.inf and isinstance(timestamp, int):
            self._delays += now + self._offset - timestamp / 1e6
            self._delayed += 1

    def log_changes(self) -> None:
        """Log changes of the stream's state; clear the list of streamed addresses at its end."""
        status = self._client.status
        if not self.is_streaming:
            self._streamed.clear()
        if status[:2] == self._logged[:2]:
            return
        self._logged = status
        extra = about("log_stream", self._address)
        if status.state == "streaming":
            text = f"vehicle %s: receiving the ULog stream{self._how_it_began()}"
            _log.info(text, self._name, extra=extra)
        elif status.reason == "left":
            _log.info("vehicle %s: %s", self._name, status.text, extra=extra)
        elif status.reason is not None:
            extra = about("log_stream", self._address, reason=status.text)
            _log.warning("vehicle %s: no ULog stream; %s", self._name, status.text, extra=extra)

    def _how_it_began(self) -> str:
        """Return what to add to the log of a stream that arrives."""
        if not self._new_header:
            return " again"
        self._new_header = False
        header = self._client.header_seconds
        if header is None:
            return "; it continues the one of an earlier process"
        return f"; the log on the SD card lacks the {header:.1f} s in which the header was sent"

    def status(self, now: float) -> LogStreamStatus:
        """Return the status, with rate and delay measured since the last call."""
        if self._file is not None and not self._file.exists:
            self._stop_saving(f"{self._file.path} was deleted")
        seconds = now - self._window_start
        if seconds >= _WINDOW:
            self._rate = self._window_bytes / seconds
            self._delay = self._delays / self._delayed if self._delayed else None
            self._window_start = now
            self._window_bytes = 0
            self._delays = 0.0
            self._delayed = 0
        self._estimate_lost()  # a gap may precede the first message
        state = self._client.status
        saved = ""
        if self._file is not None and state.state != "refused":
            saved = str(self._file.path)
        return LogStreamStatus(
            vehicle=self._name,
            state=state.state,
            reason=state.text,
            received=self._received,
            rate=self._rate,
            delay=self._delay,
            header_time=self._client.header_seconds,
            gaps=self._gaps,
            lost=self._lost,
            lost_messages=self._lost_messages,
            undecodable=self._undecodable,
            saved=saved,
            unsaved=self._unsaved,
        )

    def leave(self) -> None:
        """Before `LogStreamClient.stop`: leave the stream of an armed vehicle running if its state is saved."""
        if self.state.is_current:
            self._client.leave()

    def end(self) -> None:
        """Close all files; delete the state of a stream that was stopped."""
        self.log_changes()
        self.state.close(remove=self._client.status[:2] == ("stopped", None))
        self.close()

    def close(self) -> None:
        """Close the saved file."""
        if self._has_data:
            self._unsaved += self._pending_size
        self._pending.clear()
        self._pending_size = 0
        self._is_pending = False
        if self._file is not None:
            self._file.close()
            self._file = None

    def _open_stream(self, subscription: ulog.Subscription) -> Iterator[Rejection]:
        """Add the stream of a subscription; None if it is not selected or not publishable."""
        stream: ulog.LoggedStream | None = None
        if self._topics is None or subscription.name in self._topics:
            try:
                stream = ulog.LoggedStream(self._name, subscription)
            except ValueError as exc:  # such as AddressError
                yield Rejection(f"{self._name} {subscription.name}", str(exc))
        self._streams[subscription] = stream

    def _message(
        self,
        stream: ulog.LoggedStream,
        payload: bytes,
        given: Mapping[str, object] | None,
        now: float,
    ) -> SourceMessage:
        address = stream.address
        self._streamed.add(address)
        lost = self._unreported
        self._unreported = 0
        dropout = self._dropout
        self._dropout = 0.0
        return SourceMessage(
            0.0,
            address,
            given,
            lost,
            False,
            None,
            stream.definition,
            _SOURCE,
            dropout,
            stream,
            payload,
            arrived=now,
        )

    def _decode(
        self, stream: ulog.LoggedStream, payload: bytes
    ) -> Generator[Rejection, None, Mapping[str, object] | None]:
        """Return the fields of a message if they must be converted, and yield any new warnings about them."""
        topic = stream.subscription.name
        reported = len(stream.omitted)
        given = stream.decode(payload) if stream.converted else None
        for name, reason in islice(stream.omitted.items(), reported, None):
            yield Rejection(f"{self._name} {topic}.{name}", reason, count=0)
        count = stream.subscription.layout.count_unset_bools(payload)
        if count:
            reason = f"{ulog.UNSET_BOOLS.format(topic)} ({count} in the first such message)"
            yield Rejection(f"{self._name} {topic}", reason, count=0)
        return given

    def _count_gap(self, lost: int) -> None:
        self._gaps += 1
        self._lost += lost
        self._estimate_lost()
        self._parser.gap()

    def _estimate_lost(self) -> None:
        """Update the number of lost messages: each gap cuts one, and covers others by their mean size so far.

        The number never decreases, so the others count only once the mean size is known.
        """
        covered = 0.0
        if self._sizes.is_known:
            covered = _CHUNK_SIZE * self._lost / self._sizes.mean
        before = self._lost_messages
        self._lost_messages = max(self._lost_messages, round(self._gaps + covered))
        self._unreported += self._lost_messages - before

    def _save(self, chunk: Chunk, now: float) -> None:
        """Save a chunk; after an error stop saving, but continue publishing."""
        gap = 0.0
        if chunk.lost and self._last_chunk is not None:
            gap = now - self._last_chunk
        self._last_chunk = now
        if chunk.begins:
            self._is_pending = True
        if self._is_pending:
            self._pending.append((gap, chunk.data))
            self._pending_size += len(chunk.data)
            limit = limits.LOG_STREAM_PENDING
            if self._pending_size > limit:
                self._stop_saving(
                    f"the stream has more than {limit} bytes before its first message"
                )
        elif self._file is not None:
            self._write(self._file, [(gap, chunk.data)])
        elif self._folder is not None:
            self._unsaved += len(chunk.data)

    def _write(self, file: "LogFile", parts: Iterable[tuple[float, bytes]]) -> None:
        unsaved = deque(parts)
        try:
            while unsaved:
                gap, data = unsaved[0]
                if gap:
                    file.mark_gap(gap)
                file.write(data)
                unsaved.popleft()
        except OSError as exc:
            self._unsaved += sum(len(data) for _, data in unsaved)
            self._stop_saving(str(OutputError(file.path, exc)))

    def _save_definitions(self, records: Iterable[ulog.Record], now: float, *, others: int) -> None:
        """Update the state file; create the log file with the first message, but not more often than every 5 s.

        `others`: number of records that are not data messages.
        """
        if self._has_data and not (self._is_pending or others):
            return
        for record in records:
            if isinstance(record, ulog.Data) and not self._has_data:
                self._has_data = True
                definitions = [data for _, data in self._pending]
                self.state.write(b"".join(definitions[:-1]))  # the last chunk has the message
            elif isinstance(record, ulog.Subscription) and self._has_data:
                self.state.append(_packed(record))
        if not (self._has_data and self._is_pending):
            return
        if self._folder is not None and now < self._next_file:
            return
        pending = self._pending
        self._pending = deque()
        self._pending_size = 0
        self._is_pending = False
        if self._folder is not None:
            self._next_file = now + _FILE_INTERVAL
            self._open_file(self._folder, pending)

    def _open_file(self, folder: Path, pending: Collection[tuple[float, bytes]]) -> None:
        try:
            self._file = LogFile(folder, self._name)
        except OSError as exc:
            self._unsaved += sum(len(data) for _, data in pending)
            self._stop_saving(str(OutputError(Path(exc.filename), exc)))
            return
        extra = about("log_stream", self._address)
        text = "vehicle %s: saving the ULog stream to %s"
        _log.info(text, self._name, self._file.path, extra=extra)
        self._write(self._file, pending)

    def _stop_saving(self, reason: str) -> None:
        self.close()
        extra = about("log_stream", self._address, reason=reason)
        text = "vehicle %s: stopped saving the ULog stream: %s"
        _log.error(text, self._name, reason, extra=extra)


def _packed(subscription: ulog.Subscription) -> bytes:
    """Return the ULog record of a subscription."""
    ids = struct.pack("<BH", subscription.multi_id, subscription.message_id)
    body = ids + subscription.name.encode()
    return struct.pack("<HB", len(body), ord("A")) + body


class _MeanSize:
    """Mean size of messages [bytes]; known when its standard error is at most 2 %.

    In recordings of PX4, with topics of 20 to 1,000 bytes, it is then within 10 % of that of a gap before: the mean of
    the first five messages is up to 2.6 times too small.
    """

    def __init__(self) -> None:
        self._count = 0
        self._sum = 0
        self._squares = 0
        self.is_known = False

    def add(self, sizes: Iterable[int]) -> None:
        """Add the sizes of messages."""
        for size in sizes:
            self._count += 1
            self._sum += size
            self._squares += size * size
        if not self.is_known and self._count >= _MIN_SIZES:
            variance = max(0.0, self._squares / self._count - self.mean**2)
            self.is_known = math.sqrt(variance / self._count) <= _TOLERANCE * self.mean

    @property
    def mean(self) -> float:
        """The mean size."""
        return self._sum / self._count


class LogFile:
    """One stream in a new `<vehicle>_<UTC>.ulg`, which ends with a complete record after each call.

    Raises OSError, such as on a full disk.
    """

    def __init__(self, folder: Path, vehicle: str) -> None:
        self.path, self._file = _create(folder, vehicle)
        self._size = 0
        self._partial = bytearray()  # the last record, until it is complete
        self._begins = True

    @property
    def exists(self) -> bool:
        """Whether the file is still in a folder."""
        return os.fstat(self._file.fileno()).st_nlink > 0

    def write(self, data: bytes) -> None:
        """Append bytes of the stream; only whole records reach the file."""
        self._partial += data
        end = 0  # of the last complete record
        stop = _FILE_HEADER if self._begins else 0
        while stop <= len(self._partial):
            end = stop
            stop += _RECORD_HEADER + int.from_bytes(self._partial[stop : stop + 2], "little")
        if end:
            self._begins = False
        self._append(bytes(self._partial[:end]))
        del self._partial[:end]

    def mark_gap(self, seconds: float) -> None:
        """Discard the record that the gap truncated, and write a dropout of this duration."""
        self._partial.clear()
        if self._begins:
            return
        milliseconds = max(1, min(_LONGEST_DROPOUT, round(seconds * 1000)))
        self._append(_DROPOUT.pack(2, ord("O"), milliseconds))

    def _append(self, records: bytes) -> None:
        """Write complete records; if only a part can be written, remove it again."""
        written = 0
        try:
            while written < len(records):
                written += self._file.write(records[written:])
        except OSError:
            self._file.truncate(self._size)
            raise
        self._size += written

    def close(self) -> None:
        """Close the file. Idempotent."""
        with suppress(OSError):
            self._file.close()


def _create(folder: Path, vehicle: str) -> tuple[Path, BinaryIO]:
    folder.mkdir(parents=True, exist_ok=True)
    name = f"{vehicle}_{clock.now():%Y-%m-%d_%H-%M-%S}"
    path = folder / f"{name}.ulg"
    for number in range(2, limits.SAME_NAMES):
        with suppress(FileExistsError):
            return path, path.open("xb", buffering=0)
        path = folder / f"{name}_{number}.ulg"
    return path, path.open("xb", buffering=0)
