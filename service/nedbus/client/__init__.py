"""The client API: connect to a router, subscribe, query last messages, publish; blocking and asyncio."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports
from nedbus.samples import Counts, Mode, Sample
from nedbus.transport import Publishers

from .discovery import (
    LogStreamStatus,
    PositionStatus,
    ServiceStatus,
    SourceStatus,
    StreamStatus,
    Vehicles,
    find_services,
    reply_parts,
)
from .health import (
    Health,
    Histogram,
    StreamHealth,
    StreamState,
    describe_stream,
    health_of_last,
    stream_state,
)
from .publishing.publisher import Publisher
from .publishing.publisher_registry import PublisherRegistry
from .publishing.query_server import QueryServer
from .publishing.writer import HEARTBEAT

if TYPE_CHECKING:
    from .async_bus import AsyncBus, AsyncPublisher, connect_async
    from .async_newest import AsyncNewest
    from .async_subscription import AsyncSubscription
    from .bus import Bus, connect
    from .link import LinkCallback
    from .newest import Monitor, Newest, NewestMessage
    from .rejections import RejectionReport, Rejections
    from .subscription import Subscription
else:  # lazy: few scripts and no command use asyncio, and a service receives nothing, which saves it 1 MB
    _NAMES = {
        "async_bus": "AsyncBus AsyncPublisher connect_async",
        "async_newest": "AsyncNewest",
        "async_subscription": "AsyncSubscription",
        "bus": "Bus connect",
        "link": "LinkCallback",
        "newest": "Monitor Newest NewestMessage",
        "rejections": "RejectionReport Rejections",
        "subscription": "Subscription",
    }
    __getattr__ = lazy_exports(
        __name__, {name: ("", module) for module, names in _NAMES.items() for name in names.split()}
    )
