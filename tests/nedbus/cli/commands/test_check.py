"""`nedbus check`: all mistakes in settings and router files at once, each with line and column."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from nedbus.doctor import check_router_file
from nedbus.pki import make_authority, make_certificate
from tests.flights.ulogs import write_log
from tests.peers.command_line import run_command
from tests.peers.ports import free_endpoint
from tests.peers.processes import Start

ROOT = Path(__file__).parents[4]


def check(*arguments: object, command: tuple[str, ...] = ("check",)) -> list[str]:
    """Run a check that must find mistakes, and return its lines on stderr."""
    checked = run_command(*command, *map(str, arguments))
    assert (checked.exit_code, checked.out) == (2, "")
    return [line.removeprefix("nedbus: ") for line in checked.err.splitlines()]


def passes(*arguments: object) -> bool:
    """Run a check, and return whether it finds no mistakes."""
    checked = run_command(*map(str, arguments))
    return (checked.exit_code, checked.out, checked.err) == (0, "no mistakes found\n", "")


def test_all_mistakes_are_reported_at_once(tmp_path: Path) -> None:
    """Settings and list items are all checked, even if some are invalid; only a source's first mistake is reported."""
    file, closed = tmp_path / "nedbus.toml", free_endpoint()
    file.write_text(
        'prefix = "a//b"\nconect = 1\nvehicle = "a b"\nhttp = "127.0.0.1:99999"\n'
        f'connect = ["here", "tcp/nowhere.invalid:1", "{closed}"]\n'
        'listen = ["tcp/127.0.0.1:99999", "tcp/192.0.2.1:1"]\nuntil_done = "maybe"\ntls_ca = "gone.crt"\n'
        'source = ["foo:", "mavlink:udpin:0.0.0.0:99999?sed=1&baud=0", "ulog:gone.ulg?sed=1"]\n'
    )
    expected = [
        (1, 1, "prefix 'a//b' is not valid"),
        (2, 1, "unknown setting 'conect'"),
        (3, 1, "vehicle 'a b' is not valid"),
        (4, 1, "'127.0.0.1:99999' is not an address"),
        (5, 1, "'here' is not an endpoint"),
        (5, 1, "tcp/nowhere.invalid:1: cannot resolve host name nowhere.invalid"),
        (
            5,
            1,
            f"{closed}: connection refused, probably because nothing listens on this port; start",
        ),
        (6, 1, "'tcp/127.0.0.1:99999' has port 99999"),
        (6, 1, "tcp/192.0.2.1:1: 192.0.2.1 is not an address of this host"),
        (7, 1, "until_done: "),
        (8, 1, "gone.crt cannot be read"),
        (9, 12, "source 'foo:': unknown kind 'foo'"),
        (9, 20, "source 'mavlink:udpin:0.0.0.0:99999?sed=1&baud=0': baud=0 is invalid"),
        (9, 64, "source 'ulog:gone.ulg?sed=1': unknown option 'sed'"),
    ]
    for command in (("check",), ("serve", "--check", "--config")):
        lines = check(file, command=command)
        for line, column, text in expected:
            start = f"{file}, line {line}, column {column}: {text}"
            assert any(each.startswith(start) for each in lines), (start, lines)
        assert len(lines) == len(expected)


def test_mistake_of_a_file_that_is_given_twice_is_reported_once(tmp_path: Path) -> None:
    """The same file under two arguments has the same mistakes."""
    file = tmp_path / "nedbus.toml"
    file.write_text("conect = 1\n")
    lines = check("--offline", file, file)
    assert lines[0].startswith(f"{file}, line 1, column 1: unknown setting 'conect'")
    assert lines == check("--offline", file)


def test_unreadable_file_does_not_hide_other_mistakes(tmp_path: Path) -> None:
    """If the file is unreadable, options and variables are still checked, but no setting is reported as missing."""
    broken = tmp_path / "broken.toml"
    broken.write_text("source = [\n")
    for file, reason in (
        (tmp_path / "gone.toml", "there is no such file"),
        (broken, "Invalid value"),
    ):
        flags = ("--listen", "tcp/192.0.2.1:1", "--tls-key", "gone.key")
        lines = check(file, *flags, command=("serve", "--check", "--config"))
        assert [reason in lines[0], len(lines)] == [True, 3], lines
        assert lines[1].startswith("tls_key: gone.key cannot be read")
        assert lines[2].startswith(
            "listen: tcp/192.0.2.1:1: 192.0.2.1 is not an address of this host"
        )


