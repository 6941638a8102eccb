"""The service: a Daemon runs one Worker per source, and answers queries for its status."""

from .daemon import Daemon
from .output import TOO_MANY
from .plan import Planned, plan_sources
from .worker import STATES, SourceMeasures
