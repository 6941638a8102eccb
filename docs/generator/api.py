"""The page of the Python API: each public name with its signature and docstring."""

from __future__ import annotations

import ast
import inspect
import re
from collections.abc import Iterator
from functools import cached_property
from importlib import import_module
from pathlib import Path
from typing import Any, Final

import nedbus
import nedbus.errors
import nedbus_msgs

from .markdown import cell, code, docstring, page, section, table

PUBLIC_MODULES: Final = (
    "nedbus", "nedbus.errors", "nedbus.frames", "nedbus.health", "nedbus.timeline", "nedbus.flights",
    "nedbus.vehicle_events", "nedbus.fusion", "nedbus.settings", "nedbus.daemon", "nedbus.sources",
    "nedbus.monitoring", "nedbus.pki", "nedbus.doctor", "nedbus.rmw_zenoh",
)  # fmt: skip
"""The modules whose `__all__` is the public API; the others, and further names of these, may change at any time."""

_SECTIONS: Final = {  # by title: the packages of the names
    "The bus, subscriptions and publishers": (
        "nedbus.client",
        "nedbus.samples",
        "nedbus.transport.router",
        "nedbus.transport.tls",
        "nedbus.transport.vehicle_directory",
        "nedbus.transport.write_probe",
    ),
    "Files": ("nedbus.flights", "nedbus.tables"),
    "Time": ("nedbus.timeline",),
    "Events": (
        "nedbus.vehicle_events",
        "nedbus.event_history",
        "nedbus.event_sources",
        "nedbus.monitoring.live_events",
    ),
    "External positions": ("nedbus.fusion",),
    "A service in your program": ("nedbus.settings", "nedbus.daemon"),
    "MAVLink links": ("nedbus.sources",),
    "Metrics and health": ("nedbus.monitoring",),
    "Certificates and access rules": ("nedbus.pki", "nedbus.transport.access_control"),
    "Checks of settings and networks": ("nedbus.doctor",),
    "ROS 2 over Zenoh": (
        "nedbus.transport.rmw_zenoh",
        "nedbus.transport.liveliness",
        "nedbus.transport.session",
    ),
    "Errors": ("nedbus.errors", "nedbus_msgs.errors"),
    "Messages, arrays, frames and resets": ("nedbus_msgs",),
}
_CONSTANTS: Final = {  # without a docstring in the code
    "ANY": "Any topic, or any vehicle",
    "Mode": "What a slow reader receives: the newest message of each key, or every message",
    "Quantity": "A quantity that an estimator can reset",
    "frames.Vector": "Three components",
    "Session": "Zenoh's own session, for features that nedbus does not cover",
}


def api_page() -> str:
    """Return the page of all public names, written relative to `nedbus`."""
    named = {name: getattr(nedbus, name) for name in nedbus.__all__}
    for module in map(import_module, PUBLIC_MODULES[1:]):
        short = module.__name__.removeprefix("nedbus.")
        named |= {
            f"{short}.{name}": getattr(module, name) for name in module.__all__ if name not in named
        }
    constants = {
        name: each
        for name, each in named.items()
        if not (inspect.isclass(each) or inspect.isroutine(each))
    }
    constants["Session"] = named["Session"]
    parts = []
    for title, packages in _SECTIONS.items():
        own = [
            name for name in named if name not in constants and _section_of(named[name]) == title
        ]
        tree = docstring(nedbus.errors.__doc__) if title == "Errors" else ""
        own.sort(
            key=lambda name: (
                name.startswith("Async"),
                inspect.isclass(named[name]),
                title == "Errors",
            )
        )
        parts.append(section(title, tree, *(_entry(name, named[name]) for name in own)))
        assert own, packages
    return page(
        "Python API",
        "Everything is in `nedbus` and its modules "
        + ", ".join(code(name.removeprefix("nedbus.")) for name in PUBLIC_MODULES[1:])
        + ": what their `__all__` lists. All other names may change at any time.",
        "`nedbus`, `errors`, `frames` and `health` are for scripts; the others are for programs that show events, run a"
        " service, or manage a fleet, as the commands of nedbus do.",
        "Units are SI and the frame is NED unless stated otherwise.",
        "Message classes have [their own pages](../messages.md).",
        *parts,
        section(
            "Constants and types",
            table(["name", "value", "meaning"], map(_constant, constants.items())),
        ),
    )


