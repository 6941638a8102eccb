"""Certificates of a small fleet, made once per pytest process, and configurations of secure routers."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import pytest

import nedbus
from nedbus.pki import make_authority, make_certificate
from tests.peers.ports import free_endpoint

CONFIG: Final = Path(__file__).parents[2] / "config"
"""Folder of the shipped router configurations."""


@pytest.fixture(scope="session")
def pki(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a folder of valid and invalid certificates with their keys, which tests must not change."""
    folder = tmp_path_factory.getbasetemp() / "pki"
    if folder.is_dir():  # made for another test module
        return folder
    make_authority(folder)
    for name in ("router", "router-2"):
        make_certificate(folder, name, hosts=["127.0.0.1", "localhost"])
    make_certificate(folder, "router-elsewhere", hosts=["gcs.local", "10.0.0.7"])
    for name, days in (("router-expired", -1), ("router-soon", 10)):
        make_certificate(folder, name, hosts=["127.0.0.1"], days=days)
    for name in ("1", "2", "99", "200", "mocap"):
        make_certificate(folder, f"vehicle-{name}")
    for name in ("reader", "operator", "stranger"):
        make_certificate(folder, name)
    make_certificate(folder, "expired", days=-1)
    make_authority(folder / "foreign")
    make_certificate(folder / "foreign", "reader")
    return folder


def secure_endpoint() -> str:
    return free_endpoint().replace("tcp/", "tls/")


def write_config(pki: Path, file: Path, endpoint: str, **replaced: str) -> Path:
    """Copy the shipped configuration named like `file`, with another endpoint and other replacements."""
    text = (CONFIG / file.name).read_text()
    changes = {
        "/etc/nedbus/pki": str(pki),
        "tcp/0.0.0.0:7447": endpoint,
        "tls/0.0.0.0:7447": endpoint,
    } | replaced
    for old, new in changes.items():
        text = text.replace(old, new)
    file.write_text(text)
    return file


def tls_settings(pki: Path, name: str | None, ca: str = "ca.crt") -> dict[str, Path]:
    """Return the TLS settings of a client with the certificate `name`; None: without a certificate."""
    own = (
        {}
        if name is None
        else {"tls_certificate": pki / f"{name}.crt", "tls_key": pki / f"{name}.key"}
    )
    return {"tls_ca": pki / ca, **own}


def client_tls(pki: Path, name: str | None, ca: str = "ca.crt") -> nedbus.Tls:
    """Return the TLS settings of `tls_settings` for a script."""
    return nedbus.Tls(*tls_settings(pki, name, ca).values())


def tls_options(pki: Path, name: str | None) -> list[str]:
    """Return the TLS settings of `tls_settings` as command-line options."""
    return [
        f"--{setting.replace('_', '-')}={path}" for setting, path in tls_settings(pki, name).items()
    ]
