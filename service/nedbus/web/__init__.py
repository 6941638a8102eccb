"""Web page with a map, a list and plots of all vehicles, live or from recordings; needs the extra `web`."""

from typing import TYPE_CHECKING

from nedbus.extras import lazy_exports

if TYPE_CHECKING:
    from .server import PageOptions, serve_live, serve_recording
else:
    _NAMES = "PageOptions", "serve_live", "serve_recording"
    __getattr__ = lazy_exports(__name__, dict.fromkeys(_NAMES, ("web", "server")))

__all__ = ["PageOptions", "serve_live", "serve_recording"]