def _section_of(value: Any) -> str:
    module = f"{value.__module__}."
    return next(
        (
            title
            for title, packages in _SECTIONS.items()
            if any(module.startswith(f"{each}.") for each in packages)
        ),
        next(iter(_SECTIONS)),
    )


def _entry(name: str, value: Any) -> str:
    if inspect.isroutine(value):
        return section(f"`{name}`", _signature(name, value), docstring(value.__doc__), level=3)
    shown = (
        ""
        if re.search("get one from|from `connect|returns one|yields them", value.__doc__ or "")
        else name
    )
    signature = (
        _signature(shown, value)
        if shown and not issubclass(value, (Exception, nedbus.Message))
        else ""
    )
    return section(
        f"`{name}`", signature, docstring(value.__doc__), *map(str, _members(value)), level=3
    )


def _members(cls: type) -> Iterator[str]:
    """Yield the properties and the methods of a class."""
    own = [base for base in cls.__mro__ if base.__module__.startswith("nedbus")]
    names = dict.fromkeys(name for base in own for name in vars(base) if not name.startswith("_"))
    if issubclass(cls, nedbus.Message):
        names = {name: None for name in names if name in vars(nedbus.Message)}
    properties, methods = [], []
    for name in names:
        value = inspect.getattr_static(cls, name)
        if isinstance(value, (property, cached_property)):
            properties.append([code(name), cell(value.__doc__ or "")])
        elif isinstance(value, (classmethod, staticmethod)) or inspect.isroutine(value):
            routine = getattr(cls, name)
            texts = _signature(name, routine), docstring(inspect.getdoc(routine))
            methods.append(section(f"`{cls.__name__}.{name}`", *texts, level=4))
    yield table(["property", "meaning"], properties)
    yield from methods


def _signature(name: str, value: Any) -> str:
    try:
        signature = inspect.signature(value)
    except (TypeError, ValueError):
        return ""
    shown = [each for each in signature.parameters.values() if each.name not in {"self", "cls"}]
    returned = signature.return_annotation if inspect.isroutine(value) else inspect.Signature.empty
    text = f"{name}{signature.replace(parameters=shown, return_annotation=returned)}"
    text = re.sub(
        r"(: |-> )'((?:[^'\\]|\\.)*)'", r"\1\2", re.sub(r'(: |-> )"([^"]*)"', r"\1\2", text)
    )
    text = re.sub(
        r"ForwardRef\('(\w+)'\)|<class '(?:\w+\.)*(\w+)'>", lambda found: found[1] or found[2], text
    )
    if len(text) > 100:
        text = re.sub(r"\(", "(\n    ", text, count=1)
        text = re.sub(r", (?=\*?\*?\w+(?::|,|=|\)))", ",\n    ", text)
    return f"```python\n{text}\n```"


def _constant(item: tuple[str, Any]) -> list[str]:
    name, value = item
    shown = {
        "TOPICS": "a mapping of names to `Topic`",
        "DTYPE": "`numpy.dtype`",
        "Session": "`zenoh.Session`",
    }
    shown["frames.DERIVED"] = "a mapping of names to `DerivedField`"
    shown["vehicle_events.KINDS"] = "a mapping of names to `Kind`"
    return [
        code(name),
        shown.get(name) or code(str(value).replace("typing.", "")),
        cell(_meaning(name)),
    ]


def _meaning(name: str) -> str:
    if name in _CONSTANTS:
        return _CONSTANTS[name]
    module, _, constant = name.rpartition(".")
    own = Path(nedbus.__path__[0]) / module  # for equal names in several modules
    for folder in (own, Path(nedbus_msgs.__path__[0]), Path(nedbus.__path__[0])):
        for path in folder.rglob("*.py"):
            for assigned, text in constants_of(ast.parse(path.read_text())):
                if assigned == constant:
                    return text
    raise LookupError(name)


def constants_of(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield each name assigned in a module with the string below it."""
    for statement, below in zip(tree.body, tree.body[1:], strict=False):
        target = getattr(statement, "target", None) or next(
            iter(getattr(statement, "targets", ())), None
        )
        is_text = isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
        if isinstance(target, ast.Name) and is_text:
            yield target.id, str(below.value.value)  # type: ignore[attr-defined]  # is_text ensures it
