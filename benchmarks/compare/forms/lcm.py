"""LCM without a router: the class that lcm-gen makes, over UDP multicast that stays on this machine; may lose some."""

import importlib
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import lcm

from benchmarks.compare.case import Case
from benchmarks.compare.fields import FIELDS, TYPES

PACKAGES = ["lcm==1.5.3"]

URL = "udpm://239.255.76.67:7667?ttl=0&recv_buf_size=4194304"
CHANNEL = "vehicle_local_position"


# LCM has only signed integers of these sizes.
LCM_TYPES = {
    "bool": "boolean",
    "uint64": "int64_t",
    "uint8": "byte",
    "float32": "float",
    "float64": "double",
}


def field(name: str, type_name: str) -> str:
    """Return the declaration of a field."""
    kind, bracket, rest = type_name.partition("[")
    return f"{LCM_TYPES[kind]} {name}{bracket}{rest};"


def generate() -> Any:
    """Run lcm-gen, like a build, and import the generated class."""
    with tempfile.TemporaryDirectory() as directory:
        source = Path(directory, "position.lcm")
        source.write_text(
            f"struct bench_position {{ {' '.join(field(*item) for item in TYPES.items())} }}"
        )
        subprocess.run(
            [Path(lcm.LCM_BIN_DIR, "lcm-gen"), "-p", "--ppath", directory, source], check=True
        )
        sys.path.insert(0, directory)
        try:
            return importlib.import_module("bench_position").bench_position
        finally:
            sys.path.remove(directory)


Position = generate()


@contextmanager
def publish(case: Case) -> Iterator[list[Callable[[int], None]]]:
    link = lcm.LCM(URL)

    def send(stamp: int) -> None:
        message = Position()
        for name, value in FIELDS.items():
            setattr(message, name, value)
        message.timestamp = stamp
        link.publish(CHANNEL, message.encode())

    yield [send]


def receive(case: Case, ready: Callable[[], None], seen: Callable[[int], bool]) -> None:
    going = True

    def take(_channel: str, data: bytes) -> None:
        nonlocal going
        message = Position.decode(data)
        going = seen(message.timestamp if message.x else 0)

    link = lcm.LCM(URL)
    subscription = link.subscribe(CHANNEL, take)
    subscription.set_queue_capacity(0)  # no limit
    ready()
    while going:
        link.handle()
