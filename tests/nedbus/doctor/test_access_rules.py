"""Access rules of a router's configuration: mistakes that `nedbus check` reports, and explanations of the doctor."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Final

import pytest
import zenoh

from nedbus.doctor import check_router_file
from nedbus.pki import write_access_rules
from nedbus.transport import open_client, read_router_config
from tests.flights.messages import VLP
from tests.peers.certificates import (
    CONFIG,
    client_tls,
    pki,
    secure_endpoint,
    tls_options,
    write_config,
)
from tests.peers.command_line import run_command
from tests.peers.processes import Start
from tests.peers.zenohd import start_zenohd
from tests.waits import DEADLINE, wait_for

__all__ = ["pki"]

SHIPPED: Final = (CONFIG / "router-secure.json5").read_text()
OLD_RULES: Final = (
    SHIPPED.replace('"nedbus/@service/1/*/status", "nedbus/@service/*/status"', '"nedbus/@service/*/status"')
    .replace("nedbus/@service/**/status", "nedbus/@service/*/status")
)  # fmt: skip
"""The rules of nedbus 0.1, whose status keys named no vehicle."""


def mistakes(tmp_path: Path, text: str) -> list[str]:
    """Return the mistakes that `nedbus check --offline` reports of a router's file with this text."""
    file = tmp_path / "router.json5"
    file.write_text(text)
    return [
        str(mistake).removeprefix(f"{file}, ") for mistake in check_router_file(file, offline=True)
    ]


def test_shipped_rules_have_no_mistakes(tmp_path: Path) -> None:
    """The shipped rules pass, also for many vehicles and for a service of several vehicles."""
    assert mistakes(tmp_path, SHIPPED) == []
    write_access_rules(tmp_path / "router.json5", ["1", "2", "x-3"])
    text = (tmp_path / "router.json5").read_text()
    assert mistakes(tmp_path, text) == []
    subject, policy = '{ id: "routers",', '{ rules: ["router"],'
    rules = '["vehicle-1-in", "vehicle-2-in", "vehicle-out", "query-in", "query-out"]'
    text = text.replace(subject, f'{{ id: "link", cert_common_names: ["link"] }},\n{subject}')
    assert (
        mistakes(
            tmp_path, text.replace(policy, f'{{ rules: {rules}, subjects: ["link"] }},\n{policy}')
        )
        == []
    )


@pytest.mark.parametrize("renewed", [False, True])
def test_old_common_rules_are_reported_with_the_remedy(tmp_path: Path, *, renewed: bool) -> None:
    """Rules for status keys that name no vehicle are a mistake, also after `nedbus pki rules` with a new version."""
    (tmp_path / "router.json5").write_text(OLD_RULES)
    if renewed:
        write_access_rules(tmp_path / "router.json5", ["1", "2"])
    of_vehicles, of_readers = mistakes(tmp_path, (tmp_path / "router.json5").read_text())
    certificates = "certificates vehicle-1, vehicle-2" if renewed else "certificate vehicle-1"
    assert re.match(
        rf"line \d+, column \d+: {certificates} may publish a vehicle, but not report about it",
        of_vehicles,
    )
    assert re.match(
        r"line \d+, column \d+: certificates router, router-2, reader and 1 more may read",
        of_readers,
    )
    for mistake in (of_vehicles, of_readers):
        assert (
            "write @service/**/status instead of @service/*/status in the common rules" in mistake
        )
        assert "run 'nedbus pki rules'" in mistake


@pytest.mark.parametrize(
    ("own", "every", "verb"),
    [
        ("nedbus/@service/1/*/status", "nedbus/@service/**/status", "report about"),
        ("nedbus/@rejected/1/**", "nedbus/@rejected/**", "report rejections of"),
        ("nedbus/@schema/1/*", "nedbus/@schema/*/*", "define messages of"),
        ("nedbus/1/@alive/**", "nedbus/*/@alive/**", "announce"),
        ("nedbus/1/**/@adv/**", "nedbus/**/@adv/**", "publish heartbeats of"),
    ],
)
def test_rule_that_lets_a_vehicle_speak_for_another_is_reported(
    tmp_path: Path, own: str, every: str, verb: str
) -> None:
    """A key that names no vehicle in the rule of a vehicle is a mistake, with the position of its certificate."""
    [mistake] = mistakes(tmp_path, SHIPPED.replace(f'"{own}"', f'"{every}"', 1))
    line = (
        SHIPPED[: SHIPPED.index('"vehicle-1"', SHIPPED.index("cert_common_names"))].count("\n") + 1
    )
    assert mistake.startswith(f"line {line}, column ")
    assert f"certificate vehicle-1 may {verb} every vehicle, not only its own" in mistake


@pytest.mark.parametrize("name", ["rejection-size", "heartbeat-size"])
def test_missing_limit_of_size_is_reported(tmp_path: Path, name: str) -> None:
    """A filter without @rejected or @adv lets a vehicle fill the memory of readers."""
    text = "\n".join(line for line in SHIPPED.splitlines() if name not in line)
    [mistake] = mistakes(tmp_path, text)
    assert "may put messages of any size on nedbus/" in mistake
    assert "copy low_pass_filter from config/router-secure.json5" in mistake


@pytest.mark.parametrize(
    "text",
    [
        "{}",
        '{ access_control: { enabled: true, default_permission: "allow" } }',
        (
            '{ access_control: { enabled: true, default_permission: "deny", rules: [{ id: "a", permission: "allow",'
            ' messages: ["put"], key_exprs: ["nedbus/1/**"] }], subjects: [], policies: [{ rules: ["gone"],'
            ' subjects: ["gone"] }] } }'
        ),
    ],
)
def test_configuration_without_rules_of_vehicles_has_no_mistakes(tmp_path: Path, text: str) -> None:
    """Without access control, and with rules that apply to no certificate, there is nothing to report."""
    assert mistakes(tmp_path, text) == []


