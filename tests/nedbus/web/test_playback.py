"""Playback of a recording on the page, without a browser: play, pause, seek, events and URLs."""

from __future__ import annotations

import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from bokeh.models import DatetimeTickFormatter, HBar

from nedbus.errors import NedbusError
from nedbus.flights import RecordingWriter
from nedbus.vehicle_events import Event, Span
from nedbus.web.fleet import TRUTH
from nedbus.web.playback import Player, Recording
from nedbus.web.style import DARK
from nedbus.web.time_plots import TimelinePlot
from nedbus_msgs import DEFAULT, Address, Provenance
from nedbus_msgs.arrays import to_array
from nedbus_msgs.messages import VehicleAttitude
from tests.flights.messages import VALID, VLP, message
from tests.nedbus.web.page import RenderedPage, describe, write_flight
from tests.waits import wait_for


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Recording:
    """Open a flight of three minutes with a reset and half a minute of invalid xy."""

    def fields(time: float) -> dict[str, object]:
        flags = {"xy_valid": not 90 <= time < 120, "xy_reset_counter": int(time >= 150)}
        return {"x": time, "y": math.sin(time) + 4.0 * flags["xy_reset_counter"], **flags}

    file = write_flight(
        tmp_path_factory.mktemp("web"), dict.fromkeys((VLP, TRUTH), fields), seconds=180
    )
    opened = Recording(file)
    wait_for(lambda: opened.length > 179.8, what="the recording")
    return opened


