"""What `nedbus serve` shows on a terminal."""

from __future__ import annotations

import os
import pty
import re
import signal
import subprocess
import sys
import threading
from functools import partial
from pathlib import Path

import pytest

from nedbus.cli.progress import what_to_type
from nedbus.transport import DEFAULT_ENDPOINT
from tests.conftest import DEADLINE, Start, free_endpoint, free_port, wait_for
from tests.ulogs import write_log


def test_hint_needs_no_flag_that_it_lacks() -> None:
    """What can be pasted needs no certificate; where one is needed, that is said in one line."""
    assert " list  what" in what_to_type([DEFAULT_ENDPOINT])
    assert " hz -c tcp/b:1 " in what_to_type(["tls/a:1", "tcp/b:1"])
    for endpoint in ("tls/a:1", "quic/a:1"):
        hint = f"Readers at {endpoint} need a certificate of their own: docs/security.md"
        assert what_to_type([endpoint]) == hint


def test_hint_of_what_listens_on_all_addresses(run_nedbus: Start) -> None:
    """This host gets a command with loopback, other hosts one with an address of this host, and both work."""
    port = free_port()
    service = run_nedbus("serve", "--listen", f"tcp/0.0.0.0:{port}", "-s", "sim:")
    wait_for(lambda: "On another host" in service.err, what="the hint")
    here, elsewhere = re.findall(r"nedbus list -c (\S+)", service.err)
    assert here == f"tcp/127.0.0.1:{port}"
    assert not re.search(r"/(0\.0\.0\.0|127\.|localhost)", elsewhere)
    for endpoint in (here, elsewhere):
        listed = run_nedbus("get", "--wait", "-c", endpoint)
        assert listed.wait() == 0, listed.err
    assert " list  what" in what_to_type(["tcp/0.0.0.0:7447"])
    assert re.search(r"^  nedbus list -c tcp/\S+:7448$", what_to_type(["tcp/[::]:7448"]).splitlines()[-1])
    assert "On another host" not in what_to_type(["tcp/192.0.2.1:7447"])


@pytest.mark.process
def test_terminal_shows_progress_and_what_to_type(tmp_path: Path) -> None:
    """A bar for each source with its state and numbers, what went wrong, and the next commands with their endpoint."""
    path = write_log(tmp_path / "flight.ulg", range(0, 2_000_000, 10_000))
    endpoint = free_endpoint()
    sources = [f"--source=ulog:{path}", "--source=sim:?vehicle=2", "--source=ulog:/nowhere.ulg"]
    main, terminal = pty.openpty()
    command = [sys.executable, "-m", "nedbus", "serve", "-l", endpoint, *sources]
    environment = {**os.environ, "COLUMNS": "200", "TERM": "xterm"}
    service = subprocess.Popen(command, stderr=terminal, stdin=subprocess.DEVNULL, env=environment)
    os.close(terminal)
    shown = bytearray()

    def read() -> None:
        try:
            while chunk := os.read(main, 4096):
                shown.extend(chunk)
        except OSError:  # the other side is closed
            pass

    reader = threading.Thread(target=read)
    reader.start()
    try:
        for text in (
            f"nedbus list -c {endpoint}",
            "running",
            "retrying",
            "no such file",
            "200 of 200 messages",
            "done",
        ):
            wait_for(partial(shown.__contains__, text.encode()), what=text)
        service.send_signal(signal.SIGTERM)
        assert service.wait(DEADLINE) == 0
    finally:
        service.kill()
        service.wait(DEADLINE)
        reader.join(DEADLINE)
        os.close(main)
    assert b"Traceback" not in shown
