"""Settings: nedbus.toml below the environment below flags; every mistake names its place."""

from __future__ import annotations

from pathlib import Path

import pytest

import nedbus
from nedbus import Tls
from nedbus.errors import ConfigError, ConnectError
from nedbus.settings import load_settings
from nedbus.transport import make_authority, make_certificate
from nedbus.transport.endpoints import explain_endpoints
from tests.conftest import wait_for


def test_defaults() -> None:
    """Without any setting a client joins loopback."""
    settings = load_settings()
    assert settings.routers == ("tcp/127.0.0.1:7447",)
    assert (settings.prefix, settings.vehicle, settings.source, settings.until_done) == ("nedbus", "1", (), False)


def test_order_is_file_environment_flag(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each beats the one before it; None is no flag."""
    file = tmp_path / "other.toml"
    file.write_text('connect = "tcp/file:1"\nprefix = "file"\nvehicle = 5\n')
    assert load_settings(file).connect == ("tcp/file:1",)
    monkeypatch.setenv("NEDBUS_CONNECT", "tcp/env:1, tcp/env:2")
    monkeypatch.setenv("NEDBUS_PREFIX", "env")
    settings = load_settings(file, prefix="flag", connect=None)
    assert (settings.connect, settings.prefix, settings.vehicle) == (("tcp/env:1", "tcp/env:2"), "flag", "5")


def test_file_is_the_named_one_or_the_one_beside(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """--config, else NEDBUS_CONFIG, else ./nedbus.toml."""
    for name in ("a", "b", "nedbus"):
        (tmp_path / f"{name}.toml").write_text(f'prefix = "{name}"\n')
    assert load_settings().prefix == "nedbus"
    monkeypatch.setenv("NEDBUS_CONFIG", str(tmp_path / "a.toml"))
    assert load_settings().prefix == "a"
    assert load_settings(tmp_path / "b.toml").prefix == "b"


@pytest.mark.parametrize(
    ("text", "place", "reason"),
    [
        ('connect = ["tcp/a:1"', "line 1, column 21", "Unclosed array"),
        ("vehicle = 1\nx y", "line 2, column 3", "Expected '=' after a key"),
        ("vehicle = 1\n\n  conect = 3", "line 3, column 3", "there is no setting 'conect': choose from connect,"),
        ('listen = ["7447"]', "line 1, column 1", "'7447' is not an endpoint: write PROTOCOL/HOST:PORT"),
        ('prefix = "a//b"', "line 1, column 1", "prefix 'a//b' is not valid"),
        ('vehicle = "a b"', "line 1, column 1", "vehicle 'a b' is not valid"),
        ('until_done = "maybe"', "line 1, column 1", "until_done: "),
        ("[source]\na = 1", "line 1, column 2", "source: "),
    ],
)
def test_mistake_in_the_file_is_found(tmp_path: Path, text: str, place: str, reason: str) -> None:
    """File, line, column, and what to write instead."""
    file = tmp_path / "nedbus.toml"
    file.write_text(text)
    with pytest.raises(ConfigError) as info:
        load_settings()
    assert str(info.value).startswith(f"nedbus.toml, {place}: ")
    assert reason in info.value.reason


def test_mistake_in_the_environment_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """The variable is the place."""
    monkeypatch.setenv("NEDBUS_LISTEN", "here")
    with pytest.raises(ConfigError, match=r"^NEDBUS_LISTEN: 'here' is not an endpoint"):
        load_settings()


def test_missing_file_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A file that was asked for must be there."""
    with pytest.raises(ConfigError, match=r"no\.toml: there is no such file"):
        load_settings(tmp_path / "no.toml")
    monkeypatch.setenv("NEDBUS_CONFIG", "gone.toml")
    with pytest.raises(ConfigError, match=r"gone\.toml: there is no such file"):
        load_settings()


def test_file_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    """A file that another user owns, or that is no file, is no "cannot write"."""
    folder = tmp_path / "folder.toml"
    folder.mkdir()
    with pytest.raises(ConfigError, match=r"folder\.toml: there is no such file"):
        load_settings(folder)
    broken = tmp_path / "nedbus.toml"
    broken.symlink_to("/proc/self/mem")
    with pytest.raises(ConfigError, match=r"nedbus\.toml: cannot be read: "):
        load_settings()


def test_mark_of_windows_editors_is_read_over(tmp_path: Path) -> None:
    """A BOM before the first line is no mistake, and lines and columns are counted without it."""
    file = tmp_path / "nedbus.toml"
    file.write_bytes(b'\xef\xbb\xbfprefix = "own"\n')
    assert load_settings().prefix == "own"
    file.write_bytes(b"\xef\xbb\xbfconect = 3\n")
    with pytest.raises(ConfigError, match=r"^nedbus\.toml, line 1, column 1: there is no setting 'conect'"):
        load_settings()
    file.write_text('prefix = "own"\n', encoding="utf-16")
    with pytest.raises(ConfigError, match="not text in UTF-8"):
        load_settings()


def test_misspelt_variable_is_reported(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    """A variable that is nearly a setting is warned of; those of the compose files are not."""
    for name in ("NEDBUS_CONECT", "NEDBUS_SOURCES", "NEDBUS_PUBLISH", "NEDBUS_ROUTER_IMAGE", "NEDBUS_PKI"):
        monkeypatch.setenv(name, "x")
    load_settings()
    assert [record.getMessage() for record in caplog.records] == [
        "NEDBUS_CONECT is not a setting: did you mean NEDBUS_CONNECT?",
        "NEDBUS_SOURCES is not a setting: did you mean NEDBUS_SOURCE?",
    ]


@pytest.mark.parametrize(
    ("name", "meant"),
    [
        ("NEDBUS_TLS_CERT", "NEDBUS_TLS_CERTIFICATE"),
        ("NEDBUS_TLS_K", "NEDBUS_TLS_KEY"),
        ("NEDBUS_TLS", "NEDBUS_TLS_CA or NEDBUS_TLS_CERTIFICATE or NEDBUS_TLS_KEY"),
    ],
)
def test_beginning_of_a_variable_is_completed(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, name: str, meant: str
) -> None:
    """What begins as a setting is more like it than one that differs in fewer letters."""
    monkeypatch.setenv(name, "x")
    load_settings()
    assert [record.getMessage() for record in caplog.records] == [f"{name} is not a setting: did you mean {meant}?"]


@pytest.mark.parametrize(
    ("text", "sources"),
    [
        ("sim:", ["sim:"]),
        ("sim:, ulog:/a.ulg?speed=2,px4-zenoh:", ["sim:", "ulog:/a.ulg?speed=2", "px4-zenoh:"]),
        (
            "mavlink:udpin:0.0.0.0:14540?vehicles=1:wing,2:tail",
            ["mavlink:udpin:0.0.0.0:14540?vehicles=1:wing,2:tail"],
        ),
        ("px4-zenoh:?vehicles=5:a,6:b,sim:?vehicle=c", ["px4-zenoh:?vehicles=5:a,6:b", "sim:?vehicle=c"]),
        ("px4-zenoh:?vehicles=left:a,right:b; sim:", ["px4-zenoh:?vehicles=left:a,right:b", "sim:"]),
        ("px4-zenoh:?vehicles=left:a,right:b;", ["px4-zenoh:?vehicles=left:a,right:b"]),
        ("sim:\nsim:?vehicle=2\n", ["sim:", "sim:?vehicle=2"]),
    ],
)
def test_sources_in_the_environment(monkeypatch: pytest.MonkeyPatch, text: str, sources: list[str]) -> None:
    """Commas inside options are theirs; semicolons or lines separate sources whatever their options contain."""
    monkeypatch.setenv("NEDBUS_SOURCE", text)
    assert load_settings().source == tuple(sources)


def test_port_that_cannot_be_is_reported() -> None:
    """A port is 0 to 65535."""
    with pytest.raises(ConfigError, match=r"connect: 'tcp/localhost:99999' has port 99999: ports are 0 to 65535"):
        load_settings(connect=("tcp/localhost:99999",))


def test_name_without_an_address_is_reported() -> None:
    """The reason is found on this host, and no other is guessed."""
    with pytest.raises(ConnectError, match=r"this host finds no address of no-such-host\.invalid"):
        nedbus.connect("tcp/no-such-host.invalid:7447", timeout=0.1)
    assert explain_endpoints(["tcp/no-such-host.invalid:1", "tcp/127.0.0.1:1"]) is None
    assert explain_endpoints(["tcp/[::1]:1"]) is None


@pytest.fixture
def keys(tmp_path: Path) -> Path:
    """Make an authority, and the certificates of two clients."""
    make_authority(tmp_path)
    for name in ("wing", "tail"):
        make_certificate(tmp_path, name)
    return tmp_path


@pytest.mark.parametrize(
    ("ca", "certificate", "key", "reason"),
    [
        ("wing.key", "wing.crt", "wing.key", "wing.key holds a private key, where a certificate is needed: are two"),
        ("ca.crt", "wing.key", "wing.crt", "wing.key holds a private key, where a certificate is needed: are two"),
        ("ca.crt", "wing.crt", "ca.crt", "ca.crt holds a certificate, where a private key is needed: are two"),
        ("ca.crt", "wing.crt", "tail.key", "tail.key is not the key of "),
        ("ca.crt", "empty", "wing.key", "empty holds nothing, where a certificate is needed: 'nedbus pki' makes"),
        ("text", "wing.crt", "wing.key", "text holds no PEM, where a certificate is needed"),
        ("ca.crt", "cut", "wing.key", "is damaged, or the key has a password"),
        ("gone", "wing.crt", "wing.key", "gone cannot be read"),
        ("ca.crt", ".", "wing.key", "cannot be read"),
    ],
)
def test_mistaken_certificate_is_found_locally(keys: Path, ca: str, certificate: str, key: str, reason: str) -> None:
    """Files that are swapped, empty, damaged, or do not belong together, need no router to be found."""
    (keys / "empty").touch()
    (keys / "text").write_text("hello\n")
    (keys / "cut").write_text((keys / "wing.crt").read_text()[:200])
    with pytest.raises(ConfigError) as info:
        nedbus.connect("tls/127.0.0.1:1", timeout=0.1, tls=Tls(keys / ca, keys / certificate, keys / key))
    assert reason in str(info.value)


def test_certificate_that_is_refused_is_explained(keys: Path, tmp_path: Path) -> None:
    """What depends on the clock or on the peer is said when nothing answers: expired, or of another authority."""
    other = tmp_path / "other"
    make_authority(other)
    tls = Tls(keys / "ca.crt", keys / "wing.crt", keys / "wing.key")
    assert tls.explain() is None
    assert Tls(keys / "ca.crt").explain() is None
    assert "not the certificate of an authority" in str(Tls(keys / "wing.crt").explain())
    make_certificate(keys, "old", days=0)
    old = Tls(keys / "ca.crt", keys / "old.crt", keys / "old.key")
    wait_for(lambda: "old.crt or its authority has expired" in str(old.explain()), what="its end")
    foreign = Tls(other / "ca.crt", keys / "wing.crt", keys / "wing.key")
    assert "wing.crt is not signed by the authority in tls_ca" in str(foreign.explain())
    with pytest.raises(ConnectError, match=r"wing\.crt is not signed by the authority"):
        nedbus.connect("tls/127.0.0.1:1", timeout=0.1, tls=foreign)
