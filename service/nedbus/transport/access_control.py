"""Access control of a router, evaluated from its configuration: which rule decides about a key of a certificate."""

from collections import defaultdict
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Final, Literal

import zenoh

Flow = Literal["ingress", "egress"]
_BOTH_FLOWS: Final = ("ingress", "egress")


@dataclass(frozen=True, slots=True)
class Decision:
    """What a router does with a message.

    `rules`: the rule that allows it, or that denies it explicitly; without such a rule, all rules of the certificate
    for this kind of message, none of which includes the key.
    """

    is_allowed: bool
    rules: tuple[str, ...] = ()
    is_default: bool = False

    def __str__(self) -> str:
        if not self.is_default:
            verb = "denies"
            if self.is_allowed:
                verb = "allows"
            return f"rule {self.rules[0]} {verb} it"
        if self.is_allowed:
            return "no rule denies it"
        if not self.rules:
            return "no rule is for such messages of this certificate"
        names = ", ".join(self.rules)
        return f"none of its rules includes this key: {names}"


@dataclass(frozen=True, slots=True)
class AccessRule:
    """One rule: kinds of messages, directions, and the key expressions whose keys it includes."""

    name: str
    is_allowed: bool
    flows: tuple[str, ...]
    messages: tuple[str, ...]
    key_exprs: tuple[zenoh.KeyExpr, ...]

    def is_for(self, message: str, flow: Flow) -> bool:
        """Return whether the rule is for this kind of message in this direction."""
        return message in self.messages and flow in self.flows

    def includes(self, key: zenoh.KeyExpr) -> bool:
        """Return whether one of the key expressions includes all keys of `key`, as Zenoh requires for a rule."""
        return any(own.includes(key) for own in self.key_exprs)


class AccessControl:
    """The rules of a router, and the certificates to which they apply.

    Subjects are compared by the common name of the certificate only: a subject that also requires an interface, a user
    name or a protocol counts as matched.
    """

    def __init__(
        self, section: Mapping[str, Any], filters: Iterable[Mapping[str, Any]] = ()
    ) -> None:
        """Parse `access_control` and `low_pass_filter` of a configuration that Zenoh has accepted."""
        self.is_enabled: bool = section["enabled"]
        self._is_allowed_by_default = section["default_permission"] == "allow"
        # A limit of sizes has messages, flows and key expressions like a rule.
        self._size_limits = [_parse_rule(limit) for limit in filters]
        parsed = [_parse_rule(rule) for rule in section["rules"] or ()]
        rules = {rule.name: rule for rule in parsed}
        self._rules = defaultdict[str, list[AccessRule]](list)  # by subject
        for policy in section["policies"] or ():
            own = [rules[name] for name in policy["rules"] if name in rules]
            for subject in policy["subjects"]:
                self._rules[subject] += own
        self._common: list[str] = []  # subjects of every certificate
        self._subjects = defaultdict[str, list[str]](list)  # of one, by its common name
        for subject in section["subjects"] or ():
            name = subject["id"]
            certificates = subject["cert_common_names"]
            if not certificates:
                self._common.append(name)
                continue
            for certificate in certificates:
                self._subjects[certificate].append(name)

    @property
    def certificates(self) -> list[str]:
        """The common names in the configuration, in its order."""
        return list(self._subjects)

    def rules_of(self, certificate: str) -> list[AccessRule]:
        """Return the rules that apply to the certificate with this common name."""
        rules: list[AccessRule] = []
        own = self._subjects.get(certificate, ())
        for subject in (*self._common, *own):
            rules += self._rules.get(subject, ())
        return rules

    def decide(self, certificate: str, message: str, flow: Flow, key: str) -> Decision:
        """Return what the router does with a message of a certificate: `message` and `flow` as in its rules.

        As in Zenoh, an explicit denial takes precedence; if no rule includes the key, the default permission applies.
        """
        if not self.is_enabled:
            return Decision(is_allowed=True, is_default=True)
        wanted = zenoh.KeyExpr(key)
        own = self.rules_of(certificate)
        rules = [rule for rule in own if rule.is_for(message, flow)]
        including = [rule for rule in rules if rule.includes(wanted)]
        if not including:
            names = [rule.name for rule in rules]
            return Decision(self._is_allowed_by_default, tuple(names), is_default=True)
        deciding = min(including, key=lambda rule: rule.is_allowed)
        return Decision(deciding.is_allowed, (deciding.name,))

    def limits_size(self, key: str) -> bool:
        """Return whether the router limits the size of messages that clients put on this key."""
        wanted = zenoh.KeyExpr(key)
        of_puts = [limit for limit in self._size_limits if limit.is_for("put", "ingress")]
        return any(limit.includes(wanted) for limit in of_puts)


def _parse_rule(rule: Mapping[str, Any]) -> AccessRule:
    return AccessRule(
        name=rule["id"],
        is_allowed=rule.get("permission") == "allow",
        flows=tuple(rule["flows"] or _BOTH_FLOWS),
        messages=tuple(rule["messages"]),
        key_exprs=tuple(map(zenoh.KeyExpr, rule["key_exprs"])),
    )
