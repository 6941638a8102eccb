"""Generated documentation: a page for each message, and the reference pages of the site."""

from __future__ import annotations

from pathlib import Path

from nedbus_msgs import MESSAGES

from .api import api_page
from .commands import commands_page
from .messages import module_of, page
from .metrics import metrics_page
from .tables import events_page, keys_page, limits_page, settings_page
from .vectors import VECTORS, vectors_text

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


def committed() -> dict[Path, str]:
    """Return the pages of messages and the vectors of the wire format, which are committed to the repository."""
    pages = {DOCS / "messages" / f"{module_of(each)}.md": page(each) for each in MESSAGES.values()}
    return {**pages, VECTORS: vectors_text()}


def reference() -> dict[str, str]:
    """Return the reference pages, which are generated for the site only, by file name."""
    return {
        "api.md": api_page(),
        "command-line.md": commands_page(),
        "settings.md": settings_page(),
        "metrics.md": metrics_page(),
        "log-events.md": events_page(),
        "keys.md": keys_page(),
        "limits.md": limits_page(),
    }
