"""Fixtures: images that are built once, and stacks that leave nothing behind."""

from __future__ import annotations

import fcntl
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import nedbus

from .recorder import Recorder
from .stack import ENVIRONMENT, ROOT, STAND_IN, Stack, docker, require_docker

StartStack = Callable[..., Stack]
Record = Callable[[nedbus.Subscription[Any]], Recorder]


@pytest.fixture(scope="session")
def images(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Build the image, and the router that stands in for the official one if that was asked for."""
    require_docker()
    with Path(tmp_path_factory.getbasetemp().parent, "images").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # of all workers the first builds, and the others find what it built
        Stack("build", tmp_path_factory.mktemp("build")).compose("build")
        if ENVIRONMENT.get("NEDBUS_ROUTER_IMAGE") == STAND_IN:
            docker("build", "--quiet", "--tag", STAND_IN, str(ROOT / "tests" / "compose" / "router"))


@pytest.fixture
def make_stack(images: None, tmp_path: Path) -> Iterator[StartStack]:
    """Make stacks of the shipped files; nothing is started yet."""
    stacks: list[Stack] = []

    def make(name: str, *files: str, directory: Path = ROOT, **environment: str) -> Stack:
        stacks.append(Stack(name, tmp_path, *files, directory=directory, **environment))
        return stacks[-1]

    yield make
    for stack in stacks:
        stack.down()


@pytest.fixture
def record() -> Iterator[Record]:
    """Make recorders that end with the test."""
    recorders: list[Recorder] = []

    def start(subscription: nedbus.Subscription[Any]) -> Recorder:
        recorders.append(Recorder(subscription))
        return recorders[-1]

    yield start
    for recorder in recorders:
        recorder.close()