@pytest.fixture
def secure(pki: Path, tmp_path: Path, start: Start) -> tuple[str, Path]:
    """Run a real zenohd with the shipped rules; return its endpoint and its configuration."""
    endpoint = secure_endpoint()
    file = write_config(pki, tmp_path / "router-secure.json5", endpoint)
    start_zenohd(start, "-c", str(file))
    # it has read the file
    open_client([endpoint], tls=client_tls(pki, "reader"), timeout=DEADLINE).close()
    return endpoint, file


@pytest.mark.slow
@pytest.mark.process
def test_doctor_names_key_certificate_and_rule_of_a_denial(
    pki: Path, secure: tuple[str, Path]
) -> None:
    """With the router's file, the doctor names the key that is denied, the certificate, and the rules without it."""
    endpoint, file = secure
    common = ("doctor", "-c", endpoint, "--rules", str(file))
    denied = run_command(*common, "--vehicle", "2", *tls_options(pki, "vehicle-1"))
    text = " ".join(denied.out.split())
    assert (
        f"warning rules vehicle-1: put on nedbus/2/{VLP} is denied: none of its rules includes this key: vehicle-1-in"
    ) in text
    assert "reply on nedbus/@service/2/1a/status is denied" in text
    allowed = " ".join(
        run_command(*common, "--vehicle", "1", *tls_options(pki, "vehicle-1")).out.split()
    )
    assert (
        f"ok rules vehicle-1: put on nedbus/1/{VLP} is allowed: rule vehicle-1-in allows it"
        in allowed
    )
    assert "is denied" not in allowed
    stranger = " ".join(
        run_command(*common, "--vehicle", "1", *tls_options(pki, "stranger")).out.split()
    )
    assert "rules stranger: " in stranger
    assert "is denied: no rule is for such messages of this certificate" in stranger
    reader = " ".join(run_command(*common, *tls_options(pki, "reader")).out.split())
    assert (
        f"ok rules reader: declare_subscriber on nedbus/*/{VLP} is allowed: rule reader-in allows it"
        in reader
    )


@pytest.mark.slow
@pytest.mark.process
def test_doctor_notices_a_router_with_other_rules(pki: Path, secure: tuple[str, Path]) -> None:
    """Rules that were changed since the router started are named, because it reads them only at startup."""
    endpoint, file = secure
    write_access_rules(file, ["2"])
    options = ("--rules", str(file), "--vehicle", "1", *tls_options(pki, "vehicle-1"))
    expected = "a probe of vehicle 1 was allowed, against this file -> the router reads its rules only at startup"

    def is_noticed() -> bool:  # on a busy machine, a probe may be late
        return expected in " ".join(run_command("doctor", "-c", endpoint, *options).out.split())

    wait_for(is_noticed, what="the finding on other rules")


def test_rules_without_certificate_or_access_control_are_explained(tmp_path: Path) -> None:
    """The doctor says what is missing to explain the rules; an unreadable file is a usage error."""
    closed = secure_endpoint().replace("tls/", "tcp/")
    result = run_command("doctor", "-c", closed, "--rules", str(CONFIG / "router-secure.json5"))
    assert "this client has no certificate" in result.out
    result = run_command("doctor", "-c", closed, "--rules", str(CONFIG / "router.json5"))
    assert "the file has no access rules" in result.out
    result = run_command("doctor", "-c", closed, "--rules", str(tmp_path / "gone.json5"))
    assert (result.exit_code, "there is no such file" in result.err) == (2, True)


@pytest.mark.process
def test_decisions_equal_those_of_zenohd(pki: Path, secure: tuple[str, Path]) -> None:
    """For each certificate and key, zenohd forwards a put if and only if the evaluation of its file allows it."""
    endpoint, file = secure
    access = read_router_config(file).access
    keys = [f"nedbus/1/{VLP}", f"nedbus/2/{VLP}", f"nedbus/1/{VLP}/@rate/5", f"nedbus/@rejected/1/{VLP}",
            f"nedbus/@rejected/2/{VLP}", f"nedbus/1/{VLP}/@adv/pub/1a/1/_", "other/1/topic"]  # fmt: skip
    names = ("vehicle-1", "vehicle-2", "reader", "stranger", "router")
    sessions = {
        name: open_client([endpoint], tls=client_tls(pki, name), timeout=DEADLINE) for name in names
    }
    try:
        forwarded = set[tuple[str, str]]()
        receivers = {
            key: sessions["router"].declare_subscriber(key, zenoh.handlers.RingChannel(100))
            for key in keys
            if access.decide("router", "declare_subscriber", "ingress", key).is_allowed
        }
        expected = {
            (name, key)
            for name in names
            for key in receivers
            if access.decide(name, "put", "ingress", key).is_allowed
        }
        assert ("vehicle-1", keys[0]) in expected
        assert ("vehicle-1", keys[1]) not in expected

        def is_forwarded() -> bool:
            for name in names:
                for key in keys:
                    sessions[name].put(key, name.encode())
            for key, receiver in receivers.items():
                samples = iter(receiver.handler.try_recv, None)
                forwarded.update((sample.payload.to_string(), key) for sample in samples)
            return forwarded >= expected

        wait_for(is_forwarded, what="all allowed messages")
        is_forwarded()
        assert forwarded == expected
    finally:
        for session in sessions.values():
            session.close()
