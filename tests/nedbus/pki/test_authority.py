"""Certificates and access rules of a fleet, tested with real routers and TLS connections."""

from __future__ import annotations

import json
import os
import re
import shutil
import ssl
import stat
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

import nedbus
from nedbus.doctor import check_service
from nedbus.pki import (
    certificate_name,
    list_certificates,
    make_authority,
    make_bundle,
    make_certificate,
    read_access_rules,
    renew_certificate,
    write_access_rules,
)
from nedbus.transport import open_client, open_router
from nedbus_msgs import Address, AddressError
from tests.flights.messages import VLP, message
from tests.peers import certificates
from tests.peers.certificates import secure_endpoint, client_tls, write_config
from tests.peers.command_line import run_command
from tests.peers.ports import free_endpoint
from tests.peers.processes import Start
from tests.peers.zenohd import ROUTER_KINDS, start_zenohd
from tests.waits import DEADLINE, wait_for

ROOT = Path(__file__).parents[3]
CONFIG = certificates.CONFIG / "router-secure.json5"
FLEET = [str(number) for number in range(1, 201)]
SAMPLE = ("1", "99", "200")

shared_pki = certificates.pki
Join = Callable[..., nedbus.Bus]
RunRouter = Callable[[Path], Callable[[], None]]


@pytest.fixture
def pki(shared_pki: Path, tmp_path: Path) -> Path:
    """Copy a CA with certificates of routers, vehicles and readers, which the test may modify."""
    invalid = shutil.ignore_patterns("foreign", "*expired*", "router-soon*", "router-elsewhere*")
    return Path(shutil.copytree(shared_pki, tmp_path / "pki", ignore=invalid))


@pytest.fixture
def file(pki: Path) -> Path:
    """Write the shipped router file with the certificates of `pki` and a free port."""
    return write_config(pki, Path("router-secure.json5").resolve(), secure_endpoint())


def endpoint_of(file: Path) -> str:
    """Return the endpoint in a file of the fixture `file`."""
    return "tls/" + file.read_text().split('listen: { endpoints: ["tls/')[1].split('"')[0]


@pytest.fixture(params=ROUTER_KINDS)
def run_router(request: pytest.FixtureRequest) -> Iterator[RunRouter]:
    """Yield a function that runs a router, embedded or a real zenohd, with a file, and returns a function to stop it."""
    with ExitStack() as stack:

        def run(file: Path) -> Callable[[], None]:
            if request.param == "nedbus":
                stop = open_router(config_file=file).close
            else:
                stop = start_zenohd(request.getfixturevalue("start"), "-c", str(file)).kill
            stack.callback(stop)
            return stop

        yield run


@pytest.fixture
def join(file: Path, pki: Path) -> Iterator[Join]:
    """Yield a function that connects with the certificate of a given name, by default to the router of the file."""
    with ExitStack() as stack:

        def join_as(name: str, *endpoints: str, tls: nedbus.Tls | None = None) -> nedbus.Bus:
            where = endpoints or endpoint_of(file)
            return stack.enter_context(nedbus.connect(where, tls=tls or client_tls(pki, name), timeout=DEADLINE))

        yield join_as


def assert_writes_only(bus: nedbus.Bus, reader: nedbus.Bus, vehicle: str, others: list[str]) -> None:
    """Assert that a reader receives what the bus publishes as this vehicle, but nothing it published as others before."""
    # as a service
    publishers = {name: bus._publishers.publisher(Address(name, VLP)) for name in [*others, vehicle]}
    with reader.subscribe("*", mode="every") as subscription:

        def publish() -> bool:
            # One link preserves the order: forged messages would arrive first.
            for each in publishers.values():
                each.publish(message(int(vehicle)))
            return bool(reader.latest(VLP, vehicle=vehicle))

        wait_for(publish, what=f"vehicle {vehicle}")
        while (arrived := subscription.receive(DEADLINE).vehicle) != vehicle:
            assert arrived not in others
    assert {sample.vehicle for sample in reader.latest("*")}.isdisjoint(others)
    for publisher in publishers.values():
        publisher.close()


