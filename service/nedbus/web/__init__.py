"""Web page with a map, a table and plots of all vehicles, live or from a recording; needs the extra `web`."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

if TYPE_CHECKING:
    from .server import Where, serve_live, serve_recording
else:
    __getattr__ = lazy_exports(__name__, dict.fromkeys(("Where", "serve_live", "serve_recording"), ("web", "server")))
