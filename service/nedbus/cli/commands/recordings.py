"""Command that records live messages: record."""

import math
import time
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import typer

from nedbus import Bus
from nedbus.cli.follow import write_notice
from nedbus.cli.options import ALL, DurationOption, command
from nedbus.cli.output.streams import write_stderr
from nedbus.cli.output.table import show_progress
from nedbus.cli.run import run_until_stopped
from nedbus.errors import NoDataError
from nedbus.extras import import_optional
from nedbus.timings import TIMINGS
from nedbus_msgs import Selection


@command
def record(
    open_bus: Callable[[], Bus],
    selection: Selection = ALL,
    *,
    output: Annotated[
        Path, typer.Option("--output", "-o", metavar="FILE.mcap", help="Recording to write")
    ],
    duration: DurationOption = None,
) -> None:
    """Record messages to an MCAP file until Ctrl-C.

    A crash loses about the last second.
    """
    # before a bus is opened, and waited for
    recorders = import_optional("mcap", "nedbus.cli.recorder")
    notice = time.monotonic() + TIMINGS.first_sample
    with (
        open_bus() as bus,
        bus.subscribe(
            *selection.topics, vehicle=selection.vehicles, instance=selection.instance, mode="every"
        ) as subscription,
    ):
        recorder = recorders.Recorder(subscription, output)

        def tick() -> None:
            nonlocal notice
            show(recorder.status, None, None)
            if not recorder.messages and time.monotonic() > notice:
                notice = math.inf
                write_notice(subscription)

        try:
            # Ctrl-C is the normal end of a recording
            with show_progress() as show, suppress(typer.Exit):
                run_until_stopped(lambda stop: recorder.run(stop, duration=duration), on_tick=tick)
        except NoDataError:
            write_stderr(f"{output}: {recorder.status}, removed the empty file")
            raise
    write_stderr(f"{output}: {recorder.status}")
