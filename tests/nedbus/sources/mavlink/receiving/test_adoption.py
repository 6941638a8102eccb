"""Adoption of a running ULog stream whose definitions an earlier process saved."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import pytest
from pymavlink.dialects.v20 import common as dialect

from nedbus.mavlink.log_reassembly import Chunk
from nedbus.sources import Rejection
from nedbus.sources.mavlink.receive_queue import Received
from nedbus.sources.mavlink.saved_stream import StreamFile, state_path
from nedbus.sources.options import MavlinkOptions
from tests.flights.recorded_link import Receiver

DEFINITIONS: Final = b"ULog" + bytes(50)
OURS: Final = (245, 191)
SAVED: Final = 500.0
"""Host time of the last message of the earlier process [s], 60 s after the vehicle's boot; its sequence is 1000."""


class Link:
    """A receiver without a thread, and the messages of an armed vehicle, system 4."""

    def __init__(self, folder: Path, *, state: str | None = None) -> None:
        options = MavlinkOptions.model_validate({"log": "1", "state": state or str(folder)})
        file = StreamFile(state_path(MavlinkOptions(state=str(folder)), "udp", 4), 4)
        file.write(DEFINITIONS)
        file.update(1000, 60_000_000, SAVED)
        file.close()
        self.receiver, self._sequence = Receiver(options), -1

    def receive(self, message: Any, now: float) -> Received | Rejection:
        self._sequence += 1
        return self.receiver.process(Received(message, 4, self._sequence, "peer", now))

    def introduce(self, now: float, boot: float) -> None:
        """Receive a HEARTBEAT and a message with the vehicle's time [s since boot]."""
        armed = dialect.MAV_MODE_FLAG_SAFETY_ARMED
        self.receive(
            dialect.MAVLink_heartbeat_message(2, dialect.MAV_AUTOPILOT_PX4, armed, 0, 4, 3), now
        )
        self.receive(dialect.MAVLink_local_position_ned_message(round(1000 * boot), *range(6)), now)

    def data(
        self, sequence: int, now: float, *, target: tuple[int, int] = OURS
    ) -> Received | Rejection:
        """Receive LOGGING_DATA in which a record begins."""
        return self.receive(
            dialect.MAVLink_logging_data_message(*target, sequence, 3, 0, [1, 2, 3, *[0] * 246]),
            now,
        )

    @property
    def state(self) -> str:
        return self.receiver.vehicles[4].client.status.state


def chunk_of(item: Received | Rejection) -> Chunk | None:
    assert isinstance(item, Received), item
    return item.chunk


def test_running_stream_is_continued_with_its_gap(tmp_path: Path) -> None:
    """The first LOGGING_DATA yields the saved definitions; the next one, the losses since the earlier process."""
    link = Link(tmp_path)
    link.introduce(SAVED + 2, 62.0)
    assert chunk_of(link.data(1500, SAVED + 2.1)) == Chunk("delivered", DEFINITIONS, begins=True)
    assert chunk_of(link.data(1501, SAVED + 2.2)) == Chunk("delivered", b"\1\2\3", lost=500)
    assert chunk_of(link.data(1502, SAVED + 2.3)) == Chunk("delivered", b"\1\2\3")
    assert link.state == "streaming"


def test_stream_is_continued_once_its_boot_is_known(tmp_path: Path) -> None:
    """Until a message with the vehicle's time has arrived, data of a running stream is neither used nor rejected."""
    link = Link(tmp_path)
    link.receive(
        dialect.MAVLink_heartbeat_message(2, dialect.MAV_AUTOPILOT_PX4, 128, 0, 4, 3), SAVED + 2
    )
    assert chunk_of(link.data(1500, SAVED + 2.1)) is None
    link.introduce(SAVED + 2.2, 62.2)
    assert chunk_of(link.data(1501, SAVED + 2.3)) == Chunk("delivered", DEFINITIONS, begins=True)


def test_data_before_the_first_heartbeat_is_no_fault(tmp_path: Path) -> None:
    """Data of a running stream that arrives before a HEARTBEAT is not rejected, because the stream is continued."""
    link = Link(tmp_path)
    assert chunk_of(link.data(1499, SAVED + 2.0)) is None
    link.introduce(SAVED + 2.2, 62.2)
    assert chunk_of(link.data(1500, SAVED + 2.3)) == Chunk("delivered", DEFINITIONS, begins=True)


def test_new_stream_is_not_continued(tmp_path: Path) -> None:
    """A stream that begins, with sequence 0, has definitions of its own: the saved ones are not used."""
    link = Link(tmp_path)
    link.introduce(SAVED + 2, 62.0)
    rejected = link.data(0, SAVED + 2.1)
    assert isinstance(rejected, Rejection)
    assert "of a stream that was not requested" in rejected.reason


@pytest.mark.parametrize(("boot", "state", "reason"), [
    (5.0, None, "the vehicle has rebooted since its definitions were saved"),
    (62.0, "0", "state=0 is set"),
    (62.0, "elsewhere", "its definitions are not in"),
])  # fmt: skip
def test_stream_that_cannot_be_continued_is_rejected(
    tmp_path: Path, boot: float, state: str | None, reason: str
) -> None:
    """Data of a stream without usable definitions is rejected with the reason and the remedy."""
    link = Link(tmp_path, state=str(tmp_path / state) if state == "elsewhere" else state)
    link.introduce(SAVED + 2, boot)
    for sequence in (1500, 1501):
        rejected = link.data(sequence, SAVED + 2.1)
        assert isinstance(rejected, Rejection)
        assert f"cannot be continued, because {reason}" in rejected.reason
        assert "it restarts after disarming, or at once with log=armed" in rejected.reason
    assert link.state != "streaming"


def test_stream_of_another_client_is_not_continued(tmp_path: Path) -> None:
    """Data that is addressed to other ids is ignored, although the definitions are known."""
    link = Link(tmp_path)
    link.introduce(SAVED + 2, 62.0)
    for target in ((255, 190), (245, 190), (246, 191)):
        assert chunk_of(link.data(1500, SAVED + 2.1, target=target)) is None
    assert link.state != "streaming"
