"""Fixtures: images that are built once, and stacks that leave nothing behind."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from .recorder import Recorder
from .stack import ENVIRONMENT, ROOT, STAND_IN, Stack, docker, require_docker

StartStack = Callable[..., Stack]


@pytest.fixture(scope="session")
def images(tmp_path_factory: pytest.TempPathFactory) -> None:
    """Build the image, and the router that stands in for the official one if that was asked for."""
    require_docker()
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
def record() -> Iterator[list[Recorder]]:
    """Collect recorders that end with the test."""
    recorders: list[Recorder] = []
    yield recorders
    for recorder in recorders:
        recorder.close()
