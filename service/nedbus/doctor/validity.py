"""The certificates that are used: valid, expiring, expired; and this client's own files."""

from __future__ import annotations

import datetime as dt
from collections.abc import Iterator
from typing import Final

from nedbus.errors import ConfigError
from nedbus.pki import Certificate
from nedbus.transport import Tls

from .finding import Finding, brief

_RENEW: Final = "renew it: 'nedbus pki', docs/security.md"


def explain_unread(check: str, subject: str, error: Exception) -> Finding:
    """Return why a certificate cannot be read: it is damaged, or the package that reads it is missing."""
    if isinstance(error, ConfigError):
        return Finding(check, subject, "unknown", "whose certificate it is, and until when, is not read", error.reason)
    return Finding(check, subject, "unknown", f"cannot be read as a certificate: {error}")


def judge_validity(check: str, subject: str, whose: str, certificate: Certificate, now: dt.datetime) -> Finding:
    """Return whether a certificate is valid now, and for how long."""
    days = certificate.days_left(now)
    seen = f"{whose} {brief(certificate.subject)}"
    if days < 0:
        until = f"{certificate.ends:%Y-%m-%d %H:%M} UTC"
        return Finding(check, subject, "wrong", f"{seen}, which has expired: it was valid until {until}", _RENEW)
    if now < certificate.begins:
        advice = f"is the clock of this host right? it says {now:%Y-%m-%d %H:%M} UTC"
        return Finding(check, subject, "wrong", f"{seen}, which is not valid yet", advice)
    seen = f"{whose} {brief(certificate)}"
    if certificate.is_due(now):
        return Finding(check, subject, "warning", f"{seen}, {days:.0f} days from now", _RENEW)
    return Finding(check, subject, "ok", seen)


def check_own_files(tls: Tls) -> Iterator[Finding]:
    """Yield what is found of the files that this client is given: readable, a pair, valid, of one authority."""
    try:
        tls.zenoh_settings()
    except ConfigError as exc:
        yield Finding("certificate", "", "wrong", exc.reason)
        return
    now = dt.datetime.now(dt.UTC)
    for path, whose in ((tls.ca, "the authority is"), (tls.certificate, "this client is")):
        if path is None:
            continue
        try:
            yield judge_validity("certificate", str(path), whose, Certificate.read(path), now)
        except (ValueError, OSError) as exc:
            yield explain_unread("certificate", str(path), exc)
    reason = tls.explain()
    if reason is not None and "expired" not in reason:
        advice = "give a certificate that the same authority has signed as the router's"
        yield Finding("certificate", str(tls.certificate or tls.ca), "wrong", reason, advice)
