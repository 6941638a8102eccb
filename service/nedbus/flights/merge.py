"""Several flights on one UTC axis, with distinct names of vehicles."""

import re
from collections import Counter
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from functools import cached_property
from heapq import merge
from itertools import chain, islice
from operator import attrgetter
from pathlib import Path
from statistics import median
from typing import Any, Final

from nedbus.errors import ArgumentError, SourceError
from nedbus.samples import SourceMessage
from nedbus.timeline import Order, UtcOffset
from nedbus.ulog import LOG_MESSAGE
from nedbus_msgs import Address, Definition

from .readers import ReadOptions, open_reader
from .utc import FileUtc, read_utc

LOOKAHEAD: Final = 1000
"""Messages that are read ahead to determine the first streams and the start time of a file."""


@dataclass(frozen=True, slots=True)
class Survey:
    """What a pass over a whole file shows.

    `utc`: the UTC offset of each vehicle, or why it is unknown. `duration`: from the first to the last message [s].
    """

    utc: Mapping[str, UtcOffset | str]
    duration: float


class FlightFile:
    """One pass over one file: its reader, its messages in order, and its vehicles.

    `names`: the name of each vehicle among several files. `known`: what an earlier pass has found.
    `surveys`: note what `survey` needs.
    """

    def __init__(self, path: Path, options: ReadOptions, *, known: Survey | None = None, surveys: bool = False) -> None:
        self.path, self.options, self._known = path, options, known
        reader = self.reader = open_reader(path, options)
        self.order = Order[SourceMessage](reader.start_of, has_log_times=reader.has_log_times)
        self._seen = FileUtc()
        records = reader.records()
        if surveys:
            records = self._seen.watch(records)
        messages = self.order.arrange(map(reader.message_of, records))
        try:
            self.ahead = list(islice(messages, LOOKAHEAD))
        except BaseException:
            self.reader.close()
            raise
        self.messages: Iterator[SourceMessage] = chain(self.ahead, messages)
        self.names: Mapping[str, str] = {address.vehicle: address.vehicle for address in self.reader.definitions}

    @property
    def warnings(self) -> list[str]:
        """Damage, omissions and times out of order so far."""
        found = [*self.reader.warnings]
        for address, count in self.order.unordered.items():
            if address.topic != LOG_MESSAGE.name and count:  # PX4 queues log messages
                found.append(f"timestamps of {address} are out of order ({count})")
        return [*found, *self.order.remarks]

    @cached_property
    def utc(self) -> Mapping[str, UtcOffset | str]:
        """The UTC offset of each vehicle, by its own name, or why it is unknown; reads the file unless it is known."""
        if self._known is not None:
            return self._known.utc
        topics = ReadOptions().topics if self.options.topics else None  # a file may have other topics only
        with open_reader(self.path, replace(self.options, topics=topics)) as reader:
            return read_utc(reader)

    def survey(self) -> Survey:
        """Read all messages, and return what they show; the file must have been opened with `surveys`."""
        duration = 0.0
        for message in self.messages:
            duration = message.at
        self.reader.close()
        self._known = Survey(self._seen.results(self.reader), duration)
        return self._known

    def start(self) -> float:
        """Return the Unix time of the first message [s]; raise SourceError if it is unknown."""
        known = ((each, each.timestamp) for each in self.ahead if not each.error)
        offsets = ((self.utc.get(each.address.vehicle), each, time) for each, time in known if time is not None)
        found = [int(utc.unix_us(time)) / 1e6 - each.at for utc, each, time in offsets if isinstance(utc, UtcOffset)]
        if not found:
            raise no_utc(self.path, next((utc for utc in self.utc.values() if isinstance(utc, str)), ""))
        return median(found)


