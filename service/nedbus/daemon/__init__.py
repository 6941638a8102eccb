"""The service: a Daemon runs one Worker per source and replies to status queries."""

from .daemon import Daemon, plan_sources
from .output import TOO_MANY
from .worker import STATES, PlannedSource, SourceMeasures
