"""Receiving: from Zenoh's ring to the reader, with one account of what became of each message."""

from .decoder import Decoder
from .layout_lookup import LayoutLookup
from .pending_queue import PendingQueue
from .receiver import Receiver
from .thinned_queue import ThinnedQueue
from .thinned_receiver import ThinnedReceiver

__all__ = ["Decoder", "LayoutLookup", "PendingQueue", "Receiver", "ThinnedQueue", "ThinnedReceiver"]
