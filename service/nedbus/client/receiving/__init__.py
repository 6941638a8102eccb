"""Receiving: from Zenoh's ring to the reader, with one account of what became of each message."""

from .decoder import Decoder
from .layout_lookup import LayoutLookup
from .max_rate import MaxRateQueue, MaxRateReceiver
from .pending_queue import PendingQueue
from .receiver import Receiver

__all__ = ["Decoder", "LayoutLookup", "MaxRateQueue", "MaxRateReceiver", "PendingQueue", "Receiver"]
