"""Eclipse's zenohd for tests, unpacked once from ../shared/bin if that folder exists."""

from __future__ import annotations

import hashlib
import os
import tarfile
import tempfile
from functools import cache
from pathlib import Path

import pytest

from tests.peers.processes import Process, Start

ROOT = Path(__file__).parents[2]
ARCHIVE = ROOT.parent / "shared" / "bin" / "zenohd-1.10.2.tar.xz"
# `start` starts Python; this script replaces it with another program.
EXEC_SCRIPT = "import os, sys; os.execv(sys.argv[1], sys.argv[1:])"
ROUTER_KINDS = ("nedbus", pytest.param("zenohd", marks=(pytest.mark.slow, pytest.mark.process)))
"""Parameters of a fixture that runs a router: nedbus, and zenohd in the slow tests."""


@cache
def zenohd_path() -> Path:
    """Return the path of zenohd, with its plugins in ../lib; skip the test if the archive is missing."""
    if not ARCHIVE.is_file():
        pytest.skip(f"no zenohd: {ARCHIVE} does not exist")
    unpacked = ROOT / "build" / f"zenohd-{hashlib.sha256(ARCHIVE.read_bytes()).hexdigest()[:12]}"
    if not unpacked.is_dir():
        unpacked.parent.mkdir(exist_ok=True)
        with (
            tempfile.TemporaryDirectory(dir=unpacked.parent) as folder,
            tarfile.open(ARCHIVE) as archive,
        ):
            # missing in Debian's Python 3.11.2
            archive.extraction_filter = getattr(tarfile, "data_filter", None)
            for member in archive:
                archive.extract(member, folder)
            try:
                Path(folder, "zenohd").rename(unpacked)
            except OSError:  # another test process unpacked it first
                assert unpacked.is_dir()
    return unpacked / "bin" / "zenohd"


def start_zenohd(start: Start, *arguments: str, **environment: str) -> Process:
    """Start zenohd with these arguments; the fixture `start` kills it at the end of the test."""
    path = zenohd_path()
    plugins = f"--plugin-search-dir={path.parents[1] / 'lib'}"
    settings = {"NO_COLOR": "1", "RUST_LOG": "info"} | environment
    return start("-c", EXEC_SCRIPT, os.fspath(path), plugins, *arguments, **settings)
