"""Checks of the write permission that fail; the router's verdicts are tested with access rules in `transport/`."""

from __future__ import annotations

from types import SimpleNamespace
from typing import cast

import pytest

from nedbus.client import PublisherRegistry
from nedbus.daemon.write_permission import WritePermission, watch_permission
from nedbus.settings import Settings
from nedbus.timings import TIMINGS
from nedbus.transport import Session, Tls


class Panic(BaseException):
    """A panic in Zenoh, which is not an Exception."""


def test_only_services_with_a_certificate_are_checked() -> None:
    """A service without a client certificate, or without TLS, starts no checks."""
    for tls in (None, SimpleNamespace(certificate=None)):
        settings = cast("Settings", SimpleNamespace(connect=("tls/localhost:1",), tls=tls))
        assert watch_permission(cast("Session", None), settings, cast("PublisherRegistry", None)) is None


def test_unexpected_error_in_a_check_is_logged(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """An unexpected error in a check leaves the permission unknown, and the check is repeated."""
    permission = WritePermission(
        cast("Session", None), ["tls/localhost:1"], tls=cast("Tls", None), prefix="nedbus", vehicles=lambda: {"1"}
    )

    def fail(_: set[str]) -> None:
        raise Panic

    monkeypatch.setattr(permission, "_probe", fail)
    assert permission.check() == TIMINGS.probe_unsure
    assert permission.refused == {}
    assert [record.getMessage() for record in caplog.records] == ["unexpected error in a check of the write permission"]
