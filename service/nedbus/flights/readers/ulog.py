"""Streaming reader of PX4 .ulg logs."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from nedbus import limits, ulog
from nedbus.errors import AddressError, SourceError, system_reason
from nedbus_msgs import ALL, TOPICS, Address, Definition

from .formats import open_file
from .reader import FlightReader, ReadOptions, Record, Run

_CHUNK: Final = 2**15  # bytes read at a time, whose messages fit the caches
_LISTED_DAMAGES: Final = 5  # the others are counted


class UlogReader(FlightReader):
    """Read the messages of a log in file order, with memory independent of its size."""

    kind = "ulog"
    has_log_times = False

    def __init__(self, path: Path, options: ReadOptions) -> None:
        super().__init__(path, options)
        self._file = open_file(path)
        self.total = path.stat().st_size
        self._resources.append(self._file)
        self._system_id = options.default_vehicle
        self._texts = ulog.LogMessageBuilder()
        needed = None if options.topics is None else {*options.topics, *self._texts.TOPICS}
        self._parser = ulog.UlogParser(verify=True, topics=needed)
        self._damages = 0
        self._is_read = False
        self._unset_bools: Counter[str] = Counter()  # by topic
        self._warnings: list[str] = []
        self._streams: dict[ulog.Subscription, ulog.LoggedStream | None] = {}
        self._subscribed: Counter[str] = Counter()  # subscriptions of each topic
        # subscriptions of each topic and instance
        self._subscribers: Counter[tuple[str, int]] = Counter()
        # whose messages need no further checks
        self._plain: dict[ulog.Subscription, ulog.LoggedStream] = {}
        # of addresses with several subscriptions
        self._repeated: dict[ulog.LoggedStream, _Repetitions] = {}
        self._firsts: dict[Address, ulog.LoggedStream] = {}

    @property
    def warnings(self) -> list[str]:
        """Damage found, and parts and fields skipped so far; counts are listed once the log has been read."""
        warnings = [*self._warnings]
        for stream in self._streams.values():
            if stream is not None:
                warnings += stream.omitted.values()
        if self._is_read:
            warnings += self._counted_warnings()
        for repetitions in set(self._repeated.values()):
            warnings += repetitions.warnings
        for stream in self._firsts.values():
            unknown = sorted(set(stream.names) - stream.definition.known_types.keys())
            if unknown and _is_newer(stream):
                fields = ", ".join(unknown)
                text = f"left out unknown fields of {stream.address} ({fields}); update nedbus"
                warnings.append(text)
        if self._texts.problem:
            warnings.append(self._texts.problem)
        return warnings

    def _counted_warnings(self) -> list[str]:
        counts = {
            "further damaged locations": self._damages - _LISTED_DAMAGES,
            "skipped messages without a definition": self._parser.undecodable,
            "left out log messages above 100 per second": self._texts.limit.omitted,
        }
        for topic, count in self._unset_bools.items():
            counts[ulog.UNSET_BOOLS.format(topic)] = count
        return [f"{text} ({count})" for text, count in counts.items() if count > 0]

    def records(self) -> Iterator[Record]:
        """Yield the data messages; raise SourceError if the file is not a ULog file, or has none of the topics."""
        plain = self._plain
        data = ulog.Data
        make = tuple.__new__  # half the time of the constructor
        for records in self._read():
            for record in records:
                if isinstance(record, data) and record[0] in plain:
                    self._count_unset_bools(record[0], (record[1],))
                    yield make(Record, (plain[record[0]], record[1], None, None))
                else:
                    yield from self._select(record)

    def runs(self) -> Iterator[Run]:
        """Yield the messages stream by stream in parts of the file; messages that need further checks one by one."""
        open_runs = dict[ulog.Subscription, Run]()
        for records in self._read():
            for record in records:
                if isinstance(record, ulog.Data) and record.subscription in open_runs:
                    open_runs[record.subscription].payloads.append(record.payload)
                    continue
                selected = [*self._select(record)]
                # the messages of a stream that needs checks now come first
                if len(self._plain) != len(open_runs):
                    yield from self._take_runs(open_runs)
                    open_runs = self._open_runs(open_runs)
                for message in selected:
                    yield Run(message.stream, [message.payload], [])
            yield from self._take_runs(open_runs)

    def _open_runs(self, known: Mapping[ulog.Subscription, Run]) -> dict[ulog.Subscription, Run]:
        """Return a run for each stream without further checks; the parser collects its payloads."""
        runs = dict[ulog.Subscription, Run]()
        for subscription, stream in self._plain.items():
            run = known.get(subscription)
            if run is None:
                run = Run(stream, self._parser.collect(subscription), [])
            runs[subscription] = run
        return runs

    def layouts(self, definition: Definition[Any]) -> set[str]:
        """Return the names of the layouts of a definition so far."""
        streams = [stream for stream in self._firsts.values() if stream.definition is definition]
        return {_layout_name(stream) for stream in streams}

    def _read(self) -> Iterator[list[ulog.Record]]:
        try:
            with self._file as file:
                while chunk := file.read(_CHUNK):
                    self.position += len(chunk)
                    yield self._parser.feed(chunk)
            self._warnings += self.shrinkage()
            yield self._parser.close()
            self._is_read = True
            self._check_losses()
        except ulog.UlogError as exc:
            raise SourceError(str(self.path), f"not a readable ULog file ({exc})") from exc
        except OSError as exc:
            raise SourceError(str(self.path), system_reason(exc)) from exc
        if not self.definitions:
            raise SourceError(str(self.path), "; ".join([self._absence, *self.warnings[:3]]))

    def _check_losses(self) -> None:
        """Note whether messages were lost, at the end of the log."""
        if self._parser.undecodable or self._texts.problem:
            self.damaged = True
        for repetitions in self._repeated.values():
            if repetitions.warnings and repetitions.is_loss:
                self.damaged = True

    @property
    def _absence(self) -> str:
        """Why the log has no messages."""
        topics = self.options.topics
        if topics is None:
            return "this log has no message of any topic"
        wanted = "these topics" if len(topics) < len(TOPICS) else "built-in topics"
        reason = f"this log has no message of {wanted}"
        if not self._subscribed:
            return reason
        names = ", ".join(sorted(self._subscribed)[: limits.SHOWN_NAMES])
        return f"{reason}, but of {names}; choose them by name, or all with '*'"

    def _take_runs(self, runs: Mapping[ulog.Subscription, Run]) -> Iterator[Run]:
        for subscription, (stream, payloads, _) in runs.items():
            if payloads:
                self._count_unset_bools(subscription, payloads)
                yield Run(stream, payloads.copy(), [])
                payloads.clear()

    def _select(self, record: ulog.Record) -> Iterator[Record]:
        """Yield the message of a record, and the log message after it, if they are selected; process other records."""
        for merged in self._texts.merge((record,)):
            if not isinstance(merged, ulog.Data):
                self._process(merged)
                continue
            stream = self._accept(merged)
            if stream is not None:
                yield Record(stream, merged.payload, None)

    def _accept(self, record: ulog.Data) -> ulog.LoggedStream | None:
        """Return the stream of a data message, None if the message is not selected or a duplicate."""
        subscription, payload = record
        if subscription not in self._streams:
            self._streams[subscription] = self._open(subscription)
        stream = self._streams[subscription]
        if stream is None:
            return None
        repetitions = self._repeated.get(stream)
        if repetitions is not None and repetitions.add(stream, payload):
            return None
        self._count_unset_bools(subscription, (payload,))
        is_text = subscription.name in (*self._texts.TOPICS, ulog.LOG_MESSAGE.name)
        if repetitions is None and not is_text:
            self._plain[subscription] = stream
        return stream

    def _count_unset_bools(
        self, subscription: ulog.Subscription, payloads: Iterable[bytes]
    ) -> None:
        layout = subscription.layout
        mask = layout.bool_mask
        if not mask:
            return
        to_int = int.from_bytes
        for payload in payloads:
            if to_int(payload, "little") & mask:
                self._unset_bools[subscription.name] += layout.count_unset_bools(payload)

    def _process(self, record: ulog.Record) -> None:
        if isinstance(record, ulog.Header):
            self.start = record.timestamp
        elif isinstance(record, ulog.Information):
            if record.key == "boot_time_utc_us" and isinstance(record.value, int):
                self.boot_utc = record.value
        elif isinstance(record, ulog.Parameter):
            if record.key == "MAV_SYS_ID" and record.value in range(1, 256):
                self._system_id = str(record.value)
        elif isinstance(record, ulog.Dropout):
            self._dropout += record.duration / 1e3
        elif isinstance(record, ulog.Subscription):
            self._subscribe(record)
        elif isinstance(record, ulog.Damage):
            self._note_damage(record)

    def _subscribe(self, subscription: ulog.Subscription) -> None:
        self._subscribed[subscription.name] += 1
        instance = _instance_of(subscription)
        self._subscribers[instance] += 1
        for first in [*self._plain]:
            if _instance_of(first) == instance:
                stream = self._plain.pop(first)
                self._repeated[stream] = _Repetitions(stream)

    def _note_damage(self, damage: ulog.Damage) -> None:
        kind = "truncated"
        if not damage.is_end:
            kind = "damaged"
            self._damages += 1
            self.damaged = True
        if self._damages <= _LISTED_DAMAGES:
            self._warnings.append(f"{kind} ({damage.reason})")

    def _open(self, subscription: ulog.Subscription) -> ulog.LoggedStream | None:
        """Return the stream of a subscription at its first message, None if it is not selected or not usable."""
        topic = subscription.name
        if not self.reads(topic):
            return None
        try:
            stream = ulog.LoggedStream(self.options.vehicle or self._system_id, subscription)
        except ValueError as exc:
            self._warnings.append(f"skipped {topic} ({exc})")
            self.damaged |= topic in TOPICS or isinstance(exc, AddressError)
            return None
        lacking = sorted(stream.definition.always.difference(stream.names))
        if lacking:
            where = f"{topic} [{subscription.multi_id}]"
            self._warnings.append(f"the definition of {', '.join(lacking)} in {where} is damaged")
            self.damaged = True
        if "timestamp" not in stream.names:
            return None
        self.definitions.setdefault(stream.address, stream.definition)
        first = self._firsts.setdefault(stream.address, stream)
        if self._subscribers[_instance_of(subscription)] > 1:
            self._repeated[stream] = self._repeated.setdefault(first, _Repetitions(first))
        return stream


class _Repetitions:
    """The recent messages of an address with several subscriptions: PX4 may log a topic twice, or subscribe again.

    `warnings`: of the messages left out; `is_loss`: True if they are of a topic that has instances.
    """

    def __init__(self, first: ulog.LoggedStream) -> None:
        self._first = first
        self._recent: dict[bytes, ulog.Subscription] = {}
        self._others: set[ulog.Subscription] = set()
        self.warnings: list[str] = []
        self.is_loss = False

    def add(self, stream: ulog.LoggedStream, payload: bytes) -> bool:
        """Return whether another subscription had this message, or is another instance with the same address."""
        subscription = stream.subscription
        recent = self._recent
        if recent.get(payload, subscription) is not subscription:
            return True
        if len(recent) >= limits.KNOWN_TIMES:
            oldest = next(iter(recent))
            del recent[oldest]
        recent[payload] = subscription
        if subscription.multi_id == self._first.subscription.multi_id:
            return False
        if subscription not in self._others:
            self._others.add(subscription)
            number = subscription.multi_id
            where = f"{stream.address.topic} [{number}]"
            self.warnings.append(f"skipped a duplicate {where} with different messages")
            if stream.address.instance is not None or number == 0:
                self.is_loss = True
        return True


def _instance_of(subscription: ulog.Subscription) -> tuple[str, int]:
    """Return topic and instance; all instances of a topic that has none in PX4 share one address."""
    topic = subscription.name
    has_instances = topic not in TOPICS or TOPICS[topic].instances
    return topic, subscription.multi_id if has_instances else 0


def _layout_name(stream: ulog.LoggedStream) -> str:
    """Return the name of the layout of a logged stream of a built-in message."""
    layout = stream.definition.find_layout(stream.names)
    if layout:
        return layout.name
    return "newer than 1.16" if _is_newer(stream) else "1.12 or older"


def _is_newer(stream: ulog.LoggedStream) -> bool:
    """Return whether a stream has all fields of the newest known layout, as in a log newer than nedbus."""
    newest = [layout for layout in stream.definition.layouts.values() if layout.name != ALL][-1]
    return newest.types.keys() <= set(stream.names)
