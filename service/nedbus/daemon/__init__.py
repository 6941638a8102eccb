"""The service: a Daemon runs a Worker for each source, and answers with its status."""

from .check import check_router_file, check_service, describe_mistakes
from .daemon import Daemon
from .status import STATES, SourceMeasures

__all__ = [
    "STATES",
    "Daemon",
    "SourceMeasures",
    "check_router_file",
    "check_service",
    "describe_mistakes",
]
