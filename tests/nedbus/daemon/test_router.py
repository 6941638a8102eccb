"""A router in a program: `run_router` serves clients until it is stopped; the command's tests are in cli/."""

from __future__ import annotations

import logging
import threading

import pytest

import nedbus
from nedbus.daemon import run_router
from tests.peers.ports import free_endpoint
from tests.waits import DEADLINE


@pytest.mark.router
def test_router_in_a_program_serves_clients_until_it_is_stopped(
    caplog: pytest.LogCaptureFixture,
) -> None:
    """Clients connect to its endpoint, which is logged; `closing` is set before the session is closed."""
    caplog.set_level(logging.INFO)
    endpoint, stop, closing = free_endpoint(), threading.Event(), threading.Event()
    options = {"listen": (endpoint,), "closing": closing}
    thread = threading.Thread(target=run_router, args=(stop,), kwargs=options)
    thread.start()
    try:
        with nedbus.connect(endpoint, timeout=DEADLINE) as bus:
            assert bus.connected
        assert f"router on {endpoint}" in caplog.text
        assert not closing.is_set()
    finally:
        stop.set()
        thread.join(DEADLINE)
    assert closing.is_set()
    assert not thread.is_alive()
