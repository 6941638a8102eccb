"""The protocol of flight files: one reader per format yields records, each with its stream and log time."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from itertools import chain, groupby, islice
from operator import attrgetter
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol, Self

from nedbus.errors import ConfigError
from nedbus.samples import RecordStream, SourceMessage
from nedbus.timeline import Axis, Order
from nedbus.ulog import LOG_MESSAGE
from nedbus_msgs import TOPICS, Address, Definition

_PART: Final = 256  # records from which runs are formed
# messages that show the first streams of a file and the start of its clocks
_LOOKAHEAD: Final = 1000


class FileStream(RecordStream, Protocol):
    """One stream of records in a file; `lacking`: fields that a record has, but its source did not provide.

    `dtype`: argument of `numpy.dtype` for a record; None if payloads are fields by name.
    `converted`: the type of each field that `decode` converts. `strict_bools`: the fields whose bytes must be 0 or 1.
    `head`: the first bytes of each record; without them, all records have the size of `dtype`.
    """

    address: Address
    definition: Definition[Any]
    lacking: frozenset[str]
    head: bytes
    strict_bools: frozenset[str]

    @property
    def dtype(self) -> Any:
        """The layout of a record."""

    @property
    def converted(self) -> Mapping[str, Any]:
        """The type of each converted field."""

    def check(self, payload: bytes) -> str | None:
        """Return why a payload is no record of this stream, None if it is one."""


class Record(NamedTuple):
    """A message in a file: its stream, its bytes or its fields by name, and its log time [us].

    `time`: None for a log, which has only the timestamps. `error`: why the file's reader rejects it.
    """

    stream: FileStream
    payload: Any
    time: int | None
    error: str | None = None


class Run(NamedTuple):
    """Messages of one stream, in file order among those of its address; `times`: as in a record, empty for a log."""

    stream: FileStream
    payloads: list[Any]
    times: list[int]


@dataclass(frozen=True, slots=True)
class ReadOptions:
    """Options of a reader.

    `topics`: the topics to read, None for all. `vehicle`: the name for the only vehicle of a file.
    `default_vehicle`: the name for a vehicle that the file does not name.
    `layout`: the PX4 release whose layouts a recording has, if its definitions are those of another release.
    """

    topics: Collection[str] | None = frozenset(TOPICS)
    vehicle: str | None = None
    default_vehicle: str = "1"
    layout: str | None = None


class FlightReader(ABC):
    """One pass over a file, with memory independent of its size: its messages in order, or its records.

    `definitions`: the streams so far; those of an indexed file at once. `start`: when recording began, on the clock
    of the timestamps [us], 0 if unknown; `starts`: the same for each vehicle that has its own.
    `boot_utc`: Unix time of the boot [us], 0 if unknown.
    `position`, `total`: bytes read so far, and of the file. `damaged`: True if messages were lost so far.
    `kind`: the format, which becomes `sample.source`. `has_log_times`: False if messages have only timestamps.
    `order`: places the messages on the axis. `ahead`: the first messages, once `begin` has read them.
    """

    kind = ""
    has_log_times = True

    def __init__(self, path: Path, options: ReadOptions) -> None:
        self.path = path
        self.options = options
        self.definitions: dict[Address, Definition[Any]] = {}
        self.starts: dict[str, int] = {}
        self.start = 0
        self.boot_utc = 0
        self.position = 0
        self.total = 0
        self.damaged = False
        self._dropout = 0.0  # s lost by the logger before the next message
        self.order = Order[SourceMessage]()
        self.ahead: list[SourceMessage] = []
        self._messages: Iterator[SourceMessage] = iter(())
        self._is_begun = False
        self._vehicles: set[str] = set()
        self._resources: list[Any] = []  # open files

    @property
    @abstractmethod
    def warnings(self) -> list[str]:
        """Damage found and parts skipped so far."""

    @abstractmethod
    def records(self) -> Iterator[Record]:
        """Yield the records in file order, once; raise SourceError if there are none of these topics."""

    def runs(self) -> Iterator[Run]:
        """Yield the records of `records`, even rejected ones, stream by stream in parts of the file."""
        records = self.records()
        while part := [*islice(records, _PART)]:
            part.sort(key=lambda record: hash(record.stream.address))
            for stream, group in groupby(part, attrgetter("stream")):
                own = [*group]
                payloads = [record.payload for record in own]
                times = [record.time for record in own if record.time is not None]
                yield Run(stream, payloads, times)

    @property
    def remarks(self) -> list[str]:
        """What is unusual about the times of the messages so far."""
        remarks = []
        for address, count in self.order.unordered.items():
            if address.topic != LOG_MESSAGE.name:  # PX4 queues log messages
                remarks.append(f"timestamps of {address} are out of order ({count})")
        return remarks + self.order.remarks

    def begin(
        self,
        *,
        watch: Callable[[Iterator[Record]], Iterator[Record]] = iter,
        whole: Axis | None = None,
    ) -> None:
        """Read the first messages; raise SourceError, with the file closed, if there are none of these topics.

        `watch`: passes on the records, for another use of them. `whole`: the axis of all topics of the file.
        """
        # Not in the constructor: a reader of records alone is freed at once, because nothing refers back to it.
        self.order = Order[SourceMessage](self.start_of, has_log_times=self.has_log_times)
        self.order.whole = whole
        messages = self.order.arrange(map(self.message_of, watch(self.records())))
        try:
            self.ahead = list(islice(messages, _LOOKAHEAD))
        except BaseException:
            self.close()
            raise
        self._messages = chain(self.ahead, messages)
        self._is_begun = True

    def messages(self) -> Iterator[SourceMessage]:
        """Return the iterator over the messages in order, each with its time on the axis of the file.

        Raises SourceError if there are none of these topics.
        """
        if not self._is_begun:
            self.begin()
        return self._messages

    def message_of(self, record: Record) -> SourceMessage:
        """Return a record as a message, which is decoded when it is used."""
        stream, payload, time, error = record
        error = error or stream.check(payload)
        given = None
        if error:
            given = {}
        elif stream.converted:
            given = stream.decode(payload)
        if time is None:
            time = stream.timestamp(payload)[0] or 0
        dropout = self._dropout
        self._dropout = 0.0
        # By position, because keywords take a third longer for each message of a file.
        return SourceMessage(
            0.0,
            stream.address,
            given,
            0,
            False,
            error,
            stream.definition,
            self.kind,
            dropout,
            stream,
            payload,
            time,
        )

    def shrinkage(self) -> list[str]:
        """Return a list of at most one warning at the end of a file: it has fewer bytes than when it was opened."""
        if self.position >= self.total:
            return []
        self.damaged = True
        return [f"the file has shrunk from {self.total} to {self.position} bytes"]

    def start_of(self, vehicle: str) -> int:
        """Return when the recording of a vehicle began, on the clock of its timestamps [us]; 0 if unknown."""
        return self.starts.get(vehicle, self.start)

    def close(self) -> None:
        """Close the file, and discard the messages that were read ahead; a second call does nothing."""
        self._messages = iter(())
        for resource in self._resources:
            resource.close()

    def __del__(self) -> None:
        self.close()  # a replay may be discarded before its end

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def layouts(self, definition: Definition[Any]) -> set[str]:
        """Return the names of the layouts that the messages of a definition have in the file, if it defines them."""
        return set()

    def vehicle_of(self, own: str) -> str:
        """Return the name for a vehicle of the file; raise ConfigError if one name would join several vehicles."""
        if self.options.vehicle is None:
            return own
        self._vehicles.add(own)
        if len(self._vehicles) > 1:
            known = ", ".join(sorted(self._vehicles))
            problem = f"{self.path} has several vehicles ({known}); remove this option"
            raise ConfigError("vehicle", problem)
        return self.options.vehicle

    def reads(self, topic: str) -> bool:
        """Return whether the messages of a topic are to be read."""
        return self.options.topics is None or topic in self.options.topics
