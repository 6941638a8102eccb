"""The client API: connect to a router, subscribe, query last messages, publish; blocking and asyncio."""

from nedbus.events import format_duration
from nedbus.samples import Counts, Mode, Sample
from nedbus.transport import Publishers

from .async_bus import AsyncBus, AsyncPublisher, connect_async
from .bus import Bus, connect
from .discovery import (
    LogStreamStatus,
    RejectionReport,
    Rejections,
    ServiceStatus,
    SourceStatus,
    StreamStatus,
    Vehicles,
    find_services,
    reply_parts,
)
from .health import Health, Histogram, StreamHealth, StreamState, describe_stream, health_of_last, stream_state
from .newest import AsyncNewest, Monitor, Newest, NewestMessage
from .publishing.publisher import Publisher
from .publishing.publisher_registry import PublisherRegistry
from .publishing.query_server import QueryServer
from .publishing.writer import HEARTBEAT
from .rate_gate import check_max_rate
from .subscription import AsyncSubscription, Subscription
