"""The service of `nedbus serve`, to run in a program of your own: a Daemon publishes the sources of its settings.

daemon = Daemon(load_settings(source=["sim:"]), version="1.0")
threading.Thread(target=daemon.run).start()
...
daemon.stop()
"""

from .daemon import Daemon, plan_sources
from .worker import STATES, PlannedSource, SourceMeasures

__all__ = ["STATES", "Daemon", "PlannedSource", "SourceMeasures", "plan_sources"]
