"""Zenoh transport: sessions, routers, TLS, queries, liveliness tokens, and the keys of rmw_zenoh."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

from .key_reader import KeyReader
from .liveliness import LivelinessTokens, token_keys
from .queries import Replies, query, send_query, wait_for_replies
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
    px4_publishers_key_expr,
)
from .router import (
    RouterConfig,
    RouterState,
    open_router,
    query_routers,
    read_router_config,
    router_endpoints,
)
from .session import (
    RawSample,
    Session,
    entity_name,
    is_forked,
    open_client,
    require_unforked,
    translate_error,
    translate_zenoh_errors,
)
from .tls import UNKNOWN_CA, Tls, check_pem, read_certificate
from .uplinks import Uplinks
from .vehicle_directory import Publishers, VehicleDirectory
from .write_probe import (
    CONFIRMED,
    WriteVerdict,
    is_refused,
    probe_at_router,
    probe_writes,
    routers_of,
    secure_endpoints,
)
from .zenoh_ext import (
    Heartbeats,
    RetransmitRequest,
    follow_heartbeats,
    heartbeat_key,
    heartbeat_payload,
)

if TYPE_CHECKING:
    from .access_control import AccessControl, AccessRule, Decision
else:
    __getattr__ = lazy_exports(
        "nedbus.transport",
        dict.fromkeys(("AccessControl", "AccessRule", "Decision"), ("", "access_control")),
    )
