"""What a person asks when nothing arrives: checks of settings, routers, certificates, permissions, vehicles, clocks."""

from .examination import examine
from .finding import STATES, Finding, State, worst_state

__all__ = ["STATES", "Finding", "State", "examine", "worst_state"]
