"""Checks of a router's access rules: who may report about a vehicle, and which rule denies a key to a certificate."""

import re
from collections import defaultdict
from collections.abc import Iterator
from typing import Final, NamedTuple

from nedbus.health import WriteVerdict
from nedbus.pki import AccessControl
from nedbus_msgs import ANY, DEFAULT_TOPIC, all_status_keys, status_key

from .finding import Finding

_OF_VEHICLE: Final = re.compile(r"(?P<prefix>[^*@]+)/(?P<vehicle>[^/*@]+)/\*\*")
_NAMED: Final = 3  # certificates in one mistake; there may be thousands
_COMMON: Final = (
    "write @service/**/status instead of @service/*/status in the common rules, as in config/router-secure.json5, then"
    " run 'nedbus pki rules' with --add for its vehicles, and restart the router"
)
_FILTER: Final = "copy low_pass_filter from config/router-secure.json5, and restart the router"
_OWN_KEYS: Final = (
    ("put", "{prefix}/{vehicle}/{topic}", "publish"),
    ("put", "{prefix}/{vehicle}/{topic}/@adv/pub/1a/1/_", "publish heartbeats of"),
    ("put", "{prefix}/@rejected/{vehicle}/{topic}", "report rejections of"),
    ("reply", "{prefix}/@service/{vehicle}/1a/status", "report about"),
    ("reply", "{prefix}/@schema/{vehicle}/Name", "define messages of"),
    ("liveliness_token", "{prefix}/{vehicle}/@alive/1a/{topic}", "announce"),
)
"""What only the certificate of a vehicle may do: kind of message, key, verb."""


class RuleMistake(NamedTuple):
    """A mistake in access rules: the text, and the name of a certificate where it is in the file."""

    certificate: str
    reason: str


class _Permission(NamedTuple):
    """A certificate that may publish a vehicle."""

    certificate: str
    prefix: str
    vehicle: str


def find_rule_mistakes(access: AccessControl) -> list[RuleMistake]:
    """Return what the rules of a fleet hide, and what they let the certificate of one vehicle say of another.

    Nothing is known of rules that name no vehicle as `nedbus pki rules` does.
    """
    if not access.is_enabled:
        return []
    certificates = defaultdict[str, list[str]](list)  # by mistake
    examples = dict[str, _Permission]()  # the first permission of each prefix
    for permission in _permissions(access):
        examples.setdefault(permission.prefix, permission)
        for reason in _mistakes_of_vehicle(access, permission):
            certificates[reason].append(permission.certificate)
    for example in examples.values():
        for reason, certificate in _mistakes_of_prefix(access, example):
            certificates[reason].append(certificate)
    return [
        RuleMistake(names[0], f"{_list_certificates(names)} {reason}")
        for reason, names in certificates.items()
    ]


def _mistakes_of_prefix(access: AccessControl, example: _Permission) -> Iterator[tuple[str, str]]:
    """Yield mistakes of the rules common to all vehicles of a prefix, each with a certificate that has it."""
    for certificate in access.certificates:
        reads = _reads(access, certificate, example.prefix)
        if reads and not _reads_status(access, certificate, example):
            yield f"may read messages, but not the status of services: {_COMMON}", certificate
    rejections = f"{example.prefix}/@rejected/{example.vehicle}/{DEFAULT_TOPIC}"
    for key in (rejections, _heartbeat_key(example)):
        if not access.limits_size(key):
            reason = f"may put messages of any size on {key}, which fill the memory of readers: {_FILTER}"
            yield reason, example.certificate


def _permissions(access: AccessControl) -> Iterator[_Permission]:
    """Yield the vehicles that each certificate may publish."""
    for certificate in access.certificates:
        permissions = dict[_Permission, None]()  # in order, each once
        for rule in access.rules_of(certificate):
            if not rule.is_allowed or not rule.is_for("put", "ingress"):
                continue
            for key_expr in rule.key_exprs:
                vehicle = _OF_VEHICLE.fullmatch(str(key_expr))
                if vehicle is not None:
                    name = vehicle["vehicle"]
                    permissions[_Permission(certificate, vehicle["prefix"], name)] = None
        yield from permissions


