"""A router without room for another session: whoever is turned away is told so, though Zenoh says nothing of it."""

from __future__ import annotations

import shutil
import socket
import ssl
import threading
from pathlib import Path

import pytest

import nedbus
from nedbus.transport import open_router
from nedbus.transport.full_router import full_router
from tests.certificates import pki, secure_endpoint, tls_of, write_config
from tests.ports import free_endpoint
from tests.service.test_pki_fleet import without_identifiers
from tests.waits import DEADLINE, wait_for

__all__ = ["pki"]

FOR_ONE = {"max_sessions: 1000": "max_sessions: 1"}


def test_who_is_turned_away_is_told(tmp_path: Path) -> None:
    """The second client of a router for one is told why it gets no session; when the first has gone it gets one."""
    endpoint = free_endpoint()
    with open_router(config_file=write_config(tmp_path, tmp_path / "router.json5", endpoint, **FOR_ONE)):
        with nedbus.connect(endpoint):
            with pytest.raises(nedbus.ConnectError, match=r"no room for more sessions.*max_sessions") as told:
                nedbus.connect(endpoint, timeout=0.1)
            assert told.value.full == endpoint
        nedbus.connect(endpoint, timeout=DEADLINE).close()
        wait_for(lambda: full_router([endpoint], None) is None, what="room, as the last one has gone")


def strict_context(**given: str) -> ssl.SSLContext:
    """Return what `ssl.create_default_context` returns from Python 3.13 on."""
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_CLIENT)
    context.verify_flags |= ssl.VERIFY_X509_STRICT
    context.load_verify_locations(given["cafile"])
    return context


@pytest.mark.parametrize("old", [False, True], ids=["whole", "without identifiers"])
def test_with_certificates(tmp_path: Path, pki: Path, monkeypatch: pytest.MonkeyPatch, *, old: bool) -> None:
    """The same over mutual TLS, on any Python, with old certificates too."""
    monkeypatch.setattr(ssl, "create_default_context", strict_context)
    folder = Path(shutil.copytree(pki, tmp_path / "pki"))
    for name in ("ca", "router", "reader") if old else ():
        without_identifiers(folder / f"{name}.crt", folder / "ca.key")
    endpoint, tls = secure_endpoint(), tls_of(folder, "reader")
    file = write_config(folder, tmp_path / "router-secure.json5", endpoint, **FOR_ONE)
    with (
        open_router(config_file=file),
        nedbus.connect(endpoint, tls=tls),
        pytest.raises(nedbus.ConnectError, match="no room for more sessions"),
    ):
        nedbus.connect(endpoint, tls=tls, timeout=0.1)


@pytest.mark.parametrize(
    "answer", [b"", b"\x00", b"HTTP/1.0 400 Bad Request\r\n\r\n", b"\2\0\3\2", b"\4\0\1\t\xf2\xff", b"\xff" * 5000]
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
