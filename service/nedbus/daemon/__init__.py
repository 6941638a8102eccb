"""The service of `nedbus serve`, to run in a program of your own: a Daemon publishes the sources of its settings.

daemon = Daemon(load_settings(source=["sim:"]), version="1.0")
threading.Thread(target=daemon.run).start()
...
daemon.stop()
"""

from .daemon import SOURCE_FORMS, Daemon, plan_sources
from .router import run_router
from .worker import STATES, PlannedSource, SourceMeasures

__all__ = [
    "SOURCE_FORMS", "STATES", "Daemon", "PlannedSource", "SourceMeasures", "plan_sources", "run_router",
]  # fmt: skip
