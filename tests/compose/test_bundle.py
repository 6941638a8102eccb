"""`nedbus pki enroll`, `renew` and `rules`: bundles that run in Docker against the secure stack."""

from __future__ import annotations

import re
import shutil
import ssl
import subprocess
import urllib.request
from pathlib import Path

import pytest

from tests.flights.messages import VLP
from tests.peers.ports import free_endpoint
from tests.peers.processes import Start
from tests.waits import DEADLINE, wait_for

from .certificates import FILES, USER, distribute, join, make_certificates
from .conftest import Record, StartStack
from .stack import ROOT, Stack

pytestmark = [pytest.mark.compose, pytest.mark.timeout(600)]

RESTART = "docker compose -f docker-compose.yml -f docker-compose.secure.yml restart router"


@pytest.fixture
def pki(tmp_path: Path) -> Path:
    make_certificates(tmp_path / "pki", "vehicle-1", "reader")
    return tmp_path / "pki"


@pytest.fixture
def secure(make_stack: StartStack, tmp_path: Path, pki: Path) -> Stack:
    """Prepare the shipped stack with a copy of the router file that a test may change."""
    shutil.copytree(ROOT / "config", tmp_path / "config")
    files = [str(ROOT / file) for file in FILES]
    return make_stack("fleet", *files, directory=tmp_path, NEDBUS_PKI=str(pki), NEDBUS_USER=USER)


def restart_router(stack: Stack) -> None:
    """Restart the router with the documented command."""
    assert RESTART in (ROOT / "docs" / "security.md").read_text()
    stack.compose(*RESTART.split()[-2:])


def router_certificate(stack: Stack, pki: Path) -> str:
    """Return the certificate that the router presents, as PEM."""
    host, port = stack.address.split(":")
    presented = ssl.get_server_certificate(
        (host, int(port)), ca_certs=str(pki / "ca.crt"), timeout=DEADLINE
    )
    return presented.strip()


def test_bundle_is_denied_until_access_rules_name_its_vehicle(
    make_stack: StartStack,
    run_nedbus: Start,
    secure: Stack,
    pki: Path,
    tmp_path: Path,
    *,
    record: Record,
) -> None:
    """A bundle started as in its README.txt is denied until the router's access rules name its vehicle."""
    rules = tmp_path / "config" / "router-secure.json5"

    def pki_command(*arguments: str) -> None:
        done = run_nedbus("pki", *arguments)
        assert done.wait() == 0, done.err

    bundles: dict[str, Stack] = {}
    status: dict[str, str] = {}
    for vehicle in ("wing", "stranger"):
        folder = tmp_path / vehicle
        router = f"tls/{secure.address}"
        pki_command(
            "enroll", str(pki), vehicle, "--router", router, "-o", str(folder), "-s", "sim:"
        )
        command = re.findall(
            r"^ {7}(echo .* > \.env)\n {7}docker compose up -d$",
            (folder / "README.txt").read_text(),
            re.MULTILINE,
        )
        subprocess.run(["bash", "-c", *command], cwd=folder, check=True, timeout=DEADLINE)
        status[vehicle] = free_endpoint().removeprefix("tcp/")
        bundles[vehicle] = make_stack(
            vehicle, str(folder / "compose.yml"), directory=folder, NEDBUS_HTTP=status[vehicle]
        )
    pki_command("rules", str(rules), "wing")
    secure.up("router")
    for bundle in bundles.values():
        bundle.up()
    reader = join(secure, pki, "reader")
    recorder = record(reader.subscribe(VLP, mode="every"))
    recorder.wait_for_more(100)
    wait_for(lambda: published(status["stranger"]) > 100, what="messages of the denied vehicle")
    recorder.wait_for_more(100)
    assert {sample.vehicle for sample in recorder.samples} == {"wing"}
    assert list(reader.vehicles()) == ["wing"]
    assert "1 vehicle," in bundles["wing"].compose("exec", "-T", "nedbus", "nedbus", "health")

    pki_command("rules", str(rules), "--add", "stranger")
    restart_router(secure)
    wait_for(
        lambda: {sample.vehicle for sample in list(recorder.samples)} == {"wing", "stranger"},
        what="both",
    )
    recorder.wait_for_more(100)
    assert recorder.subscription.counts.lost == 0

    pki_command("renew", str(pki), "vehicle-wing")
    (pki / "vehicle-wing.crt").rename(tmp_path / "wing" / "pki" / "vehicle-wing.crt")
    seen = bundles["wing"].compose("exec", "-T", "nedbus", "cat", "pki/vehicle-wing.crt")
    assert seen == (tmp_path / "wing" / "pki" / "vehicle-wing.crt").read_text()


def published(address: str) -> float:
    """Return the number of published messages from a service's metrics; 0 if it does not respond."""
    try:
        with urllib.request.urlopen(f"http://{address}/metrics", timeout=DEADLINE) as page:
            text = page.read().decode()
    except OSError:
        return 0.0
    counts = re.findall(
        rf'^nedbus_messages_published_total{{.*topic="{VLP}".*}} (\S+)$', text, re.MULTILINE
    )
    return sum(map(float, counts))


def test_renewed_certificates_are_used(
    run_nedbus: Start, secure: Stack, pki: Path, record: Record
) -> None:
    """Renewed certificates, copied as documented, reach the containers; the restarted router presents the new one."""
    secure.up()
    recorder = record(join(secure, pki, "reader").subscribe(VLP, mode="every"))
    recorder.wait_for_more(100)
    for service, name in (("router", "router"), ("service", "vehicle-1")):
        seen = secure.compose("exec", "-T", service, "ls", "/etc/nedbus/pki").split()
        assert set(seen) == {"ca.crt", f"{name}.crt", f"{name}.key"}
    before = secure.container("router"), secure.container("service")
    old = router_certificate(secure, pki)
    renewed = run_nedbus("pki", "renew", str(pki), "router", "vehicle-1", "reader", "--days", "900")
    assert renewed.wait() == 0, renewed.err
    for name in ("router", "vehicle-1"):  # copying may create a new file of the same name
        (pki / name / f"{name}.crt").unlink()
    distribute(pki)
    own = (pki / "vehicle-1.crt").read_text()
    assert secure.compose("exec", "-T", "service", "cat", "/etc/nedbus/pki/vehicle-1.crt") == own
    new = (pki / "router.crt").read_text().strip()
    assert router_certificate(secure, pki) == old != new
    restart_router(secure)
    wait_for(lambda: is_presented(secure, pki, new), what="the router's new certificate")
    recorder.wait_for_more(100)
    assert recorder.subscription.counts.lost == 0
    join(secure, pki, "reader").close()
    assert (secure.container("router"), secure.container("service")) == before


def is_presented(stack: Stack, pki: Path, certificate: str) -> bool:
    """Return whether the router presents this certificate; False while it starts."""
    try:
        return router_certificate(stack, pki) == certificate
    except OSError:
        return False