def test_two_sources_with_the_same_address_are_reported(tmp_path: Path) -> None:
    """If a replay, or a live source with a named vehicle, publishes an address of another source, this is reported."""
    file, log = (
        tmp_path / "nedbus.toml",
        write_log(tmp_path / "flight.ulg", range(0, 100_000, 10_000)),
    )
    named = "mavlink:udpin:127.0.0.1:1?vehicles=1:wing"
    file.write_text(
        f'source = ["sim:", "ulog:{log}?vehicle=7", "sim:?seed=2", "ulog:{log}?vehicle=7&speed=2", "sim:", "{named}",'
        f' "sim:?vehicle=wing", "sim:?vehicle=8", "px4-zenoh:"]\n'
    )
    reasons = [line.partition(": ")[2] for line in check(file)]
    advice = "set another vehicle for one of them"
    sims = [
        f"source 'sim:?seed=2': publishes 1/vehicle_local_position, as does source 'sim:': {advice}",
        f"source 'sim:': publishes 1/vehicle_local_position, as does source 'sim:': {advice}",
        f"source 'sim:?vehicle=wing': publishes wing/vehicle_local_position, as does source '{named}': {advice}",
    ]
    first = f"as does source 'ulog:{log}?vehicle=7': {advice}"
    logs = f"source 'ulog:{log}?vehicle=7&speed=2': publishes 7/vehicle_local_position, {first}"
    assert reasons == [sims[0], logs, *sims[1:]]
    assert [line.partition(": ")[2] for line in check("--offline", file)] == sims


def test_router_config_named_in_settings_is_checked(tmp_path: Path) -> None:
    """The file named by `router_config` is checked with the settings, except endpoints that the settings replace."""
    file, router = tmp_path / "nedbus.toml", tmp_path / "router.json5"
    router.write_text(
        '{ listen: { endpoints: ["tls/192.0.2.1:7447"] },\n transport: { link: { tls: {\n'
        '  listen_private_key: "/no/such.key", listen_certificate: "/no/such.crt" } } } }\n'
    )
    file.write_text(f'router_config = "{router}"\nsource = ["foo:"]\n')
    lines = check(file)
    places = [
        f"{router}, line {place}" for place in ("1, column 26", "3, column 24", "3, column 60")
    ]
    assert sorted(line.partition(": ")[0] for line in lines) == [
        f"{file}, line 2, column 12",
        *places,
    ]
    assert len(check("--offline", file)) == 1
    file.write_text(
        f'router_config = "{router}"\nsource = ["foo:"]\nlisten = "{free_endpoint()}"\n'
    )
    assert len(check(file)) == 3


def test_mistakes_in_source_tables_are_reported_with_line(tmp_path: Path) -> None:
    """An unknown option is reported at its line, and a missing log at its table unless --offline is given."""
    file = tmp_path / "nedbus.toml"
    file.write_text(
        '[[source]]\nkind = "sim"\nsed = 1\n\n[[source]]\nkind = "ulog"\nfile = "gone.ulg"\n'
    )
    wrong = f"{file}, line 3, column 1: source 'sim:?sed=1': unknown option 'sed'"
    lines = check(file)
    assert lines[0].startswith(wrong)
    reason = f"{Path.cwd()}/gone.ulg: no such file or directory"
    assert lines[1] == f"{file}, line 5, column 3: source 'ulog:gone.ulg': {reason}"
    [line] = check("--offline", file)
    assert line.startswith(wrong)


