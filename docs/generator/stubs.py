"""The stubs by which type checkers know each message, and which topic has which."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

from nedbus_msgs import MESSAGES

from .messages import module_of

ROOT = Path(__file__).parents[2]


def stub() -> str:
    """Return the stub of the folder of messages."""
    lines = [f"from .{module_of(message)} import {name} as {name}" for name, message in sorted(MESSAGES.items())]
    return "# Made by `make generated`.\n" + "\n".join(lines) + "\n"


CALLS = {  # protocol: what it returns for a message, and its options
    "Subscribe": ("Sync[{}]", "Options"),
    "AsyncSubscribe": ("Async[{}]", "Options"),
    "Latest": ("Samples[{}]", "Query"),
    "AsyncLatest": ("Soon[{}]", "Query"),
}
HEAD = """# Made by `make generated` from nedbus_msgs/messages.
from collections.abc import Awaitable, Callable
from typing import Any, Literal, Protocol, TypedDict, overload

from typing_extensions import Unpack

import nedbus_msgs.messages as m

from .sample import M_co, Mode, Sample
from .subscription import AsyncSubscription as Async
from .subscription import Subscription as Sync

Samples = list[Sample[M_co]]
Soon = Awaitable[list[Sample[M_co]]]

class Options(TypedDict, total=False):
    vehicle: str | int
    instance: int | None
    mode: Mode
    max_rate: float | None

class Query(TypedDict, total=False):
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


def formatted(code: str) -> str:
    """Return a stub as `make check` wants it."""
    command = [sys.executable, "-m", "ruff", "format", "--stdin-filename", "a.pyi", "-"]
    return subprocess.run(command, input=code, capture_output=True, text=True, check=True, cwd=ROOT).stdout


def stubs() -> dict[Path, str]:
    """Return all stubs by their files."""
    return {
        ROOT / "schemas/nedbus_msgs/messages/__init__.pyi": formatted(stub()),
        ROOT / "service/nedbus/client/by_topic.pyi": formatted(topics()),
    }
