"""The text of the page: the macros of `assets/panels.html`, and what is computed for them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any

from jinja2 import Environment, StrictUndefined, Template

from nedbus.client import to_age

from .fleet import GRADES, MAX_STREAMS, Fleet, Row
from .stream import is_position
from .style import SHAPES, Style, read_asset


def open_panels(style: Style, moment: Callable[[float], str]) -> Any:
    """Return the macros for one viewer; `moment` writes a time of the account's clock."""
    return _template().make_module({"style": style, "moment": moment})


@cache
def _template() -> Template:
    environment = Environment(autoescape=True, undefined=StrictUndefined)
    environment.filters["age"] = to_age
    environment.globals.update(GRADES=GRADES, MAX_STREAMS=MAX_STREAMS, SHAPES=SHAPES)
    return environment.from_string(re.sub(r"(?<=[>}])\n\s*(?=[<{])", "", read_asset("panels.html")))


def tiles(row: Row | None) -> dict[str, str]:
    """Return the numbers of a vehicle by their names; "" where nothing says them, or they are not valid."""
    last = row.main.stream.last if row is not None and is_position(row.main.address) else None
    message: Any = last.message if last is not None else None

    def write(value: float, unit: str, *, valid: bool = True) -> str:
        return f"{value:z.1f} {unit}" if valid and math.isfinite(value) else ""

    found = dict.fromkeys(("north", "east", "height", "speed", "heading", "mode", "armed", "battery", "GPS · sats"), "")
    if message is not None:
        found["north"] = write(message.x, "m", valid=message.xy_valid)
        found["east"] = write(message.y, "m", valid=message.xy_valid)
        found["height"] = write(-message.z, "m", valid=message.z_valid)
        found["speed"] = write(math.hypot(message.vx, message.vy), "m/s", valid=message.v_xy_valid)
        if math.isfinite(message.heading):
            found["heading"] = f"{round(math.degrees(message.heading)) % 360}°"
    if row is not None:
        facts = row.facts
        found |= {"mode": facts.mode, "armed": facts.armed, "battery": facts.battery, "GPS · sats": facts.gps}
    return found


def describe_frame(fleet: Fleet, rows: Sequence[Row]) -> str:
    """Say what the map's metres are of."""
    projection = fleet.origin.projection
    own = [row.vehicle for row in rows if row.main.stream.valid is not None and not row.main.stream.valid.common]
    nowhere = [row.vehicle for row in rows if row.main.stream.valid is None]
    parts = [f"metres from {projection.latitude:.6f}, {projection.longitude:.6f}"] if projection else []
    for text, names in (("from their own origin", own), ("never had a valid position", nowhere)):
        if names:
            more = f" and {len(names) - 6} more" if len(names) > 6 else ""
            parts.append(f"{text}: {', '.join(names[:6])}{more}")
    return "; ".join(parts)