@pytest.mark.slow
def test_bundle_publishes_only_its_vehicle(
    run_router: RunRouter, run_nedbus: Start, tmp_path: Path, *, file: Path, pki: Path, join: Join
) -> None:
    """A service with the nedbus.toml of an enrolled bundle publishes its vehicle and no other."""
    bundle, endpoint = tmp_path / "wing", endpoint_of(file)
    enrolled = run_command(
        *("pki", "enroll", str(pki), "wing", "--router", endpoint, "--output", str(bundle), "--target", str(bundle)),
        *("--source", "sim:", "--source", "sim:?vehicle=99"),
    )
    assert enrolled.exit_code == 0, enrolled.err
    files = {str(Path(line).relative_to(bundle)) for line in enrolled.out.splitlines()}
    own = {"pki/ca.crt", "pki/vehicle-wing.crt", "pki/vehicle-wing.key"}
    assert files == own | {"nedbus.toml", "compose.yml", "README.txt"}
    assert stat.S_IMODE((bundle / "pki" / "vehicle-wing.key").stat().st_mode) == 0o600
    assert (pki / "vehicle-wing.crt").is_file()
    assert not (pki / "vehicle-wing.key").exists()
    added = run_command("pki", "rules", str(file), "--add", "99", "wing")
    assert (added.exit_code, added.out) == (0, "+ 99\n+ wing\n"), added.err
    run_router(file)
    reader = join("reader")
    run_nedbus("serve", "--config", str(bundle / "nedbus.toml"))
    wait_for(lambda: "wing" in reader.vehicles(), what="the vehicle")
    wait_for(lambda: reader.latest(VLP, vehicle="wing"), what="its messages")
    assert not reader.latest(VLP, vehicle="99")
    assert list(reader.vehicles()) == ["wing"]


