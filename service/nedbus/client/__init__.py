"""The client: connect to a router, subscribe, ask for last messages, publish; blocking and with asyncio."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

from .async_bus import AsyncBus
from .async_publisher import AsyncPublisher
from .async_subscription import AsyncSubscription
from .bus import Bus
from .connect import connect, connect_async, connect_with
from .health import Health, StreamHealth
from .histogram import Histogram
from .housekeeping import Housekeeping
from .monitor import Monitor
from .publishing.heartbeats import HEARTBEAT
from .publishing.publisher import Publisher
from .publishing.publisher_registry import PublisherRegistry
from .publishing.query_server import QueryServer
from .rate_gate import check_max_rate
from .rejections import RejectionReport, Rejections
from .sample import Counts, Mode, Sample
from .stream_state import StreamState, describe_stream, health_of_last, stream_state, to_age
from .subscription import Subscription

if TYPE_CHECKING:
    from .batch import Batch
else:
    __getattr__ = lazy_exports(__name__, {"Batch": ("", "batch")})  # NumPy takes longer to load than all the rest

__all__ = [
    "HEARTBEAT",
    "AsyncBus",
    "AsyncPublisher",
    "AsyncSubscription",
    "Batch",
    "Bus",
    "Counts",
    "Health",
    "Histogram",
    "Housekeeping",
    "Mode",
    "Monitor",
    "Publisher",
    "PublisherRegistry",
    "QueryServer",
    "RejectionReport",
    "Rejections",
    "Sample",
    "StreamHealth",
    "StreamState",
    "Subscription",
    "check_max_rate",
    "connect",
    "connect_async",
    "connect_with",
    "describe_stream",
    "health_of_last",
    "stream_state",
    "to_age",
]
