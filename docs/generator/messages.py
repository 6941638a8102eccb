"""A page for each message: its topics, fields, constants, layouts, rules and older names."""

from __future__ import annotations

import inspect
from collections.abc import Iterable, Iterator
from typing import Any

from nedbus_msgs import Definition, hash_of, ros2_type
from nedbus_msgs.model.rules import FiniteWhile, NotLater, Rule

from .markdown import section, table


def page(definition: Definition[Any]) -> str:
    """Return the page of a message."""
    doc = inspect.cleandoc(definition.model.__doc__ or "")
    parts = [f"<!-- Made by `make generated` from nedbus_msgs/messages. -->\n# {definition.name}\n\n{doc}"]
    parts.append(_topics(definition))
    fields = [[f"`{name}`", str(kind), definition.meaning(name)] for name, kind in definition.types.items()]
    parts.append(section("Fields", table(["field", "type", "meaning"], fields)))
    constants = [
        [f"`{name}`", str(value)]
        for name, value in vars(definition.model).items()
        if type(value) is int and name.isupper()
    ]
    parts.append(section("Constants", table(["constant", "value"], constants)))
    parts.append(_layouts(definition))
    rules = [row for rule in definition.rules for row in rows_of(rule)]
    parts.append(section("Rules", table(["fields", "rule"], rules)))
    parts.append(section("Properties", table(["property", "value", "None"], list(_properties(definition)))))
    older = [
        [f"`{old.name}`", " and ".join(map(_place, old.targets)) + ", in other units" * bool(old.up)]
        for old in definition.older.values()
    ]
    parts.append(section("Older names", table(["older field", "now"], older)))
    return "\n\n".join(filter(None, parts)) + "\n"


def _properties(definition: Definition[Any]) -> Iterator[list[str]]:
    for name, value in vars(definition.model).items():
        if isinstance(value, property):
            yield [f"`{name}`", *str(value.__doc__).rstrip(".").split("; None ")]


def _topics(definition: Definition[Any]) -> str:
    rows = [
        [f"`{topic.name}`" + " (instances)" * bool(topic.instances), f"{topic.rate:g}", topic.doc]
        for topic in definition.topics.values()
    ]
    return section("Topics", table(["topic", "Hz", "published by"], rows))


def _layouts(definition: Definition[Any]) -> str:
    rows = [
        [layout.name, str(len(layout.types)), f"`{hash_of(layout, ros2_type(definition))}`"]
        for layout in definition.layouts.values()
    ]
    return section("Layouts", table(["first in PX4", "fields", "hash of its ROS 2 type"], rows))


def _place(place: tuple[str, int | None]) -> str:
    name, index = place
    return f"`{name}`" if index is None else f"`{name}[{index}]`"


def rows_of(rule: Rule) -> list[list[str]]:
    """Return the rows of a rule in a table."""
    if isinstance(rule, FiniteWhile):
        return [[names(fields), f"must be finite while `{flag}` is true"] for flag, fields in rule.flags.items()]
    if isinstance(rule, NotLater):
        return [[f"`{rule.fields[0]}`", f"must not be later than `{rule.fields[1]}`"]]
    return [[names(rule.fields), rule.checks[0].reason]]


def names(fields: Iterable[str]) -> str:
    """Return the names of fields as Markdown."""
    return ", ".join(f"`{field}`" for field in fields)


def module_of(definition: Definition[Any]) -> str:
    """Return the name of the file of a message."""
    return definition.model.__module__.rpartition(".")[2]