@pytest.fixture
def clock(monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Return the fake clock of all players; `now` [s] can be set."""
    shown = SimpleNamespace(now=100.0)
    monkeypatch.setattr("nedbus.web.playback.time", SimpleNamespace(monotonic=lambda: shown.now))
    return shown


def controls_of(player: Player) -> list[Any]:
    """Return the play button, the speed menu and the slider."""
    return list(player.controls)


def run(player: Player, clock: SimpleNamespace, seconds: float, step: float = 0.5) -> None:
    for _ in range(round(seconds / step)):
        clock.now += step
        player.tick()


def shown(player: Player) -> object:
    """Return all that a page shows of each vehicle: state, position, and the last minute of each stream."""
    snapshot = player.fleet.snapshot
    end = snapshot.time * 1e3
    found = []
    for row in snapshot.vehicles:
        found.append(
            repr(
                (
                    row.vehicle,
                    row.grade,
                    row.state.text,
                    row.state.since,
                    row.last_position,
                    row.state.conditions,
                )
            )
        )
        for view in row.streams:
            points = view.stream.minute.points(0, view.stream.minute.written)
            found.append(
                repr((view.address, describe(view), points[points[:, 0] > end - 50_000].tolist()))
            )
    return found


@pytest.mark.long
def test_recording_plays_at_the_selected_speed(
    recording: Recording, clock: SimpleNamespace
) -> None:
    """The playback position advances by elapsed time times speed, stops while paused, and ends with the recording."""
    player = Player(recording)
    play, speed, slider = controls_of(player)
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
    assert [(row.vehicle, row.grade) for row in player.fleet.snapshot.vehicles] == [
        ("wing", "watch")
    ], "after a reset"


@pytest.mark.slow
@pytest.mark.parametrize("target", [5.0, 61.0, 100.0, 155.0, 179.9])
def test_seek_equals_playing_to_that_time(
    recording: Recording, clock: SimpleNamespace, target: float
) -> None:
    """After a seek, back or forward, the page is the same as if the recording had been played up to that time."""
    player = Player(recording)
    run(player, clock, target)
    sought = Player(recording)
    run(sought, clock, 30)
    play, _, slider = controls_of(sought)
    play.active = False
    seeks: list[float] = []
    sought.on_seek = lambda: seeks.append(1.0)
    for place in (179.0, 0.0, player.fleet.snapshot.time):
        slider.trigger("value_throttled", None, place)
        sought.tick()
    assert len(seeks) == 3
    assert shown(sought) == shown(player)


@pytest.mark.parametrize("value", ["inf", "nan", "-5", "1e300", "fast"])
def test_invalid_speed_from_the_browser_is_ignored(
    recording: Recording, clock: SimpleNamespace, value: str
) -> None:
    """Whatever speed or time a browser sends, the playback position stays within the recording."""
    player = Player(recording)
    _, speed, slider = controls_of(player)
    run(player, clock, 1)
    speed.options = [*speed.options, value]
    speed.value = value
    run(player, clock, 1)
    assert 0 <= float(slider.value) <= 180
    slider.trigger("value_throttled", None, -1e9)
    run(player, clock, 1)
    assert 0 <= float(slider.value) <= 180


class Page(RenderedPage):
    """The document of a viewer of a recording, as `nedbus web FILE` shows it."""

    def __init__(self, recording: Recording, player: Player, **options: Any) -> None:
        super().__init__(
            player.fleet, recording.timeline, title=recording.name, player=player, **options
        )  # fmt: skip
        self.player = player
        self.update()


def open_page(recording: Recording, query: str = "") -> Page:
    """Open a page whose playback is paused."""
    player = Player(recording)
    controls_of(player)[0].active = False
    return Page(recording, player, query=query)


@pytest.mark.slow
@pytest.mark.usefixtures("clock")
def test_selecting_an_event_seeks_to_it(recording: Recording) -> None:
    """A mark on the slider, an event on the timeline, and the keys n and p seek to the time of an event.

    State, verdict and marker change to that time.
    """
    page = open_page(recording)
    assert page.grades == {"wing": "ok"}
    assert page.plot_range == (0.0, 60.0)
    marks = page.elements("marks", "span")
    assert [(mark.get("title"), mark.get("class")) for mark in marks] == [
        ("xy not valid", "bad"), ("reset of xy by 4.1 m (0.1 north, 4.1 east)", "watch"),
    ]  # fmt: skip
    assert float(marks[0].get("style", "").removeprefix("left: ").rstrip("%")) == pytest.approx(
        50, abs=0.2
    )
    page.send("event", marks[0].get("data-with"))
    assert page.player.time == pytest.approx(90, abs=0.01)
    assert (page.grades, page.document.title) == ({"wing": "bad"}, "(1 bad) flight.mcap")
    (verdict,) = page.texts("why", "verdict")
    assert verdict.startswith(
        "not usable: xy not valid from 91.000 to 121.000 s since boot (30.0 s)"
    )
    assert page.marks["wing"]["north"] == pytest.approx(89.9)
    assert page.plot_range == pytest.approx((30, 90), abs=0.01)
    page.send("next")
    assert page.player.time == pytest.approx(150, abs=0.01)
    assert page.grades == {"wing": "watch"}
    page.send("previous")
    assert page.player.time == pytest.approx(90, abs=0.01)
    page.send("right")
    page.send("RIGHT")
    page.send("left")
    assert page.player.time == pytest.approx(100, abs=0.01)
    page.send("now")
    assert page.player.time == pytest.approx(100, abs=0.01)
    page.send("play")
    assert controls_of(page.player)[0].active
    page.send("trail")
    assert page.plot_range == pytest.approx((0, 179.9), abs=0.01)
    assert page.plotted["time"][-1] == pytest.approx(179_500, abs=500), "the whole flight"


@pytest.mark.slow
@pytest.mark.usefixtures("clock")
def test_recording_page_lists_verdict_and_faults(recording: Recording) -> None:
    """Below the vehicles are the verdict on the recording and its faults; a click on a fault seeks to it.

    Times are on the vehicle's clock, which header and axes name.
    """
    page = open_page(recording)
    (verdict,), (fault, reset) = page.texts("list", "verdict"), page.elements("list", "fault")
    assert verdict.startswith("not usable: xy not valid from 91.000 to 121.000 s since boot")
    assert (fault.get("data-do"), fault.get("data-with"), fault.findtext("b")) == (
        "fault",
        "0",
        "xy not valid",
    )
    assert str(reset.findtext("b")).startswith("reset of xy by 4.1 m")
    assert page.texts("list", "fault")[0].endswith(
        " xy not valid from 91.000 to 121.000 s since boot (30.0 s)"
    )
    assert "1.0 s since boot, 0.0 s since the start" in page.panel("head")
    assert page.viewer._clock.args == {"start": 1.0, "clock": "s since boot"}
    assert page.grades == {"wing": "ok"}
    page.send("fault", "0")
    assert page.grades == {"wing": "bad"}
    for value in ("0", "2", "-1", "x", "9" * 200):  # there are two faults
        page.send("fault", value)
        assert page.player.time == pytest.approx(90, abs=0.01)


@pytest.mark.slow
@pytest.mark.usefixtures("clock")
def test_url_of_a_recording_restores_the_moment(recording: Recording) -> None:
    """The URL of a recording's page restores vehicle, view and moment."""
    page = open_page(recording)
    for do in (("next", ""), ("focus:vehicle", ""), ("right", "")):
        page.send(*do)
    other = open_page(recording, query=page.url_query)
    other.update()
    assert page.player.time == pytest.approx(91, abs=0.01)
    assert other.player.time == pytest.approx(91, abs=0.06)
    assert other.url_query == page.url_query
    for part in ("tool", "nums", "why", "list"):
        assert other.panel(part) == page.panel(part)


@pytest.mark.long
@pytest.mark.usefixtures("clock")
def test_invalid_time_in_the_url_is_ignored(recording: Recording) -> None:
    """If the time in the URL is invalid or outside the recording, the page opens at a time within it."""
    for query in ("time=nan", "time=1e300", "time=-5", "time=99:99", "time=inf", "time=x"):
        assert 0 <= open_page(recording, query=query).player.time <= recording.length


@pytest.mark.long  # test_viewer.py tests the same on a live page
@pytest.mark.usefixtures("clock")
def test_malformed_actions_leave_the_recording_playable(recording: Recording) -> None:
    """No action, index or time from a browser breaks the page or moves the position outside the recording."""
    page = open_page(recording)
    for action in (
        "left",
        "left:999",
        "LEFT:",
        "Left",
        "right:x",
        "play",
        "play",
        "now",
        "next",
        "previous",
        "event",
    ):
        values: list[object] = ["", "-1", "99", "x", "NaN", "9" * 200, None, {}, [1], 1e300]
        for value in values:
            page.send(action, value)
    _, _, slider = controls_of(page.player)
    for seconds in (-1e300, 1e300, float("nan"), float("inf"), -float("inf")):
        slider.trigger("value_throttled", None, seconds)
        page.update()
        assert 0 <= page.player.time <= recording.length
    assert page.vehicles == ["wing"]


@pytest.mark.slow
def test_only_timestamps_of_other_topics_are_kept(tmp_path: Path, clock: SimpleNamespace) -> None:
    """Only the timestamps of topics other than position and status are kept, for their rate and age."""
    file = write_flight(tmp_path, {VLP: lambda _: {}, "vehicle_attitude": lambda _: {}}, seconds=20)
    opened = Recording(file)
    wait_for(lambda: opened.length > 19.8, what="the recording")
    assert {type(entry.content) for entry in opened.entries if entry.address.topic != VLP} == {int}
    player = Player(opened)
    run(player, clock, 10)
    assert Page(opened, player).plot_range == pytest.approx((0, 19.9), abs=0.01), (
        "the plots end with the recording"
    )
    (row,) = player.fleet.snapshot.vehicles
    view = next(view for view in row.streams if view.address.topic == "vehicle_attitude")
    assert view.health.rate == pytest.approx(10, rel=0.1)
    assert (describe(view), view.stream.minute.written, view.health.messages) == ("ok", 0, 101)


def test_message_without_a_timestamp_is_rejected(tmp_path: Path) -> None:
    """A message whose source provided no timestamp is rejected; the messages after it are read."""
    file, attitude = tmp_path / "a.mcap", Address("1", "vehicle_attitude")
    messages = to_array([VehicleAttitude(timestamp=number) for number in (1, 2)])
    with RecordingWriter(file) as writer:
        streams = [
            (attitude, Provenance("sim", frozenset(missing))) for missing in (["timestamp"], [])
        ]
        writer.write(messages, VehicleAttitude.DEFINITION, streams, logged=(1, 2), published=(1, 2))
    opened = Recording(file)
    wait_for(lambda: len(opened.entries) == 2, what="the recording")
    contents = [(entry.address, entry.content) for entry in opened.entries]
    assert contents == [(attitude, "timestamp: Field required"), (attitude, 2)]


def test_unreadable_recording_raises(tmp_path: Path) -> None:
    """A file that is not a recording raises before the page is served."""
    file = tmp_path / "flight.ulg"
    file.write_bytes(b"nothing")
    with pytest.raises(NedbusError, match=r"flight\.ulg"):
        Recording(file)


def test_seek_keeps_silent_vehicles(tmp_path: Path, clock: SimpleNamespace) -> None:
    """A vehicle that fell silent long before the new time keeps its row, state and last valid position."""
    file = tmp_path / "silent.mcap"
    with RecordingWriter(file) as writer:
        for second in range(120):
            for vehicle in ("here", "silent"):
                if vehicle == "here" or second < 20:
                    sent = message(
                        1_000_000 * (second + 1), **VALID | {"x": 7.0, "xy_valid": second < 15}
                    )
                    stamps = [1_700_000_000_000_000_000 + second * 10**9]
                    stream = [(Address(vehicle, VLP), Provenance("sim"))]
                    writer.write(to_array([sent]), DEFAULT, stream, logged=stamps, published=stamps)
    recording = Recording(file)
    wait_for(lambda: recording.is_read, what="the recording")
    player = Player(recording)
    player.seek(119.0)
    rows = {row.vehicle: row for row in player.fleet.snapshot.vehicles}
    assert {name: row.grade for name, row in rows.items()} == {"here": "bad", "silent": "bad"}
    assert rows["silent"].state.text.startswith("silent")
    assert {row.last_position.partition(",")[0] for row in rows.values()} == {"7.0 m north"}
    silent = next(event for event in recording.timeline.events if event.kind == "silent")
    assert 22.0 <= silent.time <= 24.0


def test_open_condition_is_drawn_to_the_end_of_the_recording() -> None:
    """A condition without an end is drawn to the end of the recording, even beyond the playback position."""
    begin = Event("1", "failsafe_flag", "begin", "watch", "failsafe flags: position", 50.0)
    span = Span("failsafe_flag", "watch", begin.text, 50.0, begin)
    timeline = TimelinePlot(DARK, DatetimeTickFormatter())
    timeline.update([begin], {"1": [span]}, ["1"], begin=0.0, end=60.0, now=10.0)
    renderers: list[Any] = list(timeline.figure.renderers)
    [bars] = [
        each.data_source.data
        for each in renderers
        if isinstance(getattr(each, "glyph", None), HBar)
    ]
    assert (list(bars["begin"]), list(bars["end"])) == ([50e3], [60e3])


def test_timeline_limits_marks_to_the_latest_faults() -> None:
    """A log may have 100,000 texts, too many for a browser: above 2,000 marks only the latest faults are drawn."""
    info = [Event("1", "text", "once", "info", "text", 0.01 * number) for number in range(3000)]
    watch = [Event("1", "text", "once", "watch", "text", 0.01 * number) for number in range(2500)]
    timeline = TimelinePlot(DARK, DatetimeTickFormatter())
    cases: list[tuple[list[Event], list[Event]]] = [
        (info[:1500], info[:1500]), (info, []), ([*info, *watch[:7]], watch[:7]), (watch, watch[-2000:]),
    ]  # fmt: skip
    for events, shown in cases:
        timeline.update(events, {}, ["1"], begin=0.0, end=60.0, now=10.0)
        assert timeline.shown == shown
