"""Monitoring over HTTP: metrics, health, readiness and status."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

from .access import why_refused
from .http_server import HttpServer, Page
from .live_events import LinkLosses, LiveEvents
from .observer import Observer, Snapshot
from .pages import service_pages, why_not_ready

if TYPE_CHECKING:
    from .exporter import Exporter
else:
    __getattr__ = lazy_exports(__name__, {"Exporter": ("metrics", "exporter")})

__all__ = [
    "Exporter",
    "HttpServer",
    "Page",
    "Snapshot",
    "service_pages",
    "why_not_ready",
    "why_refused",
]
