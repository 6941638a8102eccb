"""Fixtures: images that are built once, and compose stacks that are removed after the test."""

from __future__ import annotations

import fcntl
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import nedbus

from .recorder import Recorder
from .stack import ENVIRONMENT, ROOT, SUBSTITUTE_ROUTER, Stack, docker, require_docker

StartStack = Callable[..., Stack]
Record = Callable[[nedbus.Subscription[Any]], Recorder]


@pytest.fixture(scope="session")
def images(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Build the image of nedbus, and if requested the substitute for the official router image."""
    require_docker()
    with Path(tmp_path_factory.getbasetemp().parent, "images").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)  # the first worker builds, the others use its images
        Stack("build", tmp_path_factory.mktemp("build")).compose("build")
        if ENVIRONMENT.get("NEDBUS_ROUTER_IMAGE") == SUBSTITUTE_ROUTER:
            docker(
                "build",
                "--quiet",
                "--tag",
                SUBSTITUTE_ROUTER,
                str(ROOT / "tests" / "compose" / "router"),
            )


@pytest.fixture
def make_stack(images: None, tmp_path: Path) -> Iterator[StartStack]:
    """Make stacks from the shipped compose files, without starting them."""
    stacks: list[Stack] = []

    def make(name: str, *files: str, directory: Path = ROOT, **environment: str) -> Stack:
        stacks.append(Stack(name, tmp_path, *files, directory=directory, **environment))
        return stacks[-1]

    yield make
    for stack in stacks:
        stack.down()


@pytest.fixture
def record() -> Iterator[Record]:
    """Start recorders, which are closed after the test."""
    recorders: list[Recorder] = []

    def start(subscription: nedbus.Subscription[Any]) -> Recorder:
        recorders.append(Recorder(subscription))
        return recorders[-1]

    yield start
    for recorder in recorders:
        recorder.close()
