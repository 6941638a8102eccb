"""Type hashes compared with those of ROS 2's own generator, and of libraries that take `char` literally."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Final

import pytest

from nedbus_msgs import (
    MESSAGES,
    definition_text,
    has_char_hash,
    hash_of,
    hash_of_msg,
    message_of_type_hash,
    ros2_type,
)
from tests.nedbus_msgs.strategies import DATA

GENERATOR: Final = (
    "ros-rosidl-generator-type-description==4.9.5", "ros-rosidl-adapter==4.9.5", "ros-rosidl-cli==4.9.5", "pyyaml",
    "catkin_pkg", "lark",
)  # fmt: skip
BASIC: Final = """uint64 timestamp
bool a
bool[2] aa
byte b
byte[2] bb
char c
char[2] cc
int8 d
int8[2] dd
uint8 e
uint8[2] ee
int16 f
uint16 g
int32 h
uint32 i
int64 j
int64[2] jj
uint64 k
float32 l
float32[3] ll
float64 m
float64[3] mm
"""
NESTED: Final = "\n" + "=" * 80 + "\nMSG: px4_msgs/"
LITERAL: Final = {
    "rosbags==0.11.9": """
import sys
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
store = get_typestore(Stores.EMPTY)
store.register(get_types_from_msg(sys.stdin.read(), "px4_msgs/msg/LogMessage"))
print(store.hash_rihs01("px4_msgs/msg/LogMessage"))
""",
    "zenoh-ros2-sdk==0.1.8": """
import sys
from zenoh_ros2_sdk.utils import get_type_hash
print(get_type_hash("px4_msgs/msg/LogMessage", msg_definition=sys.stdin.read(), dependencies={}))
""",
}


def install(folder: Path, *packages: str) -> Path:
    """Install packages in a new environment; return its folder of programs. Skips without a package index."""
    subprocess.run([sys.executable, "-m", "venv", str(folder)], check=True, timeout=200)
    command = [
        str(folder / "bin" / "pip"),
        "install",
        "--quiet",
        "--disable-pip-version-check",
        *packages,
    ]
    try:
        done = subprocess.run(command, capture_output=True, text=True, timeout=200, check=False)
    except subprocess.TimeoutExpired:
        pytest.skip("the packages cannot be installed here in 200 s")
    if done.returncode:
        pytest.skip(f"the packages cannot be installed here: {done.stderr[-200:]}")
    return folder / "bin"


def definitions() -> Iterator[dict[str, str]]:
    """Yield .msg files by name: of each layout of each built-in message, and of others in each release of px4_msgs."""
    files = {"Basic": BASIC}
    for name, definition in MESSAGES.items():
        layouts = definition.layouts.values()
        files |= {
            f"{name}L{number}": definition_text(definition, each)
            for number, each in enumerate(layouts)
        }
    yield files
    others = [json.loads(line) for line in (DATA / "msg_releases.jsonl").read_text().splitlines()]
    assert len({each["message"] for each in others}) >= 10
    for release in ("1.13", "1.14", "1.15", "1.16", "1.17", "1.18", "main"):
        yield {
            each["message"]: "\n".join(each["fields"])
            for each in others
            if release in each["releases"]
        }


@pytest.mark.long
@pytest.mark.process
@pytest.mark.timeout(900)
def test_hash_equals_that_of_ros_2(tmp_path: Path) -> None:
    """Each definition has the hash that ROS 2's generator computes, also with nested messages and all basic types."""
    programs = install(tmp_path / "venv", *GENERATOR)
    for number, files in enumerate(definitions()):
        (folder := tmp_path / str(number) / "msg").mkdir(parents=True)
        for name, text in files.items():
            (folder / f"{name}.msg").write_text(text)
        command = [
            str(programs / "rosidl"),
            "hash",
            "-o",
            "out",
            "-I",
            f"px4_msgs:{folder.parent}",
            "px4_msgs",
        ]
        command += [f"msg/{name}.msg" for name in files]
        environment = os.environ | {"AMENT_PREFIX_PATH": str(programs.parent)}
        done = subprocess.run(
            command,
            cwd=folder.parent,
            env=environment,
            capture_output=True,
            text=True,
            timeout=300,
            check=False,
        )
        assert done.returncode == 0, done.stderr[-2000:]
        for name, text in files.items():
            hashes = json.loads((folder.parent / "out" / "msg" / f"{name}.json").read_text())[
                "type_hashes"
            ]
            expected = {each["type_name"]: each["hash_string"] for each in hashes}[
                f"px4_msgs/msg/{name}"
            ]
            used = [each for each in files if re.search(rf"^{each}[ \[]", text, re.MULTILINE)]
            nested = "".join(f"{NESTED}{each}\n{files[each]}" for each in used)
            assert hash_of_msg(name, text + nested) == expected, (number, name)


@pytest.mark.long
@pytest.mark.process
@pytest.mark.timeout(900)
@pytest.mark.parametrize("package", LITERAL)
def test_literal_hash_equals_that_of_libraries(package: str, tmp_path: Path) -> None:
    """Two libraries take char literally; nedbus recognizes their hash, and knows that it is not the one of ROS 2."""
    definition = MESSAGES["LogMessage"]
    (layout,) = definition.layouts.values()
    text = definition_text(definition, layout)
    command = [str(install(tmp_path / "venv", package) / "python"), "-c", LITERAL[package]]
    done = subprocess.run(
        command, input=text, capture_output=True, text=True, timeout=200, check=False
    )
    assert done.returncode == 0, done.stderr
    found = done.stdout.split()[-1]
    assert (
        found
        == hash_of_msg("LogMessage", text, literal_char=True)
        != hash_of(layout, ros2_type(definition))
    )
    assert has_char_hash(found)
    assert message_of_type_hash(found) == (definition, layout)