@pytest.mark.long
def test_documented_commands_enroll_a_vehicle(run_nedbus: Start, tmp_path: Path) -> None:
    """The commands of docs/security.md work in order in an empty folder, here on loopback and without /etc."""
    page = (ROOT / "docs" / "security.md").read_text()
    section = page.split("## A fleet\n")[1].split("### Enroll a vehicle\n")[0]
    here = tmp_path / "empty"
    here.mkdir()
    endpoint = free_endpoint().removeprefix("tcp/")
    path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"

    def localize(text: str) -> str:
        for documented, local in (
            ("192.168.1.5:7447", endpoint),
            ("0.0.0.0:7447", endpoint),
            ("192.168.1.5", "127.0.0.1"),
            ("~/nedbus", str(ROOT)),
            ("/etc/nedbus", str(tmp_path / "etc")),
            ("sudo ", ""),
        ):
            text = text.replace(documented, local)
        return text

    def run(command: str) -> str:
        done = subprocess.run(
            ["bash", "-e", "-c", localize(command)],
            cwd=here,
            env=os.environ | {"PATH": path},
            capture_output=True,
            text=True,
            timeout=120,
            check=False,
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    setup, router, reader, later = re.findall(r"```bash\n(.*?)```", section, re.DOTALL)
    assert run(setup).endswith("+ 7\n- 1\n")
    copy, start_router = router.splitlines()
    run(copy)
    assert start_router == "nedbus router router-secure.json5"
    file = here / "router-secure.json5"
    file.write_text(localize(file.read_text()))
    run_nedbus("router", str(file))
    shutil.copytree(here / "vehicle-7" / "pki", tmp_path / "etc" / "pki", dirs_exist_ok=True)
    settings = (here / "vehicle-7" / "nedbus.toml").read_text().replace('# source = ["sim:', 'source = ["sim:')
    (tmp_path / "etc" / "nedbus.toml").write_text(localize(settings))
    run_nedbus("serve", "--config", str(tmp_path / "etc" / "nedbus.toml"))

    def is_healthy() -> bool:
        try:
            return "1 vehicle," in run(reader)
        except AssertionError:
            return False

    wait_for(is_healthy, what=reader, seconds=120.0)
    output = run(later)
    assert "+ 8\n" in output
    assert re.search(r"^vehicle-8 +client .* valid$", output, re.MULTILINE)


def test_each_suggested_source_in_a_bundle_is_valid(pki: Path, tmp_path: Path) -> None:
    """Uncommenting any source in the nedbus.toml of a bundle yields a valid configuration."""
    bundle = tmp_path / "wing"
    make_bundle(pki, "wing", bundle, routers=["tls/127.0.0.1:7447"], target=bundle)
    text = (bundle / "nedbus.toml").read_text()
    suggested = re.findall(r"^# (source = .*)$", text, re.MULTILINE)
    assert len(suggested) == 3
    for source in suggested:
        (bundle / "nedbus.toml").write_text(text.replace(f"# {source}", source).replace("# listen", "listen"))
        assert check_service(bundle / "nedbus.toml", offline=True) == []


def test_bundle_is_created_completely_or_not_at_all(pki: Path, tmp_path: Path) -> None:
    """A new bundle overwrites no file, and an error leaves no new file behind, even in the folder of the CA."""
    routers = ["tls/10.0.0.1:7447", "tls/10.0.0.2:7447"]
    before = sorted(pki.iterdir())
    (tmp_path / "taken").mkdir()
    for vehicle, output, router, error, reason in (
        ("7", tmp_path / "taken", routers[0], nedbus.errors.PkiError, "exists and is not overwritten"),
        ("1", tmp_path / "new", routers[0], nedbus.errors.PkiError, "exists and is not overwritten"),
        ("7", Path("/proc/nowhere/new"), routers[0], nedbus.errors.PkiError, "cannot create"),
        ("7", tmp_path / "new", "tcp/10.0.0.1:7447", nedbus.ConfigError, "does not use TLS"),
        ("../7", tmp_path / "new", routers[0], AddressError, "vehicle"),
        ("x" * 60, tmp_path / "new", routers[0], AddressError, "vehicle"),
    ):
        with pytest.raises(error, match=reason):
            make_bundle(pki, vehicle, output, routers=[router])
    assert sorted(pki.iterdir()) == before
    assert not (tmp_path / "new").exists()
    make_bundle(pki, "7", tmp_path / "new", routers=routers)
    settings = tomllib.loads((tmp_path / "new" / "nedbus.toml").read_text())
    assert settings == {
        "connect": routers,
        "tls_ca": "/etc/nedbus/pki/ca.crt",
        "tls_certificate": "/etc/nedbus/pki/vehicle-7.crt",
        "tls_key": "/etc/nedbus/pki/vehicle-7.key",
        "vehicle": "7",
    }
    assert not list(tmp_path.glob(".*"))
    again = run_command("pki", "enroll", str(pki), "7", "--router", routers[0], "-o", str(tmp_path / "other"))
    assert again.exit_code == 1
    assert "vehicle-7.crt exists and is not overwritten" in again.err


@pytest.mark.slow
def test_old_and_renewed_certificate_are_both_valid(run_router: RunRouter, file: Path, pki: Path, join: Join) -> None:
    """A renewal keeps name and key. Open links with the old certificate persist, and both certificates can connect."""
    write_access_rules(file, SAMPLE)
    run_router(file)
    old = Path(shutil.copytree(pki, "old"))
    before, reader = join("vehicle-99"), join("reader")
    entry = next(entry for entry in list_certificates(pki) if entry.name == "vehicle-99")
    assert renew_certificate(entry, days=900) == [pki / "vehicle-99.crt"]
    renewed = next(entry for entry in list_certificates(pki) if entry.name == "vehicle-99")
    assert renewed.certificate.ends > entry.certificate.ends
    assert (old / "vehicle-99.crt").read_bytes() != (pki / "vehicle-99.crt").read_bytes()
    for bus in (before, join("vehicle-99"), join("", tls=client_tls(old, "vehicle-99"))):
        assert_writes_only(bus, reader, "99", ["1"])
    assert renew_certificate(renewed, replace_key=True) == [pki / "vehicle-99.key", pki / "vehicle-99.crt"]
    assert stat.S_IMODE((pki / "vehicle-99.key").stat().st_mode) == 0o600
    for bus in (join("vehicle-99"), join("", tls=client_tls(old, "vehicle-99"))):
        assert_writes_only(bus, reader, "99", ["1"])


def test_certificate_is_reloaded_at_every_connection(run_router: RunRouter, file: Path, pki: Path, join: Join) -> None:
    """A replaced certificate file takes effect at the next connection, without a restart of the client."""
    write_access_rules(file, SAMPLE)
    stop = run_router(file)
    for suffix in (".crt", ".key"):
        shutil.copy(pki / f"vehicle-1{suffix}", pki / f"own{suffix}")
    bus = join("own")
    assert_writes_only(bus, join("reader"), "1", ["99"])
    for suffix in (".crt", ".key"):
        shutil.copy(pki / f"vehicle-99{suffix}", pki / f"own{suffix}")
    stop()
    run_router(file)
    assert_writes_only(bus, join("reader"), "99", ["1"])


def pki_command(code: int, command: str, *arguments: str) -> tuple[list[str], str]:
    """Run `nedbus pki`, and return the lines on stdout and the text on stderr."""
    result = run_command("pki", command, *arguments)
    assert result.exit_code == code, result.err
    return result.out.splitlines(), result.err


def test_renew_replaces_only_expiring_certificates(tmp_path: Path) -> None:
    """By default, `renew` replaces certificates that expire within 30 days, and keeps their hosts.

    `list` shows the use and the state of each certificate.
    """
    folder = tmp_path / "fleet"
    make_authority(folder)
    make_authority(folder / "foreign")
    make_certificate(folder, "router", hosts=["127.0.0.1", "gcs", "::1"], days=29)
    for name, days in (("vehicle-1", -1), ("vehicle-99", 40), ("reader", 800), ("operator", 800)):
        make_certificate(folder, name, days=days)
    make_certificate(folder / "foreign", "alien", days=5)
    shutil.copy(folder / "foreign" / "alien.crt", folder)
    shutil.copy(folder / "reader.key", folder / "operator.key")

    def states() -> dict[str, tuple[str, str]]:
        listed = "\n".join(pki_command(0, "list", str(folder), "--json")[0])
        return {row["name"]: (row["use"], row["state"]) for row in json.loads(listed)}

    assert states() == {
        "ca": ("authority", "valid"),
        "vehicle-1": ("client", "EXPIRED"),
        "alien": ("client", "signed by another authority"),
        "router": ("router", "expires soon"),
        "vehicle-99": ("client", "valid"),
        "operator": ("client", "does not match the key next to it"),
        "reader": ("client", "valid"),
    }
    assert pki_command(0, "renew", str(folder))[0] == [str(folder / "vehicle-1.crt"), str(folder / "router.crt")]
    entries = {entry.name: entry for entry in list_certificates(folder)}
    assert entries["router"].certificate.hosts == ("127.0.0.1", "gcs", "::1")
    assert entries["router"].certificate.ends > datetime.now(UTC) + timedelta(days=800)
    out, err = pki_command(0, "renew", str(folder))
    assert (out, "no certificate expires within 30 days" in err) == ([], True)
    pki_command(0, "renew", str(folder), "operator", "--new-key", "--days", "10")
    assert states()["operator"] == ("client", "expires soon")
    for name, reason in (("absent", "has no certificate named 'absent'"), ("alien", "in the folder of that CA")):
        assert reason in pki_command(1, "renew", str(folder), name)[1]
    assert [line.split()[0] for line in pki_command(0, "list", str(folder))[0]][:2] == ["NAME", "ca"]


def test_renewed_authority_keeps_its_certificates_valid(run_router: RunRouter, tmp_path: Path) -> None:
    """A renewed CA keeps its key, so its certificates stay valid; no certificate expires after its CA."""
    folder, endpoint = tmp_path / "fleet", secure_endpoint()
    make_authority(folder, days=20)
    make_certificate(folder, "router", hosts=["127.0.0.1"])
    make_certificate(folder, "reader")
    first, *others = list_certificates(folder)
    assert first.use == "authority"
    assert {entry.certificate.ends for entry in others} == {first.certificate.ends}
    assert renew_certificate(first) == [folder / "ca.crt"]
    assert list_certificates(folder)[0].certificate.ends > first.certificate.ends + timedelta(days=3000)
    run_router(write_config(folder, tmp_path / "router-secure.json5", endpoint))
    nedbus.connect(endpoint, tls=client_tls(folder, "reader"), timeout=DEADLINE).close()


def test_expired_authority_is_ignored_if_a_valid_one_is_in_the_file(pki: Path, tmp_path: Path) -> None:
    """One valid CA certificate in tls_ca is enough. If all have expired, the error states the expiry."""
    expired, both = make_authority(tmp_path / "old", days=-1)[1], tmp_path / "both.crt"
    both.write_bytes(expired.read_bytes() + (pki / "ca.crt").read_bytes())
    assert nedbus.Tls(expired).explain() == f"{expired} has expired"
    assert nedbus.Tls(both).explain() is None


def handshake_error(ca: Path, server: nedbus.Tls, client: nedbus.Tls, *, strict: bool) -> str:
    """Return the verification error of a handshake with mutual TLS, or "" if it succeeds."""
    sides = []
    pipes = ssl.MemoryBIO(), ssl.MemoryBIO()
    for own, is_server in ((server, True), (client, False)):
        context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER if is_server else ssl.PROTOCOL_TLS_CLIENT)
        context.verify_mode = ssl.CERT_REQUIRED
        if strict:  # as in create_default_context of Python 3.13 and later
            context.verify_flags |= ssl.VERIFY_X509_STRICT
        context.load_verify_locations(ca)
        assert own.certificate is not None
        context.load_cert_chain(own.certificate, own.key)
        host = None if is_server else "127.0.0.1"
        incoming, outgoing = pipes if is_server else pipes[::-1]
        sides.append(context.wrap_bio(incoming, outgoing, server_side=is_server, server_hostname=host))
    for _ in range(5):
        for side in sides:
            try:
                side.do_handshake()
            except ssl.SSLWantReadError:
                continue
            except ssl.SSLCertVerificationError as exc:
                return exc.verify_message
    return ""


