"""Certificates for the secure stack, handed out as docs/security.md says, and sessions that show them."""

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
USER = f"{os.getuid() or 1000}:{os.getgid() or 1000}"  # of the containers: who may read the keys


def make_certificates(folder: Path, *names: str) -> None:
    """Make an authority in a new folder, with the certificates of a router and of these, and hand them out."""
    make_authority(folder)
    make_certificate(folder, "router", hosts=["router", "localhost", "127.0.0.1"])
    for name in names:
        make_certificate(folder, name)
    hand_out(folder)


def hand_out(folder: Path) -> None:
    """Copy to each container what it may see, with the documented loop; the first user of a host owns all of it."""
    loop = re.search(r"^for name in .*?^done$", (ROOT / "docs" / "security.md").read_text(), re.DOTALL | re.MULTILINE)
    assert loop is not None
    subprocess.run(["bash", "-e", "-c", loop[0].replace("pki/", f"{folder}/")], check=True, timeout=DEADLINE)
    if os.getuid() == 0:
        for path in (folder, *folder.rglob("*")):
            os.chown(path, 1000, 1000)


def join(stack: Stack, pki: Path, name: str | None, *, ca: str = "ca.crt", timeout: float = DEADLINE) -> nedbus.Bus:
    """Connect from the host, as somebody."""
    own, key = (None, None) if name is None else (pki / f"{name}.crt", pki / f"{name}.key")
    endpoint = f"tls/{stack.address}"
    return nedbus.connect(endpoint, tls=nedbus.Tls(pki / ca, own, key), timeout=timeout)
