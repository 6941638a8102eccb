"""Time: the order of messages, the axis of a flight, and the pace of a replay; no I/O."""

from .arrivals import arrivals
from .axis import Axis
from .order import Order
from .pace import MAX_PAUSE, Pace
