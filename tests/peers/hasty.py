"""`nedbus` in a process of its own, with shorter times than it has, where a test would only wait for them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

from tests.peers.processes import Process, Start

_SCRIPT: Final = """
import sys
from importlib import import_module
from nedbus.cli import main
for name, value in eval(sys.argv.pop(1)).items():
    module, _, constant = name.rpartition(".")
    getattr(import_module(module), constant)  # it must be there
    setattr(import_module(module), constant, value)
main()
"""


def start_hasty(start: Start, constants: Mapping[str, object], *arguments: str, **environment: str) -> Process:
    """Start `nedbus` with these arguments; `constants`: values by the full names of what they replace."""
    return start("-c", _SCRIPT, repr(constants), *arguments, **environment)
