"""A recording on the page, without a browser: its time runs, pauses and jumps, and all is as it was then."""

from __future__ import annotations

import math
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from bokeh.models import DatetimeTickFormatter, HBar

from nedbus.errors import NedbusError
from nedbus.events import Event, Span
from nedbus.recording import RecordingWriter
from nedbus.web.fleet import TRUTH
from nedbus.web.playback import Player, Recording
from nedbus.web.style import DARK
from nedbus.web.time_plots import Timeline
from nedbus_msgs import DEFAULT, Address, Provenance
from nedbus_msgs.arrays import to_array
from nedbus_msgs.messages import VehicleAttitude
from tests.flights.messages import VALID, VLP, message
from tests.nedbus.web.page import Shown, write_flight
from tests.waits import wait_for


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Open a flight of three minutes with a reset and half a minute without xy."""

    def fields(time: float) -> dict[str, object]:
        flags = {"xy_valid": not 90 <= time < 120, "xy_reset_counter": int(time >= 150)}
        return {"x": time, "y": math.sin(time) + 4.0 * flags["xy_reset_counter"], **flags}

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
    return list(player.controls)


def run(player: Player, clock: SimpleNamespace, seconds: float, step: float = 0.5) -> None:
    for _ in range(round(seconds / step)):
        clock.now += step
        player.tick()


def shown(player: Player) -> object:
    """Return what a page shows of each vehicle: its state, where it is, and its last minute."""
    picture = player.fleet.picture
    end = picture.time * 1e3
    found = []
    for row in picture.rows:
        found.append(repr((row.vehicle, row.grade, row.state.text, row.state.since, row.where, row.state.conditions)))
        for line in row.lines:
            points = line.stream.minute.points(0, line.stream.minute.written)
            found.append(repr((line.address, line.words, points[points[:, 0] > end - 50_000].tolist())))
    return found


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
    assert [(row.vehicle, row.grade) for row in player.fleet.picture.rows] == [("wing", "watch")], "after a reset"


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


class Page(Shown):
    """The document of a viewer of a recording, as `nedbus web` shows it."""

    def __init__(self, recording: Recording, player: Player, **options: Any) -> None:
        super().__init__(
            player.fleet, recording.chronicle, title=recording.name, player=player, **options
        )  # fmt: skip
        self.player = player
        self.update()


def open_page(recording: Recording, asked: str = "") -> Page:
    """Open a page whose time stands still."""
    player = Player(recording)
    pick(player)[0].active = False
    return Page(recording, player, asked=asked)


@pytest.mark.usefixtures("clock")
def test_event_is_jumped_to(recording: Recording) -> None:
    """A mark on the slider, an event in the timeline, and the keys n and p set the time to when it happened.

    The state, the verdict and the marker are of that moment.
    """
    page = open_page(recording)
    assert page.grades == {"wing": "ok"}
    assert page.moments == (0.0, 60.0)
    marks = re.findall(r'data-with="(\d+)" title="([^"]*)" class="(\w+)"\s+style="left: ([\d.]+)%"', page.part("marks"))
    assert [(text, grade) for _, text, grade, _ in marks] == [
        ("xy not valid", "bad"), ("reset of xy by 4.1 m (0.1 north, 4.1 east)", "watch"),
    ]  # fmt: skip
    assert float(marks[0][3]) == pytest.approx(50, abs=0.2)
    page.say("event", marks[0][0])
    assert page.player.time == pytest.approx(90, abs=0.01)
    assert (page.grades, page.document.title) == ({"wing": "bad"}, "(1 bad) flight.mcap")
    assert '<div class="verdict">not usable: xy not valid from 91.000 to 121.000 s since boot (30.0 s)' in page.part(
        "why"
    )
    assert page.marks["wing"]["north"] == pytest.approx(89.9)
    assert page.moments == pytest.approx((30, 90), abs=0.01)
    page.say("next")
    assert page.player.time == pytest.approx(150, abs=0.01)
    assert page.grades == {"wing": "watch"}
    page.say("previous")
    assert page.player.time == pytest.approx(90, abs=0.01)
    page.say("right")
    page.say("RIGHT")
    page.say("left")
    assert page.player.time == pytest.approx(100, abs=0.01)
    page.say("now")
    assert page.player.time == pytest.approx(100, abs=0.01)
    page.say("play")
    assert pick(page.player)[0].active
    page.say("trail")
    assert page.moments == pytest.approx((0, 179.9), abs=0.01)
    assert page.plotted["time"][-1] == pytest.approx(179_500, abs=500), "the whole flight, also what is still to come"


@pytest.mark.usefixtures("clock")
def test_recording_begins_with_its_faults(recording: Recording) -> None:
    """The verdict on the recording is below its vehicles, with a list of faults, each a link to its moment.

    Times are by the vehicle's clock, which the header and the axes name.
    """
    page = open_page(recording)
    assert '<div class="verdict">not usable: xy not valid from 91.000 to 121.000 s since boot' in page.part("list")
    faults = re.findall(r'data-do="fault" data-with="(\d)">.*?<b>(.*?)</b> (.*?)</div>', page.part("list"))
    assert faults == [("0", "xy not valid", "from 91.000 to 121.000 s since boot (30.0 s)")]
    assert "1.0 s since boot, 0.0 s since the start" in page.part("head")
    assert page.viewer._clock.args == {"start": 1.0, "clock": "s since boot"}
    assert page.grades == {"wing": "ok"}
    page.say("fault", "0")
    assert page.grades == {"wing": "bad"}
    for value in ("0", "1", "-1", "x", "9" * 200):
        page.say("fault", value)
        assert page.player.time == pytest.approx(90, abs=0.01)


@pytest.mark.usefixtures("clock")
def test_address_of_a_recording_names_its_moment(recording: Recording) -> None:
    """The address of a page of a recording opens the same vehicle, view and moment."""
    page = open_page(recording)
    for do in (("next", ""), ("focus:vehicle", ""), ("right", "")):
        page.say(*do)
    other = open_page(recording, asked=page.address)
    other.update()
    assert page.player.time == pytest.approx(91, abs=0.01)
    assert other.player.time == pytest.approx(91, abs=0.06)
    assert other.address == page.address
    for part in ("tool", "nums", "why", "list"):
        assert other.part(part) == page.part(part)


@pytest.mark.slow
@pytest.mark.usefixtures("clock")
def test_any_time_in_an_address_is_survived(recording: Recording) -> None:
    """An invalid time, or one outside the recording, opens the page at a moment within it."""
    for asked in ("time=nan", "time=1e300", "time=-5", "time=99:99", "time=inf", "time=x"):
        assert 0 <= open_page(recording, asked=asked).player.time <= recording.length


@pytest.mark.slow  # test_viewer.py has the same for a live page
@pytest.mark.usefixtures("clock")
def test_whatever_a_browser_says_of_a_recording_is_survived(recording: Recording) -> None:
    """No action, index or time of a browser stops the page, nor leaves the recording."""
    page = open_page(recording)
    for action in ("left", "left:999", "LEFT:", "Left", "right:x", "play", "play", "now", "next", "previous", "event"):
        values: list[object] = ["", "-1", "99", "x", "NaN", "9" * 200, None, {}, [1], 1e300]
        for value in values:
            page.say(action, value)
    _, _, slider = pick(page.player)
    for seconds in (-1e300, 1e300, float("nan"), float("inf"), -float("inf")):
        slider.trigger("value_throttled", None, seconds)
        page.update()
        assert 0 <= page.player.time <= recording.length
    assert page.vehicles == ["wing"]


def test_of_other_messages_only_the_time_is_kept(tmp_path: Path, clock: SimpleNamespace) -> None:
    """A recording with them shows their rate and age, and reads no more of them than PX4's time."""
    file = write_flight(tmp_path, {VLP: lambda _: {}, "vehicle_attitude": lambda _: {}}, seconds=20)
    opened = Recording(file)
    wait_for(lambda: opened.length > 19.8, what="the recording")
    assert {type(payload) for address, payload in opened.entries if address.topic != VLP} == {int}
    player = Player(opened)
    run(player, clock, 10)
    assert Page(opened, player).moments == pytest.approx((0, 19.9), abs=0.01), "the plots end with the recording"
    (row,) = player.fleet.picture.rows
    line = next(line for line in row.lines if line.address.topic == "vehicle_attitude")
    assert line.health.rate == pytest.approx(10, rel=0.1)
    assert (line.words, line.stream.minute.written, line.health.messages) == ("ok", 0, 101)


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


