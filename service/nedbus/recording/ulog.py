"""Topics of PX4 .ulg logs as columns."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from nedbus_msgs import TOPICS, Address, Definition

from .ulog_reader import UlogReader, UlogStream


@dataclass(frozen=True, slots=True)
class UlogTopic:
    """One topic of a log; its message definition is known to nedbus, or comes from the log.

    `columns`: its values by PX4's field name, with one row per message for an array.
    `absent`: for columns of another type than the message has, a mask of the messages whose value does not fit.
    """

    definition: Definition[Any]
    columns: Mapping[str, npt.NDArray[np.generic]]
    absent: Mapping[str, npt.NDArray[np.bool_]]


@dataclass(slots=True)
class UlogTopics:
    """Topics of a log, and the reader with what else it has found.

    Logs have no checksums: damage to the values of a message goes undetected.
    """

    topics: dict[Address, UlogTopic]
    reader: UlogReader


def read_ulog(path: Path, *, topics: Collection[str] | None = TOPICS) -> UlogTopics:
    """Read topics of a log, all for None; messages unknown to nedbus are defined by the log's formats.

    Raises SourceError if the file is not a ULog file, or has none of the topics.
    """
    reader = UlogReader(path, topics=topics, vehicle=None, default_vehicle="1")
    payloads: defaultdict[UlogStream, bytearray] = defaultdict(bytearray)
    for stream, payload in reader.messages():
        payloads[stream] += payload
    found: dict[Address, UlogTopic] = {}
    for stream, joined in payloads.items():
        table: npt.NDArray[np.void] = np.frombuffer(joined, np.dtype(stream.subscription.layout.dtype))
        columns: dict[str, npt.NDArray[np.generic]] = {name: table[name] for name in stream.names}
        absent: dict[str, npt.NDArray[np.bool_]] = {}
        if types := stream.fitting.types:
            rows = [stream.decode(row.tobytes()) for row in table]
            for name, kind in types.items():
                values = np.array([row.get(name, kind.absent) for row in rows], str if kind.is_text else kind.form[-1])
                columns[name] = np.char.encode(values, "utf-8") if kind.is_text else values
                absent[name] = np.array([name not in row for row in rows])
        found[stream.address] = UlogTopic(stream.definition, columns, absent)
    return UlogTopics(found, reader)
