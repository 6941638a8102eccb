"""`nedbus doctor`: checks of settings, routers, certificates, permissions, vehicles and clocks."""

from .configuration import check_router_file, check_service
from .examination import examine
from .finding import Finding, State, worst_state

__all__ = ["Finding", "State", "check_router_file", "check_service", "examine", "worst_state"]