def test_jump_keeps_vehicles_that_are_silent_by_then(tmp_path: Path, clock: SimpleNamespace) -> None:
    """One that fell silent long before has its row, its state and its last valid place, as without a jump."""
    file = tmp_path / "silent.mcap"
    with RecordingWriter(file) as writer:
        for second in range(120):
            for vehicle in ("here", "silent"):
                if vehicle == "here" or second < 20:
                    sent = message(1_000_000 * (second + 1), **VALID | {"x": 7.0, "xy_valid": second < 15})
                    stamps = [1_700_000_000_000_000_000 + second * 10**9]
                    stream = [(Address(vehicle, VLP), Provenance("sim"))]
                    writer.write(to_array([sent]), DEFAULT, stream, logged=stamps, published=stamps)
    recording = Recording(file)
    wait_for(lambda: recording.is_read, what="the recording")
    player = Player(recording)
    player.jump(119.0)
    rows = {row.vehicle: row for row in player.fleet.picture.rows}
    assert {name: row.grade for name, row in rows.items()} == {"here": "bad", "silent": "bad"}
    assert rows["silent"].state.text.startswith("silent")
    assert {row.where.partition(",")[0] for row in rows.values()} == {"7.0 m north"}
    silent = next(event for event in recording.chronicle.events if event.kind == "silent")
    assert 22.0 <= silent.time <= 24.0


