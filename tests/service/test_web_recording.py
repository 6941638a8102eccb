"""A recording on the page, without a browser: its time runs, pauses and jumps, and the fleet is as it was then."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from nedbus.errors import NedbusError
from nedbus.recording import RecordingWriter
from nedbus.web.fleet import TRUTH
from nedbus.web.playback import Player, Recording
from nedbus_msgs import Address, Provenance
from nedbus_msgs.arrays import to_array
from nedbus_msgs.messages import VehicleAttitude
from tests.messages import VLP
from tests.waits import wait_for
from tests.web import write_flight


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Open a flight of three minutes with a reset and half a minute without xy."""

    def fields(time: float) -> dict[str, object]:
        flags = {"xy_valid": not 90 <= time < 120, "xy_reset_counter": int(time >= 150)}
        return {"x": time, "y": math.sin(time), **flags}

    file = write_flight(tmp_path_factory.mktemp("web"), dict.fromkeys((VLP, TRUTH), fields), seconds=180)
    opened = Recording(file)
    wait_for(lambda: opened.length > 179.8, what="the recording")
    return opened


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Return the time that players see."""
    shown = SimpleNamespace(now=100.0)
    monkeypatch.setattr("nedbus.web.playback.time", SimpleNamespace(monotonic=lambda: shown.now))
    return shown


def pick(player: Player) -> list[Any]:
    """Return the button, the choice of the speed, and the slider."""
    return player.controls.children[:3]


def run(player: Player, clock: SimpleNamespace, seconds: float, step: float = 0.5) -> None:
    for _ in range(round(seconds / step)):
        clock.now += step
        player.tick()


def shown(player: Player) -> object:
    """Return what a page shows of each stream: its condition, where it is, and its last minute."""
    picture = player.fleet.picture
    end = picture.time * 1e3
    found = []
    for line in picture.lines:
        points = line.stream.points(0, line.stream.written)
        recent = points[points[:, 0] > end - 50_000]
        found.append((line.address, line.condition, line.words, line.where, len(line.stream.resets), recent.tolist()))
    return repr(found)


def test_recording_plays_at_its_speed(recording: Recording, clock: SimpleNamespace) -> None:
    """The time runs as the clock does, times the speed, not while it is paused, and ends with the recording."""
    player = Player(recording)
    play, speed, slider = pick(player)
    run(player, clock, 10)
    assert slider.value == pytest.approx(10, abs=0.2)
    assert slider.end == pytest.approx(179.9)
    speed.value = "5"
    run(player, clock, 10)
    assert slider.value == pytest.approx(60, abs=0.6)
    play.active = False
    assert play.label == "play"
    run(player, clock, 10)
    assert slider.value == pytest.approx(60, abs=0.6)
    play.active = True
    speed.value = "50"
    run(player, clock, 10)
    assert slider.value == pytest.approx(179.9)
    assert {line.condition for line in player.fleet.picture.lines} == {"ok"}


@pytest.mark.parametrize("target", [5.0, 61.0, 100.0, 155.0, 179.9])
def test_jump_shows_what_playing_there_shows(recording: Recording, clock: SimpleNamespace, target: float) -> None:
    """Wherever somebody jumps, back or forth, the page is the same as if the recording had been played until there."""
    player = Player(recording)
    run(player, clock, target)
    jumped = Player(recording)
    run(jumped, clock, 30)
    play, _, slider = pick(jumped)
    play.active = False
    jumps: list[float] = []
    jumped.on_jump = lambda: jumps.append(1.0)
    for place in (179.0, 0.0, player.fleet.picture.time):
        slider.trigger("value_throttled", None, place)
        jumped.tick()
    assert len(jumps) == 3
    assert shown(jumped) == shown(player)
    for old, new in zip(player.fleet.picture.lines, jumped.fleet.picture.lines, strict=True):
        assert new.since == pytest.approx(max(old.since, target - 60), abs=1.0)


@pytest.mark.parametrize("value", ["inf", "nan", "-5", "1e300", "fast"])
def test_any_speed_of_a_browser_is_survived(recording: Recording, clock: SimpleNamespace, value: str) -> None:
    """A browser may send any speed and any time: its page stays within the recording."""
    player = Player(recording)
    _, speed, slider = pick(player)
    run(player, clock, 1)
    speed.options = [*speed.options, value]
    speed.value = value
    run(player, clock, 1)
    assert 0 <= float(slider.value) <= 180
    slider.trigger("value_throttled", None, -1e9)
    run(player, clock, 1)
    assert 0 <= float(slider.value) <= 180


def test_of_other_messages_only_the_time_is_kept(tmp_path: Path, clock: SimpleNamespace) -> None:
    """A recording with them shows their rate and age, and reads no more of them than PX4's time."""
    file = write_flight(tmp_path, {VLP: lambda _: {}, "vehicle_attitude": lambda _: {}}, seconds=20)
    opened = Recording(file)
    wait_for(lambda: opened.length > 19.8, what="the recording")
    assert {type(payload) for address, payload in opened.entries if address.topic != VLP} == {int}
    player = Player(opened)
    run(player, clock, 10)
    line = next(line for line in player.fleet.picture.lines if line.address.topic == "vehicle_attitude")
    assert line.health.rate == pytest.approx(10, rel=0.1)
    assert (line.condition, line.stream.written, line.health.messages) == ("ok", 0, 100)


def test_message_without_a_time_is_rejected(tmp_path: Path) -> None:
    """A recording may say that its source gave no timestamp: that message is invalid, and those behind it are read."""
    file, attitude = tmp_path / "a.mcap", Address("1", "vehicle_attitude")
    messages = to_array([VehicleAttitude(timestamp=number) for number in (1, 2)])
    with RecordingWriter(file) as writer:
        streams = [(attitude, Provenance("sim", frozenset(missing))) for missing in (["timestamp"], [])]
        writer.write(messages, VehicleAttitude.DEFINITION, streams, logged=(1, 2), published=(1, 2))
    opened = Recording(file)
    wait_for(lambda: len(opened.entries) == 2, what="the recording")
    assert opened.entries == [(attitude, "timestamp: Field required"), (attitude, 2)]


def test_damaged_recording_is_an_error(tmp_path: Path) -> None:
    """A file that is no recording is said to be none before a page is served."""
    file = tmp_path / "flight.ulg"
    file.write_bytes(b"nothing")
    with pytest.raises(NedbusError, match=r"flight\.ulg"):
        Recording(file)
