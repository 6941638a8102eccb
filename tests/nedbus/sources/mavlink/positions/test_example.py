"""The example of motion capture: its positions are fused."""

from __future__ import annotations

from pathlib import Path

import pytest

import nedbus
from tests.peers.processes import Start
from tests.waits import wait_for

from .px4_vision import Px4OnLink
from .test_position_sender import Setup

EXAMPLE = Path(__file__).parents[5] / "examples" / "mocap.py"


@pytest.mark.slow
def test_positions_of_the_example_are_fused(start: Start) -> None:
    """PX4 fuses position, height and yaw of examples/mocap.py, which has no velocity."""
    setup = Setup(start)
    with nedbus.connect(setup.endpoint, timeout=20):  # the service is up
        start(str(EXAMPLE), NEDBUS_CONNECT=setup.endpoint, coverage=False)
    expected = {"position": "fused", "height": "fused", "velocity": "not received", "yaw": "fused"}
    with Px4OnLink(setup.port) as px4:
        wait_for(lambda: px4.state() == expected, what="fusion")
