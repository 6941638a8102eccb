"""Zenoh itself: sessions, routers, TLS, queries, and the keys of rmw_zenoh."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

from .endpoints import DEFAULT_ENDPOINT, check_endpoints, dial_endpoint
from .queries import MAX_ANSWERS, alive_keys, ask_alive_keys, follow_alive_keys, query, query_kept
from .rmw_zenoh import (
    BRIDGED_ENCODING,
    NO_HASH,
    Attachment,
    PublisherToken,
    TopicKey,
    gid_of_token,
    node_token,
    publisher_token,
    publishers_key_expr,
    publishers_of_type_key_expr,
    subscription_token,
)
from .router import open_router, router_endpoints
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
from .tls import Tls
from .uplink import UPLINK_POLL, Uplinks

if TYPE_CHECKING:
    from .pki import CA_DAYS, DAYS, make_authority, make_certificate
else:
    __getattr__ = lazy_exports(
        __name__, dict.fromkeys(("CA_DAYS", "DAYS", "make_authority", "make_certificate"), ("pki", "pki"))
    )

__all__ = [
    "BRIDGED_ENCODING",
    "CA_DAYS",
    "DAYS",
    "DEFAULT_ENDPOINT",
    "LEASE",
    "MAX_ANSWERS",
    "NO_HASH",
    "UPLINK_POLL",
    "Attachment",
    "PublisherToken",
    "RawSample",
    "Session",
    "SourceInfo",
    "Tls",
    "TopicKey",
    "Uplinks",
    "alive_keys",
    "ask_alive_keys",
    "check_endpoints",
    "dial_endpoint",
    "entity_name",
    "follow_alive_keys",
    "gid_of_token",
    "is_forked",
    "make_authority",
    "make_certificate",
    "node_token",
    "open_client",
    "open_router",
    "publisher_token",
    "publishers_key_expr",
    "publishers_of_type_key_expr",
    "query",
    "query_kept",
    "require_unforked",
    "router_endpoints",
    "subscription_token",
    "translate_error",
    "while_open",
]
