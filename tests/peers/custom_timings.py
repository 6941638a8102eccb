"""`nedbus` in a subprocess with other timings: shorter to save time, or longer for a busy machine."""

from __future__ import annotations

from typing import Final

from nedbus.timings import Timings
from tests.peers.processes import Process, Start

_SCRIPT: Final = """
import sys
from dataclasses import fields
from nedbus.cli import main
from nedbus.timings import TIMINGS, Timings
given = eval(sys.argv.pop(1))
for each in fields(given):
    setattr(TIMINGS, each.name, getattr(given, each.name))
main()
"""


def start_with_timings(
    start: Start, timings: Timings, *arguments: str, **environment: str
) -> Process:
    """Start `nedbus` with these timings and arguments."""
    return start("-c", _SCRIPT, repr(timings), *arguments, **environment)
