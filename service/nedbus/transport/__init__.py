"""Zenoh itself: sessions, routers, TLS, queries, and the keys of rmw_zenoh."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

from .access_rules import CERTIFICATE_PREFIX, RulesChange, certificate_name, read_access_rules, write_access_rules
from .certificate import Certificate
from .endpoints import DEFAULT_ENDPOINT, check_endpoints, dial_endpoint, split_endpoint
from .queries import (
    MAX_ANSWERS,
    AliveChanges,
    Answers,
    alive_keys,
    ask,
    ask_alive,
    ask_alive_keys,
    query,
)
from .refusals import log_refusals
from .rmw_zenoh import (
    BRIDGED_ENCODING,
    LONGEST_TOKEN,
    NO_HASH,
    PX4_TYPES,
    Attachment,
    PublisherToken,
    TopicKey,
    gid_of_token,
    node_token,
    publisher_token,
    px4_publishers_key_expr,
    subscription_token,
)
from .router import RouterConfig, open_router, read_router_config, router_endpoints, router_max_sessions
from .router_state import RouterState, ask_routers
from .session import (
    LEASE,
    RawSample,
    Session,
    SourceInfo,
    entity_name,
    is_forked,
    open_client,
    require_unforked,
    translate_error,
    while_open,
)
from .tls import Tls, check_pem
from .uplink import UPLINK_POLL, Uplinks
from .write_probe import Verdict, probe_writes
from .zenoh_ext import (
    Heartbeats,
    KeptAnswers,
    ask_kept,
    follow_heartbeats,
    heartbeat_key,
    heartbeat_payload,
)

if TYPE_CHECKING:
    from .pki import CA_DAYS, DAYS, make_authority, make_certificate
    from .pki_bundle import TARGET, make_bundle
    from .pki_renewal import RENEW_WITHIN, CertificateEntry, list_certificates, renew_certificate
else:
    __getattr__ = lazy_exports(
        __name__,
        dict.fromkeys(("CA_DAYS", "DAYS", "make_authority", "make_certificate"), ("pki", "pki"))
        | dict.fromkeys(("TARGET", "make_bundle"), ("pki", "pki_bundle"))
        | dict.fromkeys(
            ("RENEW_WITHIN", "CertificateEntry", "list_certificates", "renew_certificate"), ("pki", "pki_renewal")
        ),
    )

__all__ = [
    "BRIDGED_ENCODING",
    "CA_DAYS",
    "CERTIFICATE_PREFIX",
    "DAYS",
    "DEFAULT_ENDPOINT",
    "LEASE",
    "LONGEST_TOKEN",
    "MAX_ANSWERS",
    "NO_HASH",
    "PX4_TYPES",
    "RENEW_WITHIN",
    "TARGET",
    "UPLINK_POLL",
    "AliveChanges",
    "Answers",
    "Attachment",
    "Certificate",
    "CertificateEntry",
    "Heartbeats",
    "KeptAnswers",
    "PublisherToken",
    "RawSample",
    "RouterConfig",
    "RouterState",
    "RulesChange",
    "Session",
    "SourceInfo",
    "Tls",
    "TopicKey",
    "Uplinks",
    "Verdict",
    "alive_keys",
    "ask",
    "ask_alive",
    "ask_alive_keys",
    "ask_kept",
    "ask_routers",
    "certificate_name",
    "check_endpoints",
    "check_pem",
    "dial_endpoint",
    "entity_name",
    "follow_heartbeats",
    "gid_of_token",
    "heartbeat_key",
    "heartbeat_payload",
    "is_forked",
    "list_certificates",
    "log_refusals",
    "make_authority",
    "make_bundle",
    "make_certificate",
    "node_token",
    "open_client",
    "open_router",
    "probe_writes",
    "publisher_token",
    "px4_publishers_key_expr",
    "query",
    "read_access_rules",
    "read_router_config",
    "renew_certificate",
    "require_unforked",
    "router_endpoints",
    "router_max_sessions",
    "split_endpoint",
    "subscription_token",
    "translate_error",
    "while_open",
    "write_access_rules",
]