def remove_key_identifiers(path: Path, authority: Path) -> None:
    """Re-sign a certificate without key identifiers, as created by earlier versions of nedbus."""
    old = x509.load_pem_x509_certificate(path.read_bytes())
    builder = x509.CertificateBuilder(
        old.issuer, old.subject, old.public_key(), old.serial_number, old.not_valid_before_utc, old.not_valid_after_utc
    )
    for each in old.extensions:
        if not isinstance(each.value, x509.SubjectKeyIdentifier | x509.AuthorityKeyIdentifier):
            builder = builder.add_extension(each.value, critical=each.critical)
    key = serialization.load_pem_private_key(authority.read_bytes(), password=None)
    assert isinstance(key, ec.EllipticCurvePrivateKey)
    path.write_bytes(builder.sign(key, hashes.SHA256()).public_bytes(serialization.Encoding.PEM))


@pytest.mark.parametrize("earlier", [False, True], ids=["this version", "earlier version"])
def test_certificates_pass_strict_verification(pki: Path, *, earlier: bool) -> None:
    """Certificates pass Python 3.13's strict verification. Older ones stay valid, and pass once renewed."""
    router, reader = client_tls(pki, "router"), client_tls(pki, "reader")
    for name in ("ca", "router", "reader") if earlier else ():
        remove_key_identifiers(pki / f"{name}.crt", pki / "ca.key")
    assert ("Identifier" in handshake_error(pki / "ca.crt", router, reader, strict=True)) == earlier
    entries = {entry.name: entry for entry in list_certificates(pki)}
    for name in ("reader", "ca", "router"):
        assert handshake_error(pki / "ca.crt", router, reader, strict=not earlier) == "", f"before {name} was renewed"
        renew_certificate(entries[name], replace_key=not earlier and name == "reader")
    assert handshake_error(pki / "ca.crt", router, reader, strict=True) == ""


