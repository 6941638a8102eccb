"""Write what is made from the files of messages: `make generated`, after one was added or changed.

At run time the folder of messages is all that counts: these files are for type checkers and for people.
"""

from __future__ import annotations

import inspect
import subprocess
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from nedbus_msgs import MESSAGES, Definition, hash_of, ros2_type
from nedbus_msgs.model.rules import FiniteWhile, NotLater, Rule, UnitQuaternion

ROOT = Path(__file__).parents[1]


def stub() -> str:
    """Return the stub of the folder of messages."""
    lines = [f"from .{module_of(message)} import {name} as {name}" for name, message in sorted(MESSAGES.items())]
    return "# Made by `make generated`.\n" + "\n".join(lines) + "\n"


CALLS = {  # protocol: what it returns for a message, and its options
    "Subscribe": ("Subscription[{}]", "Options"),
    "AsyncSubscribe": ("AsyncSubscription[{}]", "Options"),
    "Latest": ("list[Sample[{}]]", "LatestOptions"),
    "AsyncLatest": ("Awaitable[list[Sample[{}]]]", "LatestOptions"),
}
HEAD = """# Made by `make generated` from nedbus_msgs/messages.
from collections.abc import Awaitable, Callable
from typing import Any, Literal, Protocol, TypedDict, overload

from typing_extensions import Unpack

import nedbus_msgs.messages as m

from .sample import Mode, Sample
from .subscription import AsyncSubscription, Subscription

class Options(TypedDict, total=False):
    vehicle: str | int
    instance: int | None
    mode: Mode
    max_rate: float | None

class LatestOptions(TypedDict, total=False):
    vehicle: str | int
    instance: int | None
    timeout: float

"""
DECORATORS = {
    "by_topic": "Subscribe",
    "by_topic_async": "AsyncSubscribe",
    "last": "Latest",
    "last_async": "AsyncLatest",
}


def topics() -> str:
    """Return the protocols of `subscribe` and `latest`, with an overload for the topics of each message."""
    lines = []
    for name, message in MESSAGES.items():
        literals = ", ".join(f'"{topic}"' for topic in message.topics)
        lines.append(f"_{name} = Literal[{literals}]")
    kinds = [*((f"_{name}", f"m.{name}") for name in MESSAGES), ("str", "Any")]
    for protocol, (result, options) in CALLS.items():
        lines.append(f"\nclass {protocol}(Protocol):")
        for number, (topic, message_type) in enumerate(kinds):
            default = "" if number else " = ..."
            parameters = f"self, topic: {topic}{default}, **options: Unpack[{options}]"
            lines.append(f"    @overload\n    def __call__({parameters}) -> {result.format(message_type)}: ...")
    lines += [f"def {name}(method: Callable[..., Any]) -> {protocol}: ..." for name, protocol in DECORATORS.items()]
    return HEAD + "\n".join(lines) + "\n"


def page(definition: Definition[Any]) -> str:
    """Return the page of a message."""
    doc = inspect.cleandoc(definition.model.__doc__ or "")
    cls = definition.model
    parts = [f"<!-- Made by `make generated` from nedbus_msgs/messages. -->\n# {definition.name}\n\n{doc}"]
    parts += table("Topics", ["topic", "Hz", "published by"], [
        [f"`{topic.name}`" + " (instances)" * bool(topic.instances), f"{topic.rate:g}", topic.doc]
        for topic in definition.topics.values()
    ])  # fmt: skip
    parts += table("Fields", ["field", "type", "meaning"], [
        [f"`{name}`", str(kind), definition.meaning(name)] for name, kind in definition.types.items()
    ])  # fmt: skip
    for field, prefix in getattr(cls, "ENUMS", {}).items():
        constants = sorted((value, name) for name, value in vars(cls).items() if name.startswith(prefix))
        parts += table(f"`{field}`", ["value", "constant"], [[str(value), f"`{name}`"] for value, name in constants])
    parts += table("Layouts", ["first in PX4", "fields", "hash of its ROS 2 type"], [
        [layout.name, str(len(layout.types)), f"`{hash_of(layout, ros2_type(definition))}`"]
        for layout in definition.layouts.values()
    ])  # fmt: skip
    parts += table("Rules", ["fields", "rule"], [row for rule in definition.rules for row in rows_of(rule)])
    older = getattr(cls, "OLDER", {})
    parts += table("Older names", ["older field", "now"], [
        [f"`{name}`", " and ".join(map(_place, old.new)) + ", in other units" * bool(old.up)]
        for name, old in older.items()
    ])  # fmt: skip
    return "\n\n".join(parts) + "\n"


def _place(place: tuple[str, int | None]) -> str:
    name, index = place
    return f"`{name}`" if index is None else f"`{name}[{index}]`"


def rows_of(rule: Rule) -> list[list[str]]:
    """Return the rows of a rule in a table."""
    if isinstance(rule, FiniteWhile):
        return [[names(fields), f"must be finite while `{flag}` is true"] for flag, fields in rule.flags.items()]
    if isinstance(rule, NotLater):
        return [[f"`{rule.fields[0]}`", f"must not be later than `{rule.fields[1]}`"]]
    return [[names(rule.fields), getattr(rule, "reason", UnitQuaternion.reason)]]


def names(fields: Iterable[str]) -> str:
    """Return the names of fields as Markdown."""
    return ", ".join(f"`{field}`" for field in fields)


def table(title: str, head: list[str], rows: list[list[str]]) -> list[str]:
    """Return a section with a table; nothing for one without rows."""
    lines = [" | ".join(cells) for cells in (head, ["---"] * len(head), *rows)]
    return [f"## {title}\n\n" + "\n".join(f"| {line} |" for line in lines)] if rows else []


def module_of(definition: Definition[Any]) -> str:
    """Return the name of the file of a message."""
    return definition.model.__module__.rpartition(".")[2]


def formatted(code: str) -> str:
    """Return a stub as `make check` wants it."""
    command = [sys.executable, "-m", "ruff", "format", "--stdin-filename", "a.pyi", "-"]
    return subprocess.run(command, input=code, capture_output=True, text=True, check=True, cwd=ROOT).stdout


def made() -> dict[Path, str]:
    """Return all files that are made, with their text."""
    pages = {ROOT / "docs" / "messages" / f"{module_of(each)}.md": page(each) for each in MESSAGES.values()}
    return {
        ROOT / "schemas/nedbus_msgs/messages/__init__.pyi": formatted(stub()),
        ROOT / "service/nedbus/client/by_topic.pyi": formatted(topics()),
        **pages,
    }


if __name__ == "__main__":
    for path, text in made().items():
        path.parent.mkdir(exist_ok=True)
        path.write_text(text)
        sys.stdout.write(f"{path.relative_to(ROOT)}\n")
