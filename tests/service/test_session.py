"""Sessions: what a router refuses to start with, and how it says so."""

from __future__ import annotations

from pathlib import Path

import pytest

import nedbus
from nedbus.errors import ConfigError, ListenError
from nedbus.sources import SOURCE_KINDS
from nedbus.transport import open_client, open_router
from tests.conftest import Start, free_endpoint, wait_for


@pytest.mark.parametrize(
    ("text", "place", "reason"),
    [
        ('{\n  mode: "router",\n  acess_control: {}\n}', "line 3, column 3", "unknown field 'acess_control'"),
        ('{\n  mode: "routr",\n}', "line 2, column 9", "unknown variant 'routr', expected one of 'router'"),
        ('{\n  mode: "router"\n listen: 5}', "line 2, column 9", "expected"),
        ('{\n  listen: {endpoints: ["foo"]}}', "line 2, column 23", "Endpoints must be of the form"),
        ("{ transport: {link: {tls: {bad: 3}}}}", "line 1, column 28", "unknown field 'bad'"),
    ],
)
def test_mistake_in_a_router_file_is_found(tmp_path: Path, text: str, place: str, reason: str) -> None:
    """File, line and column, without paths of another program's sources."""
    file = tmp_path / "router.json5"
    file.write_text(text)
    with pytest.raises(ConfigError) as info:
        open_router(config_file=file)
    assert str(info.value).startswith(f"{file}, {place}: {reason}")
    assert "/root/" not in str(info.value)
    assert ".rs" not in str(info.value)


def test_router_file_must_be_one(tmp_path: Path) -> None:
    """A missing file and a foreign ending are named."""
    with pytest.raises(ConfigError, match="there is no such file"):
        open_router(config_file=tmp_path / "no.json5")
    with pytest.raises(ConfigError, match=r"is a \.json5, \.json, \.yaml or \.yml file"):
        open_router(config_file=tmp_path / "router.conf")


def test_plugins_of_a_router_file_are_not_loaded(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Zenoh's Python library ignores them without a word: each is named, and one that is required is an error."""
    file = tmp_path / "router.json5"
    file.write_text('{ mode: "router", plugins: { rest: { http_port: 8000 }, storage_manager: {} } }')
    open_router(listen=(free_endpoint(),), config_file=file).close()
    ignored = "without plugin rest and plugin storage_manager: this router loads no plugins, as zenohd does"
    assert caplog.messages == [f"{file}: {ignored}"]
    file.write_text("{ plugins: { rest: { __required__: true } } }")
    with pytest.raises(ConfigError, match="it requires plugin rest, and this router loads no plugins: start it with"):
        open_router(config_file=file)


@pytest.mark.parametrize("name", ["storage.json5", "rest-reader.json5"])
def test_file_for_zenohd_alone_is_refused(name: str) -> None:
    """`nedbus router` does not run as if these did something."""
    with pytest.raises(ConfigError, match="this router loads no plugins"):
        open_router(config_file=Path(__file__).parents[2] / "config" / name)


def test_help_names_every_source(run_nedbus: Start) -> None:
    """`nedbus serve --help` derives from the table of sources: none is forgotten."""
    help_ = run_nedbus("serve", "--help", COLUMNS="300")
    assert help_.wait() == 0
    assert all(f" {name}:{kind.target or ''}" in help_.out for name, kind in SOURCE_KINDS.items())


def test_router_command_names_ignored_plugins(run_nedbus: Start, tmp_path: Path) -> None:
    """Who starts `nedbus router FILE` reads it."""
    file = tmp_path / "router.json5"
    file.write_text("{ plugins: { rest: { http_port: 8000 } } }")
    router = run_nedbus("router", str(file), "--listen", free_endpoint())
    wait_for(lambda: "router on" in router.err, what="the router")
    assert "without plugin rest: this router loads no plugins" in router.err


def test_taken_port_names_the_reason(endpoint: str) -> None:
    """ListenError is an OSError, with what the system said."""
    with pytest.raises(ListenError, match=rf"cannot listen on {endpoint} \(address already in use\)") as info:
        open_router(listen=(endpoint,))
    assert isinstance(info.value, OSError)


def test_foreign_address_names_the_reason() -> None:
    """An address of another host cannot be listened on."""
    with pytest.raises(ListenError, match="cannot assign requested address"):
        open_router(listen=("tcp/192.0.2.1:7447",))


@pytest.mark.parametrize("endpoint", ["7447", "localhost:7447", "foo/localhost:7447", "tcp/", ""])
def test_malformed_endpoint_is_refused(endpoint: str) -> None:
    """Zenoh's own form of an endpoint is told."""
    with pytest.raises(ConfigError, match=r"write PROTOCOL/HOST:PORT, as in tcp/127\.0\.0\.1:7447"):
        open_client((endpoint,), timeout=0)
    with pytest.raises(ConfigError, match="is not an endpoint"):
        open_router(listen=(endpoint,))


def test_two_routers_are_one_network(endpoint: str) -> None:
    """A router that joins another carries its vehicles."""
    beyond = free_endpoint()
    session = open_router(listen=(beyond,), connect=(endpoint,))
    with nedbus.connect(endpoint) as near, nedbus.connect(beyond) as far:
        near.publisher("vehicle_local_position", vehicle="7").publish({"timestamp": 1})
        wait_for(lambda: [sample.vehicle for sample in far.latest("*")] == ["7"], what="the vehicle behind the router")
    session.close()
