"""The tables of the page: a row for each stream, the worst first, and the rejected messages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Final

from bokeh.core.property.vectorization import Field
from bokeh.models import ColumnDataSource
from bokeh.models.widgets import DataTable, StringFormatter, TableColumn

from nedbus.client import to_age
from nedbus_msgs import Address

from .fleet import Line, Picture
from .send import replace
from .stream import is_position
from .style import COLOURS, Style, to_clock

_TOPICS: Final = {
    "vehicle_local_position": "local position",
    "vehicle_local_position_groundtruth": "ground truth",
    "external_ins_local_position": "external INS",
    "estimator_local_position": "EKF",
}
_FLAGS: Final = {
    "xy_valid": "xy", "z_valid": "z", "v_xy_valid": "vxy", "v_z_valid": "vz", "heading_good_for_control": "hdg",
    "dead_reckoning": "DR",
}  # fmt: skip
_WIDTHS: Final = {
    "vehicle": 60, "topic": 110, "state": 90, "what is wrong": 150, "since": 54, "age": 44, "Hz": 32, "off truth": 54,
    "lost": 32, "rejected": 50, "latency": 46, **dict.fromkeys(_FLAGS.values(), 25), "source": 44,
}  # fmt: skip
_SET, _CLEAR = "●", "○"


class StreamTable:
    """A row for each stream: rows move only while nobody points at them, and only cells that change are sent."""

    def __init__(self, style: Style) -> None:
        self.source = ColumnDataSource({name: [] for name in (*_WIDTHS, "colour")})
        self.pointing = False
        self.order: list[Address] = []
        formats: dict[str, StringFormatter] = {
            "state": StringFormatter(text_color="#ffffff", background_color=Field("colour")),
            "vehicle": StringFormatter(font_style="bold"),
        }
        columns = [
            TableColumn(field=name, title=name, width=width, formatter=formats.get(name, StringFormatter()))
            for name, width in _WIDTHS.items()
        ]
        self.table = _make_table(self.source, columns, style)

    def update(self, picture: Picture, chosen: Address | None) -> None:
        """Show these streams."""
        lines = {line.address: line for line in picture.worst_first()}
        if self.pointing:
            order = [address for address in self.order if address in lines]
            known = set(order)
            order += [address for address in lines if address not in known]
        else:
            order = list(lines)
        rows = [_cells(lines[address]) for address in order]
        _show(self.table, self.source, {name: [row[name] for row in rows] for name in self.source.column_names})
        self.order = order
        indices = [order.index(chosen)] if chosen in order else []
        if self.source.selected.indices != indices:
            self.source.selected.indices = indices


class RejectionTable:
    """The messages that were rejected last, and why."""

    def __init__(self, style: Style) -> None:
        widths = {"rejected at": 80, "which": 190, "why": 640}
        self.source = ColumnDataSource({name: [] for name in widths})
        columns = [
            TableColumn(field=n, title=n, width=width, formatter=StringFormatter()) for n, width in widths.items()
        ]
        self.table = _make_table(self.source, columns, style)

    def update(self, picture: Picture) -> None:
        """Show these reports."""
        rows = {
            "rejected at": [to_clock(report.received / 1e9) for report in picture.reports],
            "which": [str(report.address) for report in picture.reports],
            "why": [report.reason for report in picture.reports],
        }
        _show(self.table, self.source, rows)


def _make_table(source: ColumnDataSource, columns: list[TableColumn], style: Style) -> DataTable:
    return DataTable(
        source=source, columns=columns, stylesheets=[style.table_css], sizing_mode="stretch_both", index_position=None,
        row_height=21, sortable=False, reorderable=False, autosize_mode="none", selectable=True, width=100,
    )  # fmt: skip


def _show(table: DataTable, source: ColumnDataSource, rows: Mapping[str, list[str]]) -> None:
    if replace(source, rows):
        table.view.tags = (
            [] if table.view.tags else ["new"]
        )  # tables of Bokeh 3.9 look at patches only when their view changes


def _cells(line: Line) -> dict[str, str]:
    health, last = line.health, line.stream.last
    instance = "" if line.address.instance is None else f" {line.address.instance}"
    flags = dict.fromkeys(_FLAGS.values(), "")
    if last is not None and is_position(line.address):
        flags = {label: _SET if getattr(last.message, name) else _CLEAR for name, label in _FLAGS.items()}
    is_fresh = line.condition not in {"disconnected", "gone", "stale"}
    return {
        "vehicle": line.address.vehicle,
        "topic": f"{_TOPICS.get(line.address.topic) or line.address.topic.replace('_', ' ')}{instance}",
        "state": line.condition,
        "what is wrong": line.words,
        "since": "" if line.condition == "ok" else to_clock(line.since),
        "Hz": f"{health.rate:.0f}" if health.rate is not None else "-",
        "age": "-" if health.age is None else "<1 s" if health.age < 1 else to_age(health.age),
        "latency": to_age(health.latency) if health.latency is not None and is_fresh else "-",
        "lost": str(health.lost),
        "rejected": str(line.rejected),
        **flags,
        "off truth": "" if math.isnan(line.stream.error) else f"{line.stream.error:.2f} m",
        "source": (last.source if last is not None else None) or "-",
        "colour": COLOURS[line.condition],
    }
