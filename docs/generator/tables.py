"""The pages of settings and sources, events, keys and payloads, and limits, as tables."""

from __future__ import annotations

import ast
import inspect
import re
from typing import Final

import nedbus.limits
import nedbus_msgs.limits
from nedbus.log_event import EVENTS
from nedbus.settings import Settings
from nedbus.sources import SOURCE_KINDS
from nedbus.timings import Timings
from nedbus.vehicle_events import KINDS
from nedbus_msgs import MESSAGES, TOPICS, Address, codec_of, encoding_of

from .api import constants_of
from .markdown import cell, code, page, section, table

_SECTION: Final = re.compile(r"^# --- (.+) ---$", re.MULTILINE)


def settings_page() -> str:
    """Return the page of the settings of a service and the options of its sources."""
    rows = []
    for name, field in Settings.model_fields.items():
        default = field.get_default(call_default_factory=True)
        shown = "" if default in (None, (), "") else str(default).lower()
        flag = f"--{name.replace('_', '-')}"
        rows.append(
            [
                code(name),
                code(f"NEDBUS_{name.upper()}"),
                code(flag),
                code(shown),
                cell(field.description),
            ]
        )
    sources = []
    for name, kind in SOURCE_KINDS.items():
        options = []
        for option, field in kind.options.model_fields.items():
            default = field.get_default(call_default_factory=True)
            shown = "" if default in (None, (), {}, "", False) else str(default)
            options.append([code(option), code(shown), cell(field.description)])
        needs = f"Needs the extra `{kind.extra}`." if kind.extra else ""
        title = f"`{name}:{kind.target or ''}`"
        sources.append(
            section(title, needs, table(["option", "default", "meaning"], options), level=3)
        )
    return page(
        "Settings",
        "Flags override environment variables, which override `nedbus.toml`, or the file given by `--config` or "
        "`NEDBUS_CONFIG`. An empty default means none.",
        table(["in `nedbus.toml`", "environment", "flag", "default", "meaning"], rows),
        section(
            "Sources",
            "A source is `KIND:TARGET?OPTION=VALUE&OPTION=VALUE`, or a TOML table.",
            *sources,
        ),
    )


def events_page() -> str:
    """Return the page of log events and vehicle events."""
    rows = [
        [code(name), cell(each.doc), "yes" if each.limited else "no"]
        for name, each in EVENTS.items()
    ]
    kinds = [[code(name), ", ".join(map(code, kind.causes))] for name, kind in KINDS.items()]
    return page(
        "Log events and vehicle events",
        section(
            "Log events",
            "The `event` of each line with `--log-format json`. "
            "Up to 50 lines of each rate-limited event are logged at once, then 6 a minute.",
            table(["event", "meaning", "rate-limited"], rows),
        ),
        section(
            "Vehicle events",
            "The `kind` of each event, and the kinds that may explain it; [what they mean](../events.md#events).",
            table(["kind", "evidence"], kinds),
        ),
    )


def keys_page() -> str:
    """Return the page of keys, payloads and topics."""
    one, other = Address("7", "vehicle_local_position"), Address("7", "sensor_gps", 0)
    keys = [
        [code(one.key()), "messages; a `get` returns the last one"],
        [code(other.key()), "the same, for each EKF or sensor instance"],
        [code(one.rate_key(5)), "the same, downsampled by its publisher to 5 messages a second"],
        [code(one.alive_key("<publisher>")), "liveliness token"],
        [
            code(f"{one.key()}/@ack"),
            (
                "queryable of each subscription in mode `every`, below its key expression, with "
                "`?publisher=<zid>:<eid>;number=<sequence number>;read=<0 or 1>`: it replies when that message of that "
                "publisher has arrived, or with `read=1` when the script has read it"
            ),
        ],
        [
            code("nedbus/@schema/*/VehicleLocalPosition"),
            "queryable: JSON Schema and layouts of each definition with this name, or of the one with `?hash=`",
        ],
        [code("nedbus/@service/*/*/status"), "queryable: status of each service, in JSON"],
        [code(one.rejected_key()), "rejected messages, with the reason, in JSON"],
    ]
    messages = [
        [
            code(name),
            str(len(each.types)),
            str(codec_of(each).size),
            code(encoding_of(each, None)),
        ]
        for name, each in MESSAGES.items()
    ]
    topics = [
        [code(name), rate, str(each.kept), "first" if each.priority == "data_high" else ""]
        for name, each in TOPICS.items()
        for rate in [f"{each.rate:g}" if each.rate else "on events"]
    ]
    return page(
        "Keys and payloads",
        "For clients in other languages; `examples/plain_zenoh.py` is one.",
        section("Keys", table(["key", "content"], keys)),
        section(
            "Payloads",
            "`[layout, field 1, ... field n]` as msgpack, the fields in the order of "
            "[the message's page](../messages.md)."
            "\nEvery field is written at its full width, so a payload of a message always has the same size, with "
            "every field at a fixed offset; any other valid msgpack encoding of the array is also accepted."
            "\nThe Zenoh encoding starts with the message; `;source=...` may follow, and `;missing=...`, a hexadecimal "
            "mask with one bit for each field that was not provided, the lowest for `timestamp`."
            "\nFor any message that is not in this table, and for newer layouts, `;hash=...` follows the name: the "
            "first 32 hexadecimal digits of its RIHS01 hash as ROS 2 computes it (`nedbus_msgs.short_hash`), because "
            "builds of PX4 may define the same message differently."
            "\nA reader queries `nedbus/@schema/*/<Message>?hash=...`, computes the hash of the fields in each reply, "
            "and decodes a payload only with the fields that match its hash; without a match the message is invalid.",
            table(["message", "fields", "bytes", "encoding"], messages),
        ),
        section("Topics", table(["topic", "Hz", "messages cached", "priority"], topics)),
    )


def limits_page() -> str:
    """Return the page of limits: the tables of `nedbus.limits` and `nedbus_msgs.limits`, and the durations."""
    sections = []
    for module in (nedbus.limits, nedbus_msgs.limits):
        _, *parts = _SECTION.split(inspect.getsource(module))
        for title, source in zip(parts[::2], parts[1::2], strict=True):
            rows = []
            for name, text in constants_of(ast.parse(source)):
                rows.append([cell(text), code(f"{getattr(module, name):,}"), code(name)])
            sections.append(section(title, table(["limit", "value", "constant"], rows)))
    return page(
        "Limits and durations",
        "The limits in the code, with the names of their constants in `nedbus.limits` and `nedbus_msgs.limits`. "
        "A vehicle name has 1 to 64 characters of `A-Z a-z 0-9 _ -`, and an instance is a number from 0 to 255.",
        *sections,
        section(
            "Durations",
            table(["duration [s]", "value", "field of `nedbus.timings.TIMINGS`"], _durations()),
        ),
    )


def _durations() -> list[list[str]]:
    lines = re.findall(r"^    # (.+)\n    (\w+): ", inspect.getsource(Timings), re.MULTILINE)
    return [[cell(text), code(str(getattr(Timings(), name))), code(name)] for text, name in lines]
