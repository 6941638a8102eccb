"""The service: a Daemon runs a Worker for each source, and answers with its status."""

from .daemon import Daemon
from .status import STATES, ServiceStatus, SourceMeasures, SourceStatus, StreamStatus

__all__ = ["STATES", "Daemon", "ServiceStatus", "SourceMeasures", "SourceStatus", "StreamStatus"]
