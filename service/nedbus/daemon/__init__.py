"""The service: a Daemon runs one Worker per source, and answers queries for its status."""

from .daemon import Daemon
from .plan import Planned, plan_sources
from .worker import STATES, SourceMeasures

__all__ = [
    "STATES",
    "Daemon",
    "Planned",
    "SourceMeasures",
    "plan_sources",
]