def test_shipped_rules_equal_generated_rules(tmp_path: Path) -> None:
    """`nedbus pki rules` generates exactly the vehicle entries of config/router-secure.json5."""
    copy = Path(shutil.copy(CONFIG, tmp_path))
    write_access_rules(copy, ["1"])
    assert read_access_rules(copy) == ["1"]
    assert copy.read_text() == CONFIG.read_text()
    write_access_rules(copy, FLEET)
    assert copy.read_text() != CONFIG.read_text()
    write_access_rules(copy, ["1"])
    assert copy.read_text() == CONFIG.read_text()


def test_rules_command_sets_adds_and_removes_vehicles(file: Path, pki: Path, tmp_path: Path) -> None:
    """--from replaces all vehicles; --add and --remove change some. The file keeps its mode, and errors write nothing."""
    file.chmod(0o640)
    names = tmp_path / "names"
    names.write_text("10\n2   # comment\n\nwing\n")

    def rules(*arguments: str, code: int = 0) -> tuple[list[str], str]:
        return pki_command(code, "rules", str(file), *arguments)

    assert rules()[0] == ["1"]
    changes, err = rules("--from", str(names))
    assert changes == ["+ 10", "+ 2", "+ wing", "- 1"]
    assert "names 3 vehicles: restart the router to apply them" in err
    assert rules("--add", "2", "1")[0] == ["+ 1"]
    assert rules("--remove", "wing", "10")[0] == ["- 10", "- wing"]
    assert rules()[0] == ["1", "2"]
    assert rules("--from", str(pki))[0] == ["+ 200", "+ 99", "+ mocap"]
    assert stat.S_IMODE(file.stat().st_mode) == 0o640
    before = file.read_bytes()
    assert "its access rules do not name vehicle '7'" in rules("--remove", "7", code=2)[1]
    assert "cannot be combined" in rules("--add", "--remove", "7", code=2)[1]
    for vehicles, prefix in (([], "nedbus"), (["a/b"], "nedbus"), (["1"], "a*"), (["x" * 60], "nedbus")):
        with pytest.raises((nedbus.ConfigError, AddressError)):
            write_access_rules(file, vehicles, prefix=prefix)
    assert file.read_bytes() == before
    file.write_text(CONFIG.read_text().replace("// END vehicles", "", 1))
    for path, reason in ((file, "2 of 3 pairs of marker lines"), (Path("gone.json5"), "cannot be read")):
        with pytest.raises(nedbus.ConfigError, match=reason):
            write_access_rules(path, ["1"])


