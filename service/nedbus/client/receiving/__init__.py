"""The receiving side: from Zenoh's ring to the application, with every message counted."""

from .decoder import Decoder
from .downsampled import Downsampled
from .inbox import Inbox, check_count, check_timeout
from .layout_lookup import LayoutLookup, find_schemas, has_router
from .receiver import Receiver
from .throttle import Throttle
