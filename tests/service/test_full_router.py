"""A router without room for another session: whoever is turned away is told so, though Zenoh says nothing of it."""

from __future__ import annotations

import socket
import ssl
import threading
from pathlib import Path

import pytest

import nedbus
from nedbus.doctor.endpoint import check_endpoint
from nedbus.transport import make_authority, make_certificate, open_router
from nedbus.transport.full_router import full_router
from tests.conftest import DEADLINE, free_endpoint
from tests.service.test_pki_fleet import without_identifiers

CONFIG = Path(__file__).parents[2] / "config"


def write_config(folder: Path, name: str, endpoint: str) -> Path:
    """Return a shipped configuration with room for one session, on this endpoint."""
    text = (CONFIG / name).read_text().replace("/etc/nedbus/pki", str(folder))
    file = folder / name
    file.write_text(
        text.replace("max_sessions: 1000", "max_sessions: 1")
        .replace("tcp/0.0.0.0:7447", endpoint)
        .replace("tls/0.0.0.0:7447", endpoint)
    )
    return file


def test_who_is_turned_away_is_told(tmp_path: Path) -> None:
    """The second client of a router for one is told why it gets no session; when the first has gone it gets one."""
    endpoint = free_endpoint()
    router = open_router(config_file=write_config(tmp_path, "router.json5", endpoint))
    try:
        with nedbus.connect(endpoint):
            with pytest.raises(nedbus.ConnectError, match=r"no room for more sessions.*max_sessions") as told:
                nedbus.connect(endpoint, timeout=0.5)
            assert told.value.full == endpoint
        nedbus.connect(endpoint, timeout=DEADLINE).close()
        assert full_router([endpoint], None) is None
    finally:
        router.close()


def strict_context(**given: str) -> ssl.SSLContext:
    """Return what `ssl.create_default_context` returns from Python 3.13 on."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.verify_flags |= ssl.VERIFY_X509_STRICT
    context.load_verify_locations(given["cafile"])
    return context


@pytest.mark.parametrize("old", [False, True], ids=["whole", "without identifiers"])
def test_with_certificates(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, *, old: bool) -> None:
    """The same over mutual TLS, on any Python, with old certificates too, and in the words of the doctor."""
    monkeypatch.setattr(ssl, "create_default_context", strict_context)
    make_authority(tmp_path)
    make_certificate(tmp_path, "router", hosts=["127.0.0.1"])
    make_certificate(tmp_path, "reader")
    for name in ("ca", "router", "reader") if old else ():
        without_identifiers(tmp_path / f"{name}.crt", tmp_path / "ca.key")
    files = [str(tmp_path / name) for name in ("ca.crt", "reader.crt", "reader.key")]
    endpoint = free_endpoint().replace("tcp/", "tls/")
    router = open_router(config_file=write_config(tmp_path, "router-secure.json5", endpoint))
    try:
        with nedbus.connect(endpoint, tls=nedbus.Tls(*files)):
            with pytest.raises(nedbus.ConnectError, match="no room for more sessions"):
                nedbus.connect(endpoint, tls=nedbus.Tls(*files), timeout=0.5)
            *_, finding = check_endpoint(endpoint, nedbus.Tls(*files))
        assert (finding.state, finding.seen) == ("wrong", "the router has no room for more sessions")
    finally:
        router.close()


@pytest.mark.parametrize(
    "answer",
    [
        b"",
        b"\x00",
        b"HTTP/1.0 400 Bad Request\r\n\r\n",
        b"\x02\x00\x03\x02",
        b"\x04\x00\x01\x09\xf2\xff",
        b"\xff" * 5000,
    ],
)
def test_other_answers_are_not_full(answer: bytes) -> None:
    """What is no router, or says something else, is not called full, whatever it sends."""
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve() -> None:
            connection, _ = server.accept()
            connection.recv(100)
            connection.sendall(answer)
            connection.close()

        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        assert full_router([f"tcp/127.0.0.1:{server.getsockname()[1]}"], None) is None
        thread.join(DEADLINE)
