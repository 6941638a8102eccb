"""Sources as texts and as TOML tables."""

import os
import re
from pathlib import Path

import pytest

from nedbus.errors import ConfigError
from nedbus.settings import load_settings
from nedbus.sources import parse_source


@pytest.mark.parametrize(
    ("sources", "texts"),
    [
        ('[{ kind = "sim" }]', ["sim:"]),
        (
            '[{ kind = "sim", vehicle = 7, wait = true, duration = 2.5 }]',
            ["sim:?vehicle=7&wait=1&duration=2.5"],
        ),
        (
            '[{ kind = "ulog", file = "a?b 100%.ulg", speed = "max" }]',
            ["ulog:a%3Fb 100%25.ulg?speed=max"],
        ),
        (
            '[{ kind = "mavlink", link = "udpin::1", vehicles = { 1 = "a", 2 = "b" } }]',
            ["mavlink:udpin::1?vehicles=1:a,2:b"],
        ),
        (
            '[{ kind = "px4-zenoh", vehicles = { left = "a", right = "b" } }]',
            ["px4-zenoh:?vehicles=left:a,right:b"],
        ),
        (
            '[{ kind = "px4-zenoh", endpoint = "tcp/b:7447", domain = 5 }]',
            ["px4-zenoh:tcp/b:7447?domain=5"],
        ),
        (
            '[{ kind = "mavlink", link = "udpin::1", log = true, save = "/a+b c&d%20" }]',
            ["mavlink:udpin::1?log=1&save=/a+b%20c%26d%2520"],
        ),
        ('["sim:", { kind = "sim", vehicle = 2 }]', ["sim:", "sim:?vehicle=2"]),
    ],
)
def test_source_table_equals_source_text(tmp_path: Path, sources: str, texts: list[str]) -> None:
    """Both forms produce the same options, and may be mixed; status and metrics use the text."""
    (tmp_path / "nedbus.toml").write_text(f"source = {sources}")
    specs = [parse_source(source) for source in load_settings().source]
    assert [spec.text for spec in specs] == texts
    assert specs == [parse_source(text) for text in texts]


@pytest.mark.parametrize(
    "text", ["sim:", "ulog:a.ulg", "mcap:a.mcap", "px4-zenoh:", "mavlink:udpin::1"]
)
def test_source_without_options_has_the_defaults_of_the_model(text: str) -> None:
    """Options that are not given, which are not validated, are those that the model returns."""
    options = parse_source(text).options
    assert options == type(options).model_validate({})
    assert not options.model_fields_set


@pytest.mark.parametrize(
    ("source", "reason"),
    [
        ({}, "kind is missing; choose from sim, ulog"),
        ({"kind": "ulg"}, "unknown kind 'ulg'; choose from sim, ulog"),
        ({"kind": 5}, "unknown kind 5"),
        ({"kind": "ulog"}, 'it needs file = "..."'),
        ({"kind": "ulog", "file": 7}, 'it needs file = "..."'),
        ({"kind": "sim", "speed": 0}, "speed=0 is invalid; expected a factor from 0.001"),
        (
            {"kind": "mcap", "file": "a.mcap", "layout": "9.9"},
            "if not those in the file: 1.13, 1.14, ",
        ),
        (
            {"kind": "mavlink", "link": "udpin::14540", "vehicles": {"x": "a"}},
            "vehicles=x:a is invalid",
        ),
        (
            {"kind": "mavlink", "link": "udpin::14540", "log": "take"},
            "log=take is invalid; expected 1 to request the ULog stream",
        ),
        ("sim:?seed=1&seed=2", "an option occurs twice"),
        ("ulg:a/b.ulg", "unknown kind 'ulg'; write ulog:a/b.ulg"),
        ("mavlink:udpin::1?vehicles=256:a", "vehicles=256:a is invalid"),
        ("mavlink:udpin::1?vehicles=1:a,2:a", "vehicles=1:a,2:a is invalid"),
        ("mavlink:udpin::1?save=logs", "save=logs is invalid"),
        ("mavlink:udpin::1?log=0&save=logs", "save=logs is invalid"),
        ("px4-zenoh:?vehicles=a:b,/a:c", "vehicles=a:b,/a:c is invalid"),
    ],
)
def test_invalid_source_raises(source: str | dict[str, object], reason: str) -> None:
    with pytest.raises(ConfigError, match=re.escape(reason)):
        parse_source(source)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("mavlink:udpin::1?log=1&save=/logs/a+b", "/logs/a+b"),
        ("mavlink:udpin::1?log=1&save=/logs/a%2Bb%20c", "/logs/a+b c"),
        ("px4-zenoh:?msg=/logs/a+b.msg", "/logs/a+b.msg"),
        ("ulog:/logs/a+b.ulg?speed=2", "/logs/a+b.ulg"),
        ("ulog:/logs/a%20b%2B.ulg", "/logs/a%20b%2B.ulg"),
    ],
)
def test_plus_in_source_text_is_literal(text: str, value: str) -> None:
    """A plus is not a space; %XX is decoded in options, and in a path only %3F and %25 are."""
    spec = parse_source(text)
    assert value in (spec.target, *spec.options.model_dump().values())


def test_pipe_is_no_file(tmp_path: Path) -> None:
    """A pipe raises when it is opened: it may block forever, and cannot be read twice."""
    os.mkfifo(tmp_path / "flight.ulg")
    spec = parse_source(f"ulog:{tmp_path}/flight.ulg")
    with pytest.raises(ConfigError, match="is not a regular file"):
        spec.open_source(vehicle="1")


@pytest.mark.parametrize(("log", "has_all"), [("1", True), ("armed", True), ("0", False)])
def test_ulog_stream_delivers_all_topics(log: str, has_all: bool) -> None:
    """With `log=`, all topics of the ULog stream are delivered by default, otherwise the built-in ones."""
    options = parse_source(f"mavlink:udpin::1?log={log}").options
    assert (options.chosen_topics is None) is has_all
    chosen = parse_source(f"mavlink:udpin::1?log={log}&topics=sensor_gps").options.chosen_topics
    assert chosen is not None
    assert [*chosen] == ["sensor_gps"]
