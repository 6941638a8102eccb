"""Monitoring over HTTP: metrics, health, readiness and status."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

from .access import why_refused
from .readiness import why_not_ready

if TYPE_CHECKING:
    from .exporter import Exporter
    from .http_server import HttpServer, Page
    from .live_events import LinkLosses, LiveEvents
    from .observer import Observer, Snapshot
    from .pages import service_pages
else:
    # The HTTP server of the standard library takes 2 MB, which a service without --http saves, and observers receive.
    __getattr__ = lazy_exports(
        __name__,
        {
            "Exporter": ("metrics", "exporter"),
            "HttpServer": ("", "http_server"),
            "LinkLosses": ("", "live_events"),
            "LiveEvents": ("", "live_events"),
            "Observer": ("", "observer"),
            "Page": ("", "http_server"),
            "Snapshot": ("", "observer"),
            "service_pages": ("", "pages"),
        },
    )

__all__ = [
    "Exporter",
    "HttpServer",
    "Page",
    "Snapshot",
    "service_pages",
    "why_not_ready",
    "why_refused",
]
