"""Liveliness tokens: when the list is complete."""

from types import SimpleNamespace

import pytest

from nedbus.transport import LivelinessTokens, Session, liveliness

KEY = "nedbus/7/@alive/1a/vehicle_attitude"


def test_failed_probe_is_repeated(zenoh_session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    """Until a probe succeeds, the list is incomplete, and a token that was not listed again does not count as gone."""
    probes = [
        SimpleNamespace(ended=True, failed=True, poll=list),
        SimpleNamespace(ended=False, failed=False, poll=list),
    ]
    later = probes[1]
    monkeypatch.setattr(liveliness, "query_tokens", lambda *_, **__: probes.pop(0))
    tokens = LivelinessTokens(zenoh_session, "nedbus/*/@alive/**", known=[KEY])
    for _ in range(2):
        assert tokens.poll() == []
        assert tokens.is_listing
        assert not tokens.complete
    later.ended = True
    assert tokens.poll() == [(KEY, False)]
    assert tokens.complete
    tokens.undeclare()