@pytest.mark.slow
def test_rules_of_200_vehicles_are_enforced(run_router: RunRouter, file: Path, join: Join) -> None:
    """Each of 200 vehicles may publish only its own keys, and a removed vehicle may publish nothing."""
    write_access_rules(file, FLEET)
    assert read_access_rules(file) == sorted(FLEET)
    stop = run_router(file)
    reader = join("reader")
    for vehicle in SAMPLE:
        others = [each for each in ("1", "2", "99", "100", "200", "201") if each != vehicle]
        assert_writes_only(join(certificate_name(vehicle)), reader, vehicle, others)
    stop()
    write_access_rules(file, FLEET[:-1])
    run_router(file)
    removed, reader = join("vehicle-200"), join("reader")
    removed._publishers.publisher(Address("200", VLP)).publish(message(200))
    assert_writes_only(join("vehicle-1"), reader, "1", ["200"])
    assert not reader.latest(VLP, vehicle="200")


@pytest.mark.slow
def test_running_zenohd_rejects_new_rules(start: Start, file: Path, pki: Path, join: Join) -> None:
    """The admin space of zenohd rejects changes of access_control. If this fails, simplify docs/security.md."""
    queried = 'messages: ["query"],\n        key_exprs: ["@/'
    text = file.read_text().replace("write: false", "write: true")
    file.write_text(text.replace(queried, queried.replace('"query"', '"query", "put"')))
    router = start_zenohd(start, "-c", str(file))
    refused = "Error inserting conf value {} : updating config is only supported for keys starting with"
    values = {"access_control": '{ "enabled": false }', "access_control/default_permission": '"allow"'}
    with open_client([endpoint_of(file)], tls=client_tls(pki, "operator"), timeout=DEADLINE) as operator:
        (answer,) = [reply.ok for reply in operator.get("@/*/router") if reply.ok]
        for name, value in values.items():
            operator.put(f"{answer.key_expr}/config/{name}", value)
        for text in map(refused.format, values):
            wait_for(lambda: text in router.out + router.err, what=text)  # noqa: B023 - called immediately
    assert_writes_only(join("vehicle-1"), join("reader"), "1", ["99"])


@pytest.mark.slow
def test_rolling_restart_of_two_routers_loses_no_message(run_router: RunRouter, file: Path, join: Join) -> None:
    """Clients of two routers fail over while each router restarts with new rules; mode `every` loses no message."""
    first, second = endpoint_of(file), secure_endpoint()
    other = file.with_name("second.json5")
    text = file.read_text().replace(f'["{first}"]', f'["{second}"]').replace("router.", "router-2.")
    other.write_text(text.replace("connect: { retry:", f'connect: {{ endpoints: ["{first}"], retry:'))
    stops = [run_router(each) for each in (file, other)]
    publisher = join("vehicle-1", first, second).publisher(VLP, vehicle="1")
    reader = join("reader", second, first)
    with reader.subscribe(VLP, mode="every") as subscription:
        received: list[int] = []

        def receive_one_more() -> bool:
            publisher.publish(message(publisher.published + 1))
            try:
                received.append(subscription.receive(0.05).message.timestamp)
            except nedbus.NoDataError:
                return False
            return True

        wait_for(receive_one_more, what="the first message, through both routers")
        for index, each in enumerate((file, other)):
            write_access_rules(each, ["1", "99"])
            stops[index]()
            known = len(received)
            wait_for(lambda: receive_one_more() and len(received) > known + 20, what="messages")  # noqa: B023 - called immediately
            run_router(each)
            for name in ("vehicle-99", "reader"):
                join(name, endpoint_of(each)).close()
            wait_for(lambda: receive_one_more() and len(received) > known + 40, what="messages")  # noqa: B023 - called immediately
        while received[-1] < publisher.published:
            received.append(subscription.receive(DEADLINE).message.timestamp)
        assert received == list(range(received[0], publisher.published + 1))
        assert subscription.counts.lost == 0
    assert_writes_only(join("vehicle-99", first), join("reader", second), "99", ["200"])