class MergedFlights(AbstractContextManager["MergedFlights"]):
    """One pass over one file, or over several files merged by UTC.

    Vehicles with the same name in several files are named after their files. `ended`: vehicles whose file has ended.
    `known`, `surveys`: as those of a file.

    Raises ArgumentError without files, ConfigError or SourceError if a file cannot be read.
    """

    def __init__(
        self,
        paths: Sequence[Path],
        options: ReadOptions = ReadOptions(),  # noqa: B008 - immutable
        *,
        known: Sequence[Survey] = (),
        surveys: bool = False,
    ) -> None:
        known_of = dict(zip(paths, known, strict=False))
        self.files = [
            FlightFile(path, options, known=known_of.get(path), surveys=surveys) for path in require_files(paths)
        ]
        names = distinct_names([(file.path, file.names) for file in self.files])
        for file, own in zip(self.files, names, strict=True):
            file.names = own
        self.ended: set[str] = set()

    @property
    def warnings(self) -> tuple[str, ...]:
        """Damage, omissions and renamed vehicles so far, each with its file."""
        found = []
        for file in self.files:
            reason = "here, because several files have a vehicle"
            renamed = [
                f"vehicle {own} is named {name} {reason} {own}" for own, name in file.names.items() if own != name
            ]
            found += [f"{file.path}: {text}" for text in (*renamed, *file.warnings)]
        return tuple(found)

    @property
    def damaged(self) -> bool:
        """True if messages of any file were lost so far."""
        return any(file.reader.damaged for file in self.files)

    @property
    def definitions(self) -> dict[Address, Definition[Any]]:
        """The definition of each stream so far."""
        found = dict[Address, Definition[Any]]()
        for file in self.files:
            found |= {renamed(each, file.names): known for each, known in [*file.reader.definitions.items()]}
        return found

    @cached_property
    def utc(self) -> Mapping[str, UtcOffset | str]:
        """The UTC offset of each vehicle, or why it is unknown; reads the files."""
        return {file.names.get(own, own): utc for file in self.files for own, utc in file.utc.items()}

    def survey(self) -> list[Survey]:
        """Read all messages of each file; the files must have been opened with `surveys`."""
        return [file.survey() for file in self.files]

    def start(self) -> float:
        """Return the Unix time of the first message [s]; raise SourceError if it is unknown."""
        return min(file.start() for file in self.files)

    def duration(self, surveys: Sequence[Survey]) -> float:
        """Return seconds from the first to the last message; raise SourceError if one of several files has no UTC."""
        if len(surveys) == 1:
            return surveys[0].duration
        end = max(file.start() + survey.duration for file, survey in zip(self.files, surveys, strict=True))
        return end - self.start()

    def messages(self) -> Iterator[SourceMessage]:
        """Yield the messages in chronological order; raise SourceError if one of several files has no UTC."""
        if len(self.files) == 1:
            yield from self.files[0].messages
            return
        starts = [file.start() for file in self.files]
        shifted = (self._shift(*each, min(starts)) for each in zip(self.files, starts, strict=True))
        yield from merge(*shifted, key=attrgetter("at"))

    @property
    def starts(self) -> Mapping[str, int]:
        """The timestamp of each vehicle at the first message of its file [us]."""
        found = dict[str, int]()
        for file in self.files:
            for own, name in file.names.items():
                stamp = file.order.axis.stamp_at(own, 0.0)
                if stamp is not None and stamp > 0:
                    found[name] = stamp
        return found

    @property
    def boot_utc(self) -> int:
        """Unix time of the boot in the metadata of the only file [us]; 0 if unknown, or for several files."""
        return self.files[0].reader.boot_utc if len(self.files) == 1 else 0

    def close(self) -> None:
        """Close the files."""
        for file in self.files:
            file.reader.close()

    def __exit__(self, *_: object) -> None:
        self.close()

    def _shift(self, file: FlightFile, start: float, first: float) -> Iterator[SourceMessage]:
        for each in file.messages:
            each.at, each.address = each.at + start - first, renamed(each.address, file.names)
            yield each
        self.ended.update(file.names.values())


def no_utc(path: Path, reason: str) -> SourceError:
    """Return the error for one of several files without UTC."""
    text = reason or "no message contains UTC"
    return SourceError(str(path), f"{text}, which merging several files requires; read it alone")


def require_files(paths: Sequence[Path]) -> Sequence[Path]:
    """Return the paths of flights; raise ArgumentError if there are none."""
    if not paths:
        raise ArgumentError("path", list(paths), "at least one .ulg, .mcap or .tlog file")
    return paths


def renamed(address: Address, names: Mapping[str, str]) -> Address:
    """Return an address with the name that its vehicle has among several files."""
    name = names.get(address.vehicle, address.vehicle)
    return address if name == address.vehicle else Address(name, address.topic, address.instance)


def distinct_names(flights: Sequence[tuple[Path, Collection[str]]]) -> list[dict[str, str]]:
    """Map the vehicles of each file to unique names; a vehicle that is in several files is named after its file."""
    counts = Counter(vehicle for _, vehicles in flights for vehicle in vehicles)
    taken, found = set(counts), []
    for path, vehicles in flights:
        base = re.sub(r"[^A-Za-z0-9_-]", "_", path.name.partition(".")[0])[:60] or "flight"
        names = {}
        for vehicle in sorted(vehicles):
            free = (each for each in (base, *(f"{base}_{number}" for number in range(2, 999))) if each not in taken)
            names[vehicle] = vehicle if counts[vehicle] == 1 else next(free)
            taken.add(names[vehicle])
        found.append(names)
    return found