def test_condition_after_the_playback_time_lasts_to_the_end() -> None:
    """A condition that never ends is drawn from its begin to the end of the recording, also if that is yet to come."""
    begin = Event("1", "failsafe_flag", "begin", "watch", "failsafe flags: position", 50.0)
    span = Span("failsafe_flag", "watch", begin.text, 50.0, begin)
    timeline = Timeline(DARK, DatetimeTickFormatter())
    timeline.update([begin], {"1": [span]}, ["1"], begin=0.0, end=60.0, now=10.0)
    renderers: list[Any] = list(timeline.figure.renderers)
    [bars] = [each.data_source.data for each in renderers if isinstance(getattr(each, "glyph", None), HBar)]
    assert (list(bars["begin"]), list(bars["end"])) == ([50e3], [60e3])


def test_timeline_of_a_log_with_many_texts_has_the_latest_faults() -> None:
    """A log may have 100,000 texts, too many for a browser: beyond 2,000 marks only the latest faults are drawn."""
    info = [Event("1", "text", "once", "info", "text", 0.01 * number) for number in range(3000)]
    watch = [Event("1", "text", "once", "watch", "text", 0.01 * number) for number in range(2500)]
    timeline = Timeline(DARK, DatetimeTickFormatter())
    cases: list[tuple[list[Event], list[Event]]] = [
        (info[:1500], info[:1500]), (info, []), ([*info, *watch[:7]], watch[:7]), (watch, watch[-2000:]),
    ]  # fmt: skip
    for events, shown in cases:
        timeline.update(events, {}, ["1"], begin=0.0, end=60.0, now=10.0)
        assert timeline.shown == shown