@pytest.mark.parametrize(
    ("endpoint", "reasons"),
    [
        ("tcp/a..b:7447", ["a..b is not an address of this host", "cannot resolve host name a..b"]),
        ("tcp/127.0.0.1:99999", ["has port 99999: ports are 0 to 65535"] * 2),
        ("tcp/[::1", ["is not an address of this host", "cannot resolve host name"]),
        ("udp/gcs:mavlink", ["is not an endpoint: write PROTOCOL/HOST:PORT"] * 2),
    ],
)
def test_invalid_endpoint_in_router_file_is_reported_with_position(
    tmp_path: Path, endpoint: str, reasons: list[str]
) -> None:
    """Every invalid endpoint of a router file is reported with line and column."""
    file = tmp_path / "router.json5"
    file.write_text(
        f'{{ mode: "router", listen: {{ endpoints: ["{endpoint}"] }}, connect: {{ endpoints: ["{endpoint}"] }} }}'
    )
    mistakes = [str(each) for each in check_router_file(file)]
    assert all(
        each.startswith(f"{file}, line 1, column 42: ") and endpoint in each for each in mistakes
    ), mistakes
    assert [reason in each for reason, each in zip(reasons, mistakes, strict=True)] == [
        True,
        True,
    ], mistakes


def test_router_files_are_parsed_as_by_zenohd(tmp_path: Path, endpoint: str) -> None:
    """Syntax errors, unknown keys and missing files are reported; the shipped files and a valid setup pass."""
    broken, unknown = tmp_path / "broken.json5", tmp_path / "unknown.json5"
    broken.write_text('{\n  mode: "router",\n  listen: [\n}\n')
    unknown.write_text('{ mode: "router",\n  lisen: {} }\n')
    of_broken, of_unknown = check(broken, unknown)
    assert of_broken.startswith(f"{broken}, line 4, column 1: ")
    assert of_unknown.startswith(f"{unknown}, line ")
    missing = tmp_path / "router.json5"
    missing.write_text(
        '{\n  transport: { link: { tls: {\n    listen_certificate: "/no/such.crt" } } } }\n'
    )
    (line,) = check(missing)
    assert line.startswith(
        f"{missing}, line 3, column 26: listen_certificate: /no/such.crt cannot be read"
    )
    assert passes("check", "--offline", *sorted((ROOT / "config").glob("*.json5")))
    assert passes("serve", "--check", "--connect", endpoint, "-s", "sim:")


def test_expiring_certificates_are_reported(tmp_path: Path) -> None:
    """Certificates of clients and routers are reported only if they expire within 30 days."""
    make_authority(tmp_path / "pki")
    for name, days in (("soon", 20), ("late", 200)):
        make_certificate(tmp_path / "pki", name, days=days)
    settings, router = tmp_path / "nedbus.toml", tmp_path / "router.json5"
    settings.write_text(
        f'source = "sim:"\ntls_ca = "{tmp_path}/pki/ca.crt"\n'
        f'tls_certificate = "{tmp_path}/pki/soon.crt"\ntls_key = "{tmp_path}/pki/soon.key"\n'
    )
    files = {
        "listen_certificate": "soon.crt",
        "listen_private_key": "soon.key",
        "root_ca_certificate": "ca.crt",
    }
    tls = ",\n".join(f'"{name}": "{tmp_path}/pki/{file}"' for name, file in files.items())
    router.write_text(f"{{ transport: {{ link: {{ tls: {{\n{tls} }} }} }} }}\n")
    lines = check(settings, router)
    assert [line.partition(" soon, issued")[0] for line in lines] == [
        f"{settings}, line 3, column 1: this client is",
        f"{router}, line 2, column 24: listen_certificate: it is",
    ]
    assert all(re.search(r"\d+ days left\); renew it", line) for line in lines), lines
    settings.write_text(settings.read_text().replace("soon", "late"))
    assert passes("check", settings)


@pytest.mark.slow
def test_missing_cryptography_package_is_a_warning(start: Start, tmp_path: Path) -> None:
    """Without `cryptography` the check warns that it cannot verify expiry dates, but reports no mistake."""
    make_authority(tmp_path / "pki")
    settings = tmp_path / "nedbus.toml"
    settings.write_text(f'source = "sim:"\ntls_ca = "{tmp_path}/pki/ca.crt"\n')
    program = "import sys; sys.modules['cryptography'] = None; from nedbus.cli import main; main()"
    checked = start("-c", program, "check", str(settings))
    assert (checked.wait(), checked.out) == (0, "no mistakes found\n"), checked.err
    reason = "certificate expiry not checked; cryptography: not installed"
    assert f"{tmp_path}/pki/ca.crt: {reason}" in checked.err
