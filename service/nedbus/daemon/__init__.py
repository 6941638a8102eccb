"""The service: a Daemon runs a Worker for each source, and answers with its status."""

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
