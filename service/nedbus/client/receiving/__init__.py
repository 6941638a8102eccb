"""The receiving side: from Zenoh's ring to the application, with every message counted."""

from .decoder import Decoder
from .layout_lookup import LayoutLookup, find_schemas
from .max_rate import MaxRateQueue, MaxRateReceiver
from .pending_queue import PendingQueue
from .receiver import Receiver
