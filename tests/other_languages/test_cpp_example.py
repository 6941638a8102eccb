"""The C++ example of the documentation: compiled, and run on payloads of the wire format."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path
from typing import Final

import pytest

from docs.generator.vectors import ROOT
from nedbus_msgs import VehicleLocalPosition, codec_of
from tests.documents import blocks_of
from tests.flights.messages import VALID

from .programs import HERE

_BACKEND: Final = "-DZENOHCXX_ZENOHC"  # zenoh-cpp's definition for zenoh-c
_FLAGS: Final = ("-std=c++17", "-Wall", "-Werror")

pytestmark = [pytest.mark.slow, pytest.mark.process]


def compile_with(*arguments: str) -> subprocess.CompletedProcess[str]:
    """Run the compiler; skip the test without it."""
    if shutil.which("g++") is None:
        pytest.skip("no g++")
    return subprocess.run(
        ["g++", *_FLAGS, *arguments], capture_output=True, text=True, timeout=110, check=False
    )


def has_header(name: str) -> bool:
    """Return whether the compiler finds this header of the system."""
    found = subprocess.run(
        ["g++", "-std=c++17", _BACKEND, "-E", "-x", "c++", "-"], input=f"#include <{name}>\n",
        capture_output=True, text=True, timeout=110, check=False,
    )  # fmt: skip
    return found.returncode == 0


@pytest.fixture
def example(tmp_path: Path) -> Path:
    """Return the file with the example."""
    if shutil.which("g++") is None or not has_header("nlohmann/json.hpp"):
        pytest.skip("no g++, or no nlohmann/json.hpp")
    [text] = [
        block.text
        for block in blocks_of(ROOT / "docs/other-languages.md")
        if block.language == "cpp"
    ]
    file = tmp_path / "example.cpp"
    file.write_text(text)
    return file


def test_example_prints_the_valid_positions(example: Path) -> None:
    """The example prints x and y of a valid position, not those of an invalid one, and skips other layouts.

    It is compiled with a header in place of zenoh-cpp's, whose subscriber receives these payloads.
    """
    program = example.with_suffix("")
    built = compile_with("-I", str(HERE), str(example), "-o", str(program))
    assert built.returncode == 0, built.stderr
    codec = codec_of(VehicleLocalPosition.DEFINITION)
    valid, invalid = (
        codec.encode(
            VehicleLocalPosition(
                **{**VALID, "timestamp": 1, "x": 2.5, "y": -1.5, "xy_valid": is_valid}
            )
        )
        for is_valid in (True, False)
    )
    other_layout = b"\x92\x00\x01"
    keys = [f"nedbus/{name}/vehicle_local_position" for name in "abc"]
    samples = zip(keys, (valid, invalid, other_layout), strict=True)
    text = "".join(f"{key} {payload.hex()}\n" for key, payload in samples)
    output = subprocess.run(
        [str(program)], input=text, capture_output=True, text=True, timeout=60, check=True
    ).stdout
    assert output.splitlines() == [f"{keys[0]} x 2.5 y -1.5", f"{keys[1]} has no valid position"]


def test_example_compiles_with_the_headers_of_zenoh(example: Path) -> None:
    """The example compiles with zenoh-cpp, if its headers are installed."""
    if not has_header("zenoh.hxx"):
        pytest.skip("no zenoh.hxx")
    built = compile_with("-fsyntax-only", _BACKEND, str(example))
    assert built.returncode == 0, built.stderr
