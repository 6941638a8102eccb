"""The service: a Daemon runs one Worker per source, and answers queries for its status."""

from .daemon import Daemon, plan_sources
from .output import TOO_MANY
from .worker import STATES, Planned, SourceMeasures
