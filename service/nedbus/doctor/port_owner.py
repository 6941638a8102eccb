"""Which process of this host has a UDP port open, as far as /proc tells this user."""

from __future__ import annotations

from contextlib import suppress
from pathlib import Path
from typing import Final

_PROC: Final = Path("/proc")


def udp_port_owner(port: int) -> str:
    """Return the process that has a UDP port, as `name (pid 7)`; "" if that cannot be told."""
    inodes = {f"socket:[{inode}]" for table in ("udp", "udp6") for inode in _inodes(_PROC / "net" / table, port)}
    if not inodes:
        return ""
    for process in _PROC.iterdir():
        if not process.name.isdecimal():
            continue
        with suppress(OSError):  # of another user, or gone
            if any(_target(link) in inodes for link in (process / "fd").iterdir()):
                words = (process / "cmdline").read_bytes().split(b"\0")
                name = " ".join(word.decode("utf-8", "replace") for word in words[:4] if word)
                return f"{name[:80]} (pid {process.name})"
    return ""


def _inodes(table: Path, port: int) -> list[str]:
    """Return the inodes of the sockets on a port, of a table with one socket on each line but the first."""
    found = []
    with suppress(OSError):
        for line in table.read_text().splitlines()[1:]:
            columns = line.split()
            if int(columns[1].rpartition(":")[2], 16) == port:
                found.append(columns[9])
    return found


def _target(link: Path) -> str:
    with suppress(OSError):  # closed meanwhile
        return str(link.readlink())
    return ""
