"""Certificates of the secure stack, distributed with the commands of docs/security.md, and sessions that use them."""

from __future__ import annotations

import os
import re
import subprocess
from pathlib import Path

import nedbus
from nedbus.pki import make_authority, make_certificate
from tests.waits import DEADLINE

from .stack import ROOT, Stack

FILES = ("docker-compose.yml", "docker-compose.secure.yml")
# user of the containers, who must own the keys
USER = f"{os.getuid() or 1000}:{os.getgid() or 1000}"


def make_certificates(folder: Path, *names: str) -> None:
    """Make an authority, a router certificate and the named certificates in a new folder, and distribute them."""
    make_authority(folder)
    make_certificate(folder, "router", hosts=["router", "localhost", "127.0.0.1"])
    for name in names:
        make_certificate(folder, name)
    distribute(folder)


def distribute(folder: Path) -> None:
    """Copy the files of each container to its folder with the documented loop; if run as root, chown to uid 1000."""
    loop = re.search(
        r"^for name in .*?^done$",
        (ROOT / "docs" / "security.md").read_text(),
        re.DOTALL | re.MULTILINE,
    )
    assert loop is not None
    subprocess.run(
        ["bash", "-e", "-c", loop[0].replace("pki/", f"{folder}/")], check=True, timeout=DEADLINE
    )
    if os.getuid() == 0:
        for path in (folder, *folder.rglob("*")):
            os.chown(path, 1000, 1000)


def join(
    stack: Stack, pki: Path, name: str | None, *, ca: str = "ca.crt", timeout: float = DEADLINE
) -> nedbus.Bus:
    """Connect from the host with the certificate `name`; None: without a certificate."""
    own, key = (None, None) if name is None else (pki / f"{name}.crt", pki / f"{name}.key")
    endpoint = f"tls/{stack.address}"
    return nedbus.connect(endpoint, tls=nedbus.Tls(pki / ca, own, key), timeout=timeout)
