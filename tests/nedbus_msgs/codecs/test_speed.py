"""Speed of the hot path relative to a baseline in the same process, with messages of real flights."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from tests.peers.processes import Start

FLIGHTS = Path(__file__).parents[2] / "data" / "flights.json"

# Runs in a process without coverage, which would slow down nedbus_msgs but not the baseline.
PROGRAM = """
import json, sys, time, timeit
import msgpack
from pydantic import ConfigDict, create_model
from nedbus_msgs import DEFAULT, VehicleLocalPosition, codec_of
from nedbus_msgs.arrays import arrays_of, to_array
codec, arrays = codec_of(DEFAULT), arrays_of(DEFAULT)
decode, decode_row = codec.decode, codec.decode_row
encode, encode_fields, encode_row = codec.encode, codec.encode_fields, codec.encode_row
decode_array, encode_array, valid_mask = arrays.decode, arrays.encode, arrays.valid_mask

cases = {}
for flight, content in json.load(open(sys.argv[1])).items():
    message = VehicleLocalPosition(**content["fields"])
    fields = message.model_dump()
    kinds = {name: tuple[float, float] if type(value) is tuple else type(value) for name, value in fields.items()}
    config = ConfigDict(frozen=True, strict=True, extra="forbid")
    Plain = create_model("Plain", __config__=config, **{name: (kind, ...) for name, kind in kinds.items()})
    read_plain = lambda Plain=Plain, packed=msgpack.packb(fields): Plain.model_validate(
        msgpack.unpackb(packed, use_list=False)
    )
    payload, row, array = encode(message), tuple(fields.values()), to_array([message] * 1000)
    payloads, one = encode(message) * 1000, to_array([message])
    cases[flight] = {
        "plain decode": read_plain,
        "plain encode": lambda Plain=Plain, fields=fields: msgpack.packb(Plain(**fields).model_dump()),
        "decode": lambda payload=payload: decode(payload),
        "decode_row": lambda payload=payload: decode_row(payload),
        "encode": lambda fields=fields: encode(VehicleLocalPosition(**fields)),
        "encode_fields": lambda fields=fields: encode_fields(fields),
        "encode_provided": lambda provided={name: fields[name] for name in message.model_fields_set}: encode_fields(
            provided
        ),
        "encode_row": lambda row=row: encode_row(row),
        "decode_array": lambda payloads=payloads: decode_array(payloads),
        "encode_array": lambda array=array: encode_array(array),
        "decode_array of one": lambda payload=payload: decode_array(payload),
        "decode_array of 16": lambda payloads=payload * 16: decode_array(payloads),
        "valid_mask and encode_array of one": lambda one=one: (valid_mask(one), encode_array(one)),
    }
best = {flight: dict.fromkeys(forms, float("inf")) for flight, forms in cases.items()}
for _ in range(30):  # interleaved, best of all, in processor time: robust against other load
    for flight, forms in cases.items():
        for name, case in forms.items():
            count = 2 if name in ("decode_array", "encode_array") else 100
            seconds = timeit.timeit(case, timer=time.process_time, number=count) / count
            best[flight][name] = min(best[flight][name], seconds)
print(json.dumps(best))
"""

BOUNDS = {  # baseline, maximum ratio to it, and messages per call
    "decode": ("plain decode", 1.3, 1),
    "decode_row": ("plain decode", 0.9, 1),
    "decode_array": ("plain decode", 0.045, 1000),
    "decode_array of one": ("plain decode", 1.0, 1),
    "decode_array of 16": ("plain decode", 0.35, 16),
    "encode": ("plain encode", 1.8, 1),
    "encode_fields": ("plain encode", 0.7, 1),
    "encode_provided": ("plain encode", 0.8, 1),
    "encode_row": ("plain encode", 0.6, 1),
    "encode_array": ("plain encode", 0.02, 1000),
    "valid_mask and encode_array of one": ("plain encode", 0.7, 1),
}


MAX_SPREAD = 1.5
"""Maximum ratio of the time for any flight to the time for the fastest flight, for the same operation."""


@pytest.mark.long  # concurrent tests would distort the measurement
@pytest.mark.timeout(600)
def test_hot_path_is_within_its_bounds(start: Start) -> None:
    """For each flight, each operation stays below its limits relative to the baseline and to the fastest flight."""
    best: dict[str, dict[str, float]] = {}
    for _ in range(6):
        process = start("-c", PROGRAM, str(FLIGHTS), coverage=False, fresh=True)
        assert process.wait(100.0) == 0, process.err
        for flight, forms in json.loads(process.out).items():
            known = best.setdefault(flight, forms)
            best[flight] = {name: min(seconds, known[name]) for name, seconds in forms.items()}
        slow = exceeded_bounds(best)
        if not slow:
            return
    pytest.fail(f"slower than allowed: {slow}")


def exceeded_bounds(best: dict[str, dict[str, float]]) -> list[str]:
    """Return a line for each exceeded bound."""
    slow = []
    for name, (plain, bound, messages) in BOUNDS.items():
        fastest = min(forms[name] for forms in best.values())
        for flight, forms in best.items():
            ratio, spread = forms[name] / messages / forms[plain], forms[name] / fastest
            if ratio > bound:
                slow.append(f"{name}, {flight}: {ratio:.2f} of the baseline, limit {bound}")
            if spread > MAX_SPREAD:
                slow.append(
                    f"{name}, {flight}: {spread:.2f} of the fastest flight, limit {MAX_SPREAD}"
                )
    return slow
