"""Streaming reader of PX4 .ulg logs."""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from nedbus import ulog
from nedbus.errors import AddressError, SourceError
from nedbus_msgs import ALL, TOPICS, Address, Definition

from .formats import open_file
from .reader import FlightReader, ReadOptions, Record, Run

_CHUNK: Final = 2**17  # bytes read at a time
_MAX_NAMED: Final = 5  # damaged locations listed in the warnings
_MAX_TOPICS: Final = 10  # topics listed in an error
_MAX_RECENT: Final = 1000  # messages of a topic among which duplicates are searched


class UlogReader(FlightReader):
    """Read the messages of a log in file order, with memory independent of its size."""

    kind = "ulog"
    has_log_times = False

    def __init__(self, path: Path, options: ReadOptions) -> None:
        super().__init__(path, options)
        self._file, self.total = open_file(path), path.stat().st_size
        self._resources.append(self._file)
        self._system_id = options.default_vehicle
        self._texts = ulog.LogMessageBuilder()
        needed = None if options.topics is None else {*options.topics, *self._texts.TOPICS}
        self._parser = ulog.UlogParser(verify=True, topics=needed)
        self._damages, self._is_read = 0, False
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
        streams = [each for each in self._streams.values() if each is not None]
        warnings = self._warnings + [
            reason for stream in streams for reason in stream.omitted.values()
        ]
        counts = {
            "further damaged locations": self._damages - _MAX_NAMED,
            "skipped messages without a definition": self._parser.undecodable,
            "left out log messages above 100 per second": self._texts.limit.omitted,
            **{ulog.UNSET_BOOLS.format(topic): count for topic, count in self._unset_bools.items()},
        }
        warnings += [
            f"{text} ({count})" for text, count in counts.items() if count > 0 and self._is_read
        ]
        warnings += [text for each in set(self._repeated.values()) for text in each.warnings]
        for stream in self._firsts.values():
            unknown = sorted(set(stream.names) - stream.definition.known_types.keys())
            if unknown and _is_newer(stream):
                warnings.append(
                    f"left out unknown fields of {stream.address} ({', '.join(unknown)}); update nedbus"
                )
        return [*warnings, *filter(None, [self._texts.problem])]

    def records(self) -> Iterator[Record]:
        """Yield the data messages; raise SourceError if the file is not a ULog file, or has none of the topics."""
        plain = self._plain
        data = ulog.Data
        make = tuple.__new__
        for records in self._read():
            for record in records:
                if isinstance(record, data) and record[0] in plain:
                    self._count_unset_bools(record[0], (record[1],))
                    yield make(Record, (plain[record[0]], record[1], None, None))
                else:
                    yield from self._select(record)

    def runs(self) -> Iterator[Run]:
        """Yield the messages stream by stream in parts of the file; messages that need further checks one by one."""
        found = dict[ulog.Subscription, Run]()
        for records in self._read():
            for record in records:
                if isinstance(record, ulog.Data) and record.subscription in found:
                    found[record.subscription].payloads.append(record.payload)
                    continue
                selected = [Run(each.stream, [each.payload], []) for each in self._select(record)]
                # the messages of a stream that needs checks now come first
                if len(self._plain) != len(found):
                    yield from self._take_runs(found)
                    found = {
                        each: found.get(each) or Run(stream, self._parser.collect(each), [])
                        for each, stream in self._plain.items()
                    }
                yield from selected
            yield from self._take_runs(found)

    def layouts(self, definition: Definition[Any]) -> set[str]:
        """Return the names of the layouts of a definition so far."""
        return {
            _layout_name(each) for each in self._firsts.values() if each.definition is definition
        }

    def _read(self) -> Iterator[list[ulog.Record]]:
        try:
            with self._file as file:
                while chunk := file.read(_CHUNK):
                    self.position += len(chunk)
                    yield self._parser.feed(chunk)
            self._warnings += self.shrinkage()
            yield self._parser.close()
            self._is_read = True
            self.damaged |= self._parser.undecodable > 0 or bool(self._texts.problem)
            self.damaged |= any(each.warnings and each.is_loss for each in self._repeated.values())
        except ulog.UlogError as exc:
            raise SourceError(str(self.path), f"not a readable ULog file ({exc})") from exc
        except OSError as exc:
            raise SourceError(str(self.path), (exc.strerror or str(exc)).lower()) from exc
        if not self.definitions:
            topics = self.options.topics
            what = (
                "any topic"
                if topics is None
                else "these topics"
                if len(topics) < len(TOPICS)
                else "built-in topics"
            )
            reason = f"this log has no message of {what}"
            if topics is not None and self._subscribed:
                names = ", ".join(sorted(self._subscribed)[:_MAX_TOPICS])
                reason += f", but of {names}; choose them by name, or all with topics=* or read(path, ['*'])"
            raise SourceError(str(self.path), "; ".join([reason, *self.warnings[:3]]))

    def _take_runs(self, found: Mapping[ulog.Subscription, Run]) -> Iterator[Run]:
        for subscription, (stream, payloads, _) in found.items():
            if payloads:
                self._count_unset_bools(subscription, payloads)
                yield Run(stream, payloads.copy(), [])
                payloads.clear()

    def _select(self, record: ulog.Record) -> Iterator[Record]:
        """Yield the message of a record, and the log message after it, if they are selected; process other records."""
        for each in self._texts.merge((record,)):
            if not isinstance(each, ulog.Data):
                self._process(each)
            elif (stream := self._accept(each)) is not None:
                yield Record(stream, each.payload, None)

    def _accept(self, record: ulog.Data) -> ulog.LoggedStream | None:
        """Return the stream of a data message, None if the message is not selected or a duplicate."""
        subscription, payload = record
        if subscription not in self._streams:
            self._streams[subscription] = self._open(subscription)
        stream = self._streams[subscription]
        if stream is None or (
            stream in self._repeated and self._repeated[stream].add(stream, payload)
        ):
            return None
        self._count_unset_bools(subscription, (payload,))
        if stream not in self._repeated and subscription.name not in (
            *self._texts.TOPICS,
            ulog.LOG_MESSAGE.name,
        ):
            self._plain[subscription] = stream
        return stream

    def _count_unset_bools(
        self, subscription: ulog.Subscription, payloads: Iterable[bytes]
    ) -> None:
        layout, to_int = subscription.layout, int.from_bytes
        if mask := layout.bool_mask:
            for payload in payloads:
                if to_int(payload, "little") & mask:
                    self._unset_bools[subscription.name] += layout.count_unset_bools(payload)

    def _process(self, record: ulog.Record) -> None:
        if isinstance(record, ulog.Header):
            self.start = record.timestamp
        elif isinstance(record, ulog.Information):
            if record.key == "boot_time_utc_us" and isinstance(record.value, int):
                self.boot_utc = record.value
        elif isinstance(record, ulog.Dropout):
            self._dropout += record.duration / 1e3
        elif (
            isinstance(record, ulog.Parameter)
            and record.key == "MAV_SYS_ID"
            and record.value in range(1, 256)
        ):
            self._system_id = str(record.value)
        elif isinstance(record, ulog.Subscription):
            self._subscribed[record.name] += 1
            self._subscribers[_instance_of(record)] += 1
            for first in [
                each for each in self._plain if _instance_of(each) == _instance_of(record)
            ]:
                stream = self._plain.pop(first)
                self._repeated[stream] = _Repetitions(stream)
        elif isinstance(record, ulog.Damage):
            self._damages += not record.is_end
            self.damaged |= not record.is_end
            if self._damages <= _MAX_NAMED:
                self._warnings.append(
                    f"{'truncated' if record.is_end else 'damaged'} ({record.reason})"
                )

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
        if lacking := ", ".join(sorted(stream.definition.always.difference(stream.names))):
            self._warnings.append(
                f"the definition of {lacking} in {topic} [{subscription.multi_id}] is damaged"
            )
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
        subscription, recent = stream.subscription, self._recent
        known = recent.get(payload, subscription)
        if known is subscription:
            if len(recent) >= _MAX_RECENT:
                del recent[next(iter(recent))]
            recent[payload] = subscription
        if known is not subscription:
            return True
        if subscription.multi_id == self._first.subscription.multi_id:
            return False
        if subscription not in self._others:
            self._others.add(subscription)
            number, topic = subscription.multi_id, stream.address.topic
            self.warnings.append(f"skipped a duplicate {topic} [{number}] with different messages")
            self.is_loss |= stream.address.instance is not None or number == 0
        return True


def _instance_of(subscription: ulog.Subscription) -> tuple[str, int]:
    """Return topic and instance; all instances of a topic that has none in PX4 share one address."""
    topic = subscription.name
    return topic, subscription.multi_id if topic not in TOPICS or TOPICS[topic].instances else 0


def _layout_name(stream: ulog.LoggedStream) -> str:
    """Return the name of the layout of a logged stream of a built-in message."""
    layout = stream.definition.find_layout(stream.names)
    return layout.name if layout else "newer than 1.16" if _is_newer(stream) else "1.12 or older"


def _is_newer(stream: ulog.LoggedStream) -> bool:
    """Return whether a stream has all fields of the newest known layout, as in a log newer than nedbus."""
    newest = [layout for layout in stream.definition.layouts.values() if layout.name != ALL][-1]
    return newest.types.keys() <= set(stream.names)
