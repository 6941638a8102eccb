"""The incremental ULog parser, against pyulog and under damage."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from pyulog import ULog

from nedbus.ulog import Damage, Data, Record, UlogParser
from tests.flights.ulogs import LOGS

REAL = sorted([*LOGS.glob("*.ulg"), *(LOGS.parent / "px4").glob("**/*.ulg")])


def parse(data: bytes, *, size: int = 2**18) -> list[Record]:
    parser = UlogParser(verify=True)
    records = [record for start in range(0, len(data), size) for record in parser.feed(data[start : start + size])]
    return records + parser.close()


@pytest.mark.logs
@pytest.mark.parametrize("log", REAL, ids=lambda path: path.stem)
def test_real_log_equals_pyulog(log: Path) -> None:
    """All messages of PX4's own logs have the values that pyulog reads, in all fields, and nothing is damage."""
    records = parse(log.read_bytes())
    found: dict[int, list[Data]] = {}
    for record in records:
        if isinstance(record, Data):
            found.setdefault(record.subscription.message_id, []).append(record)
    assert all(record.is_end for record in records if isinstance(record, Damage))
    expected = {data.msg_id: data for data in ULog(str(log)).data_list}
    assert found.keys() == expected.keys()
    for message_id, data in expected.items():
        subscription = found[message_id][0].subscription
        assert (subscription.name, subscription.multi_id) == (data.name, data.multi_id)
        joined = b"".join(record.payload for record in found[message_id])
        table: npt.NDArray[np.void] = np.frombuffer(joined, np.dtype(subscription.layout.dtype))
        columns: dict[str, list[npt.NDArray[np.generic]]] = {}
        for name, values in data.data.items():
            *outer, last = name.split(".")
            if not last.startswith("_padding"):
                parts = [part.replace("[", "_").replace("]", "") for part in outer]
                columns.setdefault("_".join([*parts, last.partition("[")[0]]), []).append(values)
        assert set(table.dtype.names or ()) == columns.keys()
        for name, own in columns.items():
            assert table[name].tobytes() == np.stack(own, axis=1).tobytes(), (data.name, name)
