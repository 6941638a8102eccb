"""Zenoh itself: sessions, routers, TLS, queries, and the keys of rmw_zenoh."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

from .endpoints import DEFAULT_ENDPOINT, check_endpoints, dial_endpoint
from .queries import alive_keys, ask_all, query
from .rmw_zenoh import (
    NO_HASH,
    Attachment,
    TopicKey,
    is_nedbus_gid,
    make_gid,
    node_token,
    publisher_token,
    publishers_key_expr,
)
from .router import open_router, router_endpoints
from .session import RawSample, Session, open_client, translate_error, while_open
from .tls import Tls

if TYPE_CHECKING:
    from .pki import CA_DAYS, DAYS, make_authority, make_certificate
else:
    __getattr__ = lazy_exports(
        __name__, dict.fromkeys(("CA_DAYS", "DAYS", "make_authority", "make_certificate"), ("pki", "pki"))
    )

__all__ = [
    "CA_DAYS",
    "DAYS",
    "DEFAULT_ENDPOINT",
    "NO_HASH",
    "Attachment",
    "RawSample",
    "Session",
    "Tls",
    "TopicKey",
    "alive_keys",
    "ask_all",
    "check_endpoints",
    "dial_endpoint",
    "is_nedbus_gid",
    "make_authority",
    "make_certificate",
    "make_gid",
    "node_token",
    "open_client",
    "open_router",
    "publisher_token",
    "publishers_key_expr",
    "query",
    "router_endpoints",
    "translate_error",
    "while_open",
]
