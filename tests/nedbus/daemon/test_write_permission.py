"""The services that check their write permission; the checks are tested with access rules in `transport/`."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

from nedbus.client import PublisherRegistry
from nedbus.daemon.write_permission import watch_permission
from nedbus.settings import Settings
from nedbus.transport import Session


def test_only_services_with_a_certificate_are_checked() -> None:
    """A service without a client certificate, or without TLS, starts no checks."""
    for tls in (None, SimpleNamespace(certificate=None)):
        settings = cast("Settings", SimpleNamespace(connect=("tls/localhost:1",), tls=tls))
        assert (
            watch_permission(cast("Session", None), settings, cast("PublisherRegistry", None))
            is None
        )
