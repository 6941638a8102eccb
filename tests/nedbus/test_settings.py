"""Settings from nedbus.toml, the environment and flags; errors name file, line and column, even in router files."""

from __future__ import annotations

import asyncio
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

import nedbus
from nedbus import Tls
from nedbus.endpoints import is_loopback, resolution_error
from nedbus.errors import ConfigError, ConnectError, ListenError
from nedbus.pki import make_authority, make_certificate
from nedbus.settings import Settings, load_client_settings, load_settings, locate_source
from nedbus.sources import SOURCE_KINDS
from nedbus.transport import open_client, open_router
from tests.peers.command_line import run_command
from tests.peers.ports import free_endpoint
from tests.waits import wait_for


def test_flag_overrides_environment_overrides_file(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A flag overrides an environment variable, which overrides the file; a flag of None is ignored.

    Without any setting a client connects to loopback. The error for an invalid variable names the variable.
    """
    settings = load_settings()
    assert settings.routers == ("tcp/127.0.0.1:7447",)
    assert (settings.prefix, settings.vehicle, settings.source, settings.until_done) == (
        "nedbus",
        "1",
        (),
        False,
    )
    file = tmp_path / "other.toml"
    file.write_text('connect = "tcp/file:1"\nprefix = "file"\nvehicle = 5\n')
    assert load_settings(file).connect == ("tcp/file:1",)
    monkeypatch.setenv("NEDBUS_CONNECT", "tcp/env:1, tcp/env:2")
    monkeypatch.setenv("NEDBUS_PREFIX", "env")
    settings = load_settings(file, prefix="flag", connect=None)
    assert (settings.connect, settings.prefix, settings.vehicle) == (
        ("tcp/env:1", "tcp/env:2"),
        "flag",
        "5",
    )
    monkeypatch.setenv("NEDBUS_LISTEN", "here")
    with pytest.raises(ConfigError, match=r"^NEDBUS_LISTEN: 'here' is not an endpoint"):
        load_settings()


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"connect": "tcp/one:1, tls/two:2"},
        {"connect": ["tcp/one:1", "tcp/two:2"], "prefix": "fleet/a"},
        {"connect": "", "prefix": "nedbus"},
        {"source": ["sim:"], "listen": ["tcp/127.0.0.1:7447"]},
        {"source": "sim:?seed=1, ulog:a,b.ulg", "listen": "tcp/one:1,tcp/two:2"},
        {"source": [{"kind": "sim", "seed": 1}]},
        {"source": ""},
    ],
)
def test_usual_settings_equal_those_of_the_model(values: dict[str, Any]) -> None:
    """Settings of a usual client or service, which are checked without Pydantic, are those that the model returns."""
    settings = load_settings(**values)
    model = Settings(**values)
    assert settings.model_dump() == model.model_dump()
    assert settings.model_fields_set == model.model_fields_set
    assert settings.left_out == model.left_out
    assert [settings.set_by(name) for name in values] == [*values]


@pytest.mark.parametrize(
    ("values", "reason"),
    [
        ({"connect": "one"}, "'one' is not an endpoint"),
        ({"connect": ["tcp/one:1", 2]}, "Input should be a valid string"),
        ({"connect": 1}, "Input should be a valid tuple"),
        ({"prefix": "a//b"}, "chunks of A-Z"),
        ({"prefix": 1}, "Input should be a valid string"),
        ({"listen": ["tcp/one:1", "two"]}, "'two' is not an endpoint"),
        ({"listen": 1}, "Input should be a valid tuple"),
        ({"source": 1}, "Input should be a valid tuple"),
        ({"source": [1]}, "Input should be a valid string"),
    ],
)
def test_invalid_settings_name_the_reason(values: dict[str, object], reason: str) -> None:
    """An invalid endpoint, prefix or source raises ConfigError with its name and the reason."""
    with pytest.raises(ConfigError, match=reason) as caught:
        load_settings(**values)
    assert caught.value.where in values


@pytest.mark.parametrize("is_async", [False, True])
def test_connect_with_endpoint_ignores_unrelated_settings(
    tmp_path: Path, endpoint: str, *, is_async: bool
) -> None:
    """With an endpoint, `connect` reads only `prefix` and, for tls/, the TLS files from ./nedbus.toml."""

    async def connect_async(where: str | None, prefix: str | None) -> str:
        async with nedbus.connect_async(where, prefix=prefix) as bus:
            return bus.prefix

    def connect(where: str | None = endpoint, prefix: str | None = None) -> str:
        if is_async:
            return asyncio.run(connect_async(where, prefix))
        with nedbus.connect(where, prefix=prefix) as bus:
            return bus.prefix

    file = tmp_path / "nedbus.toml"
    file.write_text('prefix = "fleet"\nlisten = "nowhere"\nconect = 1\ntls_ca = 7\n')
    assert connect() == "fleet"
    for where, prefix in ((None, None), ("tls/127.0.0.1:1", "fleet")):
        with pytest.raises(ConfigError, match=r"nedbus\.toml"):
            connect(where, prefix)
    file.write_text("prefix = 7\n")
    with pytest.raises(ConfigError, match="prefix"):
        connect()
    file.write_text("not TOML")
    assert connect(prefix="other") == "other"


def test_settings_file_is_found_by_flag_variable_or_default(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The settings file is --config, otherwise NEDBUS_CONFIG, otherwise ./nedbus.toml."""
    for name in ("a", "b", "nedbus"):
        (tmp_path / f"{name}.toml").write_text(f'prefix = "{name}"\n')
    assert load_settings().prefix == "nedbus"
    monkeypatch.setenv("NEDBUS_CONFIG", str(tmp_path / "a.toml"))
    assert load_settings().prefix == "a"
    assert load_settings(tmp_path / "b.toml").prefix == "b"


@pytest.mark.parametrize(
    ("text", "position", "reason"),
    [
        (
            "vehicle = 1\n\n  conect = 3",
            "line 3, column 3",
            "unknown setting 'conect': choose from connect,",
        ),
        ('until_done = "maybe"', "line 1, column 1", "until_done: "),
        ("[source]\na = 1", "line 1, column 2", "source: "),
        (
            '{\n  mode: "router",\n  acess_control: {}\n}',
            "line 3, column 3",
            "unknown field 'acess_control'",
        ),
        (
            '{\n  mode: "routr",\n}',
            "line 2, column 9",
            "unknown variant 'routr', expected one of 'router'",
        ),
        ('{\n  mode: "router"\n listen: 5}', "line 2, column 9", "expected"),
        (
            '{\n  listen: {endpoints: ["foo"]}}',
            "line 2, column 23",
            "Endpoints must be of the form",
        ),
        ("{ transport: {link: {tls: {bad: 3}}}}", "line 1, column 28", "unknown field 'bad'"),
    ],
)
def test_error_in_a_file_has_line_and_column(
    tmp_path: Path, text: str, position: str, reason: str
) -> None:
    """The error states file, line, column and remedy; for a router file it omits Zenoh's source paths."""
    file = tmp_path / ("router.json5" if text.startswith("{") else "nedbus.toml")
    file.write_text(text)
    with pytest.raises(ConfigError) as info:
        load_settings(file) if file.suffix == ".toml" else open_router(config_file=file)
    assert re.match(rf"{re.escape(str(file))}, {position}: {reason}", str(info.value))
    assert not re.search(r"/root/|\.rs", str(info.value))


@pytest.mark.parametrize(
    ("text", "error"),
    [
        ('connect = ["tcp/a:1"', r"Unclosed array \(at .*\)"),
        (
            "vehicle = 1\nx y",
            r"Expected '=' after a key in a key/value pair \(at line 2, column 3\)",
        ),
        ("[[source", r"Expected .* \(at .*\)"),
    ],
)
def test_syntax_error_has_file_and_position(tmp_path: Path, text: str, error: str) -> None:
    """The error for a file that is no TOML states the file, and the position that Python's parser reports."""
    file = tmp_path / "nedbus.toml"
    file.write_text(text)
    with pytest.raises(ConfigError, match=rf"^{re.escape(str(file))}: {error}$"):
        load_settings(file)


TABLES = """# source = "sim:?b=1"
[[source]]
kind = "sim"
rate = 2

[[ source ]]
kind = "sim"
rat = 1

[[source]]
kind = "sim"
rate = "fast"
"""


@pytest.mark.parametrize(
    ("text", "index", "option", "position"),
    [
        (TABLES, 1, "rat", ", line 8, column 1"),
        (TABLES, 0, "rat", ", line 2, column 3"),  # an option of another table
        (TABLES, 2, "rate", ", line 12, column 1"),
        (TABLES, 2, "", ", line 10, column 3"),
        ('prefix = "sim:x"\nsource = ["sim:a", "sim:"]', 1, "", ", line 2, column 21"),
        ("source = 'sim:'", 0, "rate", ", line 1, column 11"),
        ('source = [\n  {kind = "sim"},\n  {kind = "ulog"},\n]', 1, "kind", ", line 1, column 1"),
        (r'source = ["sim\u003a"]', 0, "", ", line 1, column 1"),
        ('source."kind" = "sim"', 0, "", ", line 1, column 1"),
    ],
)
def test_error_of_a_source_has_its_line(
    tmp_path: Path, text: str, index: int, option: str, position: str
) -> None:
    """The error of a source names the line of its string, table or option; that of `source` for other spellings."""
    file = tmp_path / "nedbus.toml"
    file.write_text(text)
    sources = tomllib.loads(text)["source"]
    given = sources if isinstance(sources, list) else [sources]
    settings = Settings(source=given)
    settings._file = file
    settings._set_by["source"] = str(file)
    error = locate_source(settings, index, ConfigError("source", "wrong", key=option))
    assert str(error) == f"{file}{position}: source: wrong"


def test_missing_or_unreadable_settings_file_raises(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A missing file, a folder and an unreadable file raise ConfigError with the reason."""
    (tmp_path / "folder.toml").mkdir()
    for name in ("no.toml", "folder.toml"):
        with pytest.raises(ConfigError, match=rf"{name}: there is no such file"):
            load_settings(tmp_path / name)
    (tmp_path / "nedbus.toml").symlink_to("/proc/self/mem")
    with pytest.raises(ConfigError, match=r"nedbus\.toml: cannot be read \("):
        load_settings()
    monkeypatch.setenv("NEDBUS_CONFIG", "gone.toml")
    with pytest.raises(ConfigError, match=r"gone\.toml: there is no such file"):
        load_settings()


def test_byte_order_mark_is_ignored(tmp_path: Path) -> None:
    """A UTF-8 byte order mark is accepted and not counted in columns; other encodings raise."""
    file = tmp_path / "nedbus.toml"
    file.write_bytes(b'\xef\xbb\xbfprefix = "own"\n')
    assert load_settings().prefix == "own"
    file.write_bytes(b"\xef\xbb\xbfconect = 3\n")
    with pytest.raises(
        ConfigError, match=r"^nedbus\.toml, line 1, column 1: unknown setting 'conect'"
    ):
        load_settings()
    file.write_text('prefix = "own"\n', encoding="utf-16")
    with pytest.raises(ConfigError, match="not UTF-8 text"):
        load_settings()


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("NEDBUS_CONECT", "NEDBUS_CONNECT"),
        ("NEDBUS_SOURCES", "NEDBUS_SOURCE"),
        # A truncated name takes precedence over a similar name.
        ("NEDBUS_TLS_CERT", "NEDBUS_TLS_CERTIFICATE"),
        ("NEDBUS_TLS_K", "NEDBUS_TLS_KEY"),
        ("NEDBUS_TLS", "NEDBUS_TLS_CA or NEDBUS_TLS_CERTIFICATE or NEDBUS_TLS_KEY"),
        # variables of the compose files
        *((f"NEDBUS_{name}", None) for name in ("PUBLISH", "ROUTER_IMAGE", "PKI")),
    ],
)
def test_misspelled_variable_is_reported(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, name: str, meant: str | None
) -> None:
    """A NEDBUS_ variable similar to a setting, or a truncated setting, causes a warning; other variables do not."""
    monkeypatch.setenv(name, "x")
    load_settings()
    assert caplog.messages == [f"ignored variable {name}: did you mean {meant}?"] * (
        meant is not None
    )


@pytest.mark.parametrize(
    ("text", "sources"),
    [
        ("sim:", ["sim:"]),
        ("sim:, ulog:/a.ulg?speed=2,px4-zenoh:", ["sim:", "ulog:/a.ulg?speed=2", "px4-zenoh:"]),
        (
            "mavlink:udpin:0.0.0.0:14540?vehicles=1:wing,2:tail",
            ["mavlink:udpin:0.0.0.0:14540?vehicles=1:wing,2:tail"],
        ),
        (
            "px4-zenoh:?vehicles=5:a,6:b,sim:?vehicle=c",
            ["px4-zenoh:?vehicles=5:a,6:b", "sim:?vehicle=c"],
        ),
        (
            "px4-zenoh:?vehicles=left:a,right:b; sim:",
            ["px4-zenoh:?vehicles=left:a,right:b", "sim:"],
        ),
        ("px4-zenoh:?vehicles=left:a,right:b;", ["px4-zenoh:?vehicles=left:a,right:b"]),
        (
            "px4-zenoh:?vehicles=left:a,right:b\nsim:\n",
            ["px4-zenoh:?vehicles=left:a,right:b", "sim:"],
        ),
    ],
)
def test_sources_variable_is_split(
    monkeypatch: pytest.MonkeyPatch, text: str, sources: list[str]
) -> None:
    """A comma separates sources only before `KIND:`; semicolons and line breaks always separate sources."""
    monkeypatch.setenv("NEDBUS_SOURCE", text)
    assert load_settings().source == tuple(sources)


def test_unresolvable_host_name_is_reported() -> None:
    """ConnectError reports a host name that cannot be resolved, but only if all endpoints fail to resolve."""
    with pytest.raises(ConnectError, match=r"cannot resolve no-such-host\.invalid"):
        nedbus.connect("tcp/no-such-host.invalid:7447", timeout=0.1)
    assert resolution_error(["tcp/no-such-host.invalid:1", "tcp/127.0.0.1:1"]) is None
    assert resolution_error(["tcp/[::1]:1"]) is None


@pytest.fixture(scope="module")
def keys(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Create a CA, two valid and one expired client certificate, and files without a valid certificate."""
    folder = tmp_path_factory.mktemp("keys")
    make_authority(folder)
    for name, days in (("wing", 100), ("tail", 100), ("old", 0)):
        make_certificate(folder, name, days=days)
    (folder / "empty").touch()
    (folder / "text").write_text("hello\n")
    (folder / "cut").write_text((folder / "wing.crt").read_text()[:200])
    return folder


@pytest.mark.parametrize(
    ("ca", "certificate", "key", "reason"),
    [
        (
            "wing.key",
            "wing.crt",
            "wing.key",
            "wing.key contains a private key, but a certificate is required: check",
        ),
        (
            "ca.crt",
            "wing.key",
            "wing.crt",
            "wing.key contains a private key, but a certificate is required: check",
        ),
        (
            "ca.crt",
            "wing.crt",
            "ca.crt",
            "ca.crt contains a certificate, but a private key is required: check",
        ),
        ("ca.crt", "wing.crt", "tail.key", "tail.key is not the key of "),
        (
            "ca.crt",
            "empty",
            "wing.key",
            "empty is empty, but a certificate is required: create one with 'nedbus pki'",
        ),
        ("text", "wing.crt", "wing.key", "text is not PEM, but a certificate is required"),
        ("ca.crt", "cut", "wing.key", "is damaged, or the key has a password"),
        ("gone", "wing.crt", "wing.key", "gone cannot be read"),
        ("ca.crt", ".", "wing.key", "cannot be read"),
    ],
)
def test_invalid_tls_file_raises_without_a_router(
    keys: Path, ca: str, certificate: str, key: str, reason: str
) -> None:
    """Swapped, empty, damaged or mismatched TLS files raise ConfigError, even without a router."""
    with pytest.raises(ConfigError) as info:
        nedbus.connect(
            "tls/127.0.0.1:1", timeout=0.1, tls=Tls(keys / ca, keys / certificate, keys / key)
        )
    assert reason in str(info.value)


def test_expired_or_foreign_certificate_is_explained(keys: Path, tmp_path: Path) -> None:
    """If no router answers, the error names a certificate that is expired or signed by another CA."""
    other = tmp_path / "other"
    make_authority(other)
    tls = Tls(keys / "ca.crt", keys / "wing.crt", keys / "wing.key")
    assert tls.explain() is None
    assert Tls(keys / "ca.crt").explain() is None
    assert "not a CA certificate" in str(Tls(keys / "wing.crt").explain())
    old = Tls(keys / "ca.crt", keys / "old.crt", keys / "old.key")
    wait_for(lambda: "old.crt or its CA has expired" in str(old.explain()), what="expiry")
    foreign = Tls(other / "ca.crt", keys / "wing.crt", keys / "wing.key")
    assert "wing.crt is not signed by the CA in tls_ca" in str(foreign.explain())
    with pytest.raises(ConnectError, match=r"wing\.crt is not signed by the CA"):
        nedbus.connect("tls/127.0.0.1:1", timeout=0.1, tls=foreign)


# Router files and endpoints


def test_missing_router_file_or_unknown_suffix_raises(tmp_path: Path) -> None:
    """A missing file and an unknown file suffix raise ConfigError."""
    for name, reason in (
        ("no.json5", "there is no such file"),
        ("router.conf", r"expected a \.json5, \.json, \.yaml or \.yml"),
    ):
        with pytest.raises(ConfigError, match=reason):
            open_router(config_file=tmp_path / name)


def test_plugins_of_a_router_file_are_not_loaded(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Ignored plugins are logged, because Zenoh's Python library ignores them silently; a required plugin raises."""
    file = tmp_path / "router.json5"
    file.write_text(
        '{ mode: "router", plugins: { rest: { http_port: 8000 }, storage_manager: {} } }'
    )
    open_router(listen=(free_endpoint(),), config_file=file).close()
    ignored = "plugin rest and plugin storage_manager not loaded, because this router, unlike zenohd, loads no plugins"
    assert caplog.messages == [f"{file}: {ignored}"]
    file.write_text("{ plugins: { rest: { __required__: true } } }")
    with pytest.raises(
        ConfigError, match="it requires plugin rest, but this router loads no plugins: run it with"
    ):
        open_router(config_file=file)
    for name in ("storage.json5", "rest-reader.json5"):  # as shipped, for zenohd alone
        with pytest.raises(ConfigError, match="this router loads no plugins"):
            open_router(config_file=Path(__file__).parents[2] / "config" / name)


@pytest.mark.slow
def test_serve_help_lists_every_source() -> None:
    """`nedbus serve --help` lists every kind of source."""
    help_ = run_command("serve", "--help", COLUMNS="300")
    assert help_.exit_code == 0
    assert all(f" {name}:{kind.target or ''}" in help_.out for name, kind in SOURCE_KINDS.items())


def test_listen_error_includes_the_system_error(endpoint: str) -> None:
    """ListenError is an OSError with the reason: the port is in use, or the address belongs to another host."""
    for where, reason in (
        (endpoint, "address already in use"),
        ("tcp/192.0.2.1:7447", "cannot assign requested"),
    ):
        with pytest.raises(ListenError, match=rf"cannot listen on {where} \({reason}") as info:
            open_router(listen=(where,))
        assert isinstance(info.value, OSError)


@pytest.mark.parametrize("endpoint", ["7447", "localhost:7447", "foo/localhost:7447", "tcp/", ""])
def test_malformed_endpoint_raises(endpoint: str) -> None:
    """The error for a malformed endpoint explains the syntax of Zenoh endpoints."""
    with pytest.raises(ConfigError, match=r"write PROTOCOL/HOST:PORT, as in tcp/127\.0\.0\.1:7447"):
        open_client((endpoint,), timeout=0)
    with pytest.raises(ConfigError, match="is not an endpoint"):
        open_router(listen=(endpoint,))


@pytest.mark.parametrize(
    ("index", "where"),
    [(0, ", line 1, column 1"), (5, ", line 2, column 2"), (-1, "")],
    ids=["first", "second", "none"],
)
def test_error_in_a_text_has_line_and_column(index: int, where: str) -> None:
    """`ConfigError.in_text` converts an index to line and column, both from 1; -1 names only the file."""
    error = ConfigError.in_text(Path("a.toml"), "wrong", "abc\ndef", index)
    assert str(error) == f"a.toml{where}: wrong"


@pytest.mark.parametrize(
    ("host", "expected"),
    [("127.0.0.1", True), ("127.0.0.2", True), ("::1", True), ("localhost", True), ("0.0.0.0", False),  # noqa: S104
     ("::", False), ("192.0.2.1", False), ("ground", False)],
)  # fmt: skip
def test_loopback_addresses_are_recognised(host: str, expected: bool) -> None:
    """All of 127.0.0.0/8, ::1 and localhost are reachable from this host only."""
    assert is_loopback(host) == expected


def test_misspelled_variable_is_not_reported_where_none_is_needed(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A client with endpoint and prefix needs no variable, so it warns of none; the doctor opens several of them."""
    monkeypatch.setenv("NEDBUS_CONECT", "tcp/127.0.0.1:1")
    load_client_settings(None, connect="tcp/127.0.0.1:7447", prefix="nedbus", tls=None)
    assert caplog.messages == []
    load_client_settings(None, connect="tcp/127.0.0.1:7447", prefix=None, tls=None)
    assert caplog.messages == ["ignored variable NEDBUS_CONECT: did you mean NEDBUS_CONNECT?"]