def _mistakes_of_vehicle(access: AccessControl, permission: _Permission) -> Iterator[str]:
    certificate, prefix, vehicle = permission
    own_status = status_key("1a", vehicle=vehicle, prefix=prefix)
    may_report = access.decide(certificate, "reply", "ingress", own_status).is_allowed
    all_keys = all_status_keys(prefix=prefix)
    is_asked = access.decide(certificate, "query", "egress", all_keys).is_allowed
    if not (may_report and is_asked):
        yield (
            "may publish a vehicle, but not report about it under a key that names the vehicle; one vehicle can speak"
            f" for another under a key that does not: {_COMMON}"
        )
    other = f"{vehicle}-other"  # which no rule names
    allowed = list[str]()
    for message, pattern, verb in _OWN_KEYS:
        key = pattern.format(prefix=prefix, vehicle=other, topic=DEFAULT_TOPIC)
        if access.decide(certificate, message, "ingress", key).is_allowed:
            allowed.append(verb)
    if allowed and len(allowed) < len(_OWN_KEYS):  # one that may do everything is a router
        verbs = " and ".join(dict.fromkeys(allowed))
        yield f"may {verbs} every vehicle, not only its own: name the vehicle in the keys of its rule"


def _heartbeat_key(permission: _Permission) -> str:
    return f"{permission.prefix}/{permission.vehicle}/{DEFAULT_TOPIC}/@adv/pub/1a/1/_"


def _reads(access: AccessControl, certificate: str, prefix: str) -> bool:
    return access.decide(certificate, "declare_subscriber", "ingress", f"{prefix}/**").is_allowed


def _reads_status(access: AccessControl, certificate: str, example: _Permission) -> bool:
    asks = access.decide(certificate, "query", "ingress", all_status_keys(prefix=example.prefix))
    status = status_key("1a", vehicle=example.vehicle, prefix=example.prefix)
    return asks.is_allowed and access.decide(certificate, "reply", "egress", status).is_allowed


def _list_certificates(names: list[str]) -> str:
    if len(names) == 1:
        return f"certificate {names[0]}"
    text = f"certificates {', '.join(names[:_NAMED])}"
    others = len(names) - _NAMED
    if others > 0:
        return f"{text} and {others} more"
    return text


def explain_permissions(
    access: AccessControl,
    certificate: str,
    *,
    vehicle: str | None,
    prefix: str,
    verdict: WriteVerdict | None,
) -> Iterator[Finding]:
    """Yield which rule decides about the messages of a client: those of a vehicle, if given, else of a reader.

    `verdict`: whether the router lets it publish the vehicle.
    """
    if vehicle is None:
        yield _explain(access, certificate, "declare_subscriber", f"{prefix}/{ANY}/{DEFAULT_TOPIC}")
        yield _explain(access, certificate, "query", all_status_keys(prefix=prefix))
        return
    for message, pattern, _ in _OWN_KEYS:
        key = pattern.format(prefix=prefix, vehicle=vehicle, topic=DEFAULT_TOPIC)
        yield _explain(access, certificate, message, key)
    key = f"{prefix}/{vehicle}/{DEFAULT_TOPIC}"
    is_allowed = access.decide(certificate, "put", "ingress", key).is_allowed
    expected = "allowed" if is_allowed else "denied"
    if verdict not in (None, "unknown", expected):
        seen = f"a probe of vehicle {vehicle} was {verdict}, against this file"
        advice = "the router reads its rules only at startup: restart it"
        yield Finding("rules", certificate, "warning", seen, advice)


def _explain(access: AccessControl, certificate: str, message: str, key: str) -> Finding:
    decision = access.decide(certificate, message, "ingress", key)
    if decision.is_allowed:
        return Finding("rules", certificate, "ok", f"{message} on {key} is allowed: {decision}")
    advice = (
        "needed only to publish this vehicle, or to read: use its certificate, "
        "or add a rule with 'nedbus pki rules'"
    )
    return Finding(
        "rules", certificate, "warning", f"{message} on {key} is denied: {decision}", advice
    )
