"""Speed of the hot path: ratios in one process, independent of the machine."""

from __future__ import annotations

import json

import pytest

from tests.conftest import Start

# Coverage would slow down nedbus_msgs but not the baseline: this runs in a process without it.
PROGRAM = """
import json, timeit
import msgpack
from pydantic import ConfigDict, create_model
from nedbus_msgs import FIELD_TYPES, VehicleLocalPosition, decode, decode_row, encode, encode_row
from nedbus_msgs.arrays import decode_array, to_array, encode_array

numbers = {"uint64": 5, "uint8": 3, "bool": True, "float32": 0.1, "float32[2]": (0.5, 0.7), "float64": 47.123456789}
message = VehicleLocalPosition(**{name: numbers[kind] for name, kind in FIELD_TYPES.items()})
fields = message.model_dump()
types = {name: (tuple[float, float] if type(value) is tuple else type(value), ...) for name, value in fields.items()}
Plain = create_model("Plain", __config__=ConfigDict(frozen=True, strict=True, extra="forbid"), **types)
payload, row, array = encode(message), tuple(fields.values()), to_array([message] * 1000)
packed, payloads = msgpack.packb(fields), encode(message) * 1000
cases = {
    "plain decode": lambda: Plain.model_validate(msgpack.unpackb(packed, use_list=False)),
    "plain encode": lambda: msgpack.packb(Plain(**fields).model_dump()),
    "decode": lambda: decode(payload),
    "decode_row": lambda: decode_row(payload),
    "encode": lambda: encode(VehicleLocalPosition(**fields)),
    "encode_row": lambda: encode_row(row),
    "decode_array": lambda: decode_array(payloads),
    "encode_array": lambda: encode_array(array),
}
best = dict.fromkeys(cases, float("inf"))
for _ in range(30):  # interleaved, and the best counts: other load of the machine affects all cases alike
    for name, case in cases.items():
        count = 2 if "array" in name else 200
        best[name] = min(best[name], timeit.timeit(case, number=count) / count)
print(json.dumps(best))
"""

BOUNDS = {  # as shares of the baseline: unpack a map and validate it, or validate, dump and pack one
    "decode": ("plain decode", 1.3, 1),
    "decode_row": ("plain decode", 0.9, 1),
    "decode_array": ("plain decode", 0.06, 1000),
    "encode": ("plain encode", 1.8, 1),
    "encode_row": ("plain encode", 0.6, 1),
    "encode_array": ("plain encode", 0.04, 1000),
}


@pytest.mark.timeout(120)
def test_hot_path_is_as_fast_as_it_was(start: Start) -> None:
    """Each form takes at most its share of the baseline, at the best of three runs."""
    ratios = dict.fromkeys(BOUNDS, float("inf"))
    for _ in range(3):
        process = start("-c", PROGRAM, measured=False)
        assert process.wait(100.0) == 0, process.err
        best = json.loads(process.out)
        for name, (plain, _, messages) in BOUNDS.items():
            ratios[name] = min(ratios[name], best[name] / messages / best[plain])
        if all(ratios[name] < bound for name, (_, bound, _) in BOUNDS.items()):
            return
    pytest.fail(f"slower than it was, as shares of the baseline: {ratios}")
