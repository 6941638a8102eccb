"""The service: a Daemon runs a Worker for each source, and answers with its status."""

from .daemon import Daemon
from .status import ServiceStatus, SourceStatus, StreamStatus

__all__ = ["Daemon", "ServiceStatus", "SourceStatus", "StreamStatus"]
