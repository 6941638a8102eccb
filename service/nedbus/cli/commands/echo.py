"""The command echo: print messages as they arrive."""

import sys
import time
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Final

import typer

from nedbus import Bus, Counts, Mode, Sample
from nedbus.cli.follow import follow
from nedbus.cli.options import (
    POSITIONS,
    CountOption,
    CsvOption,
    DurationOption,
    FieldOption,
    JsonOption,
    allow_one,
    command,
    parse_fields,
)
from nedbus.cli.output.samples import CsvLines, Lines, to_fields, to_json
from nedbus.cli.output.streams import write, write_stderr
from nedbus_msgs import Address, Selection, check_max_rate

_RATE: Final = "Downsample each stream at its publisher to this rate, in Hz"
_EVERY: Final = (
    "Print every message in order; a replay at speed=max waits for this terminal or pipe"
)


@command
def echo(
    open_bus: Callable[[], Bus],
    selection: Selection = POSITIONS,
    *,
    field: FieldOption = None,
    full: Annotated[
        bool, typer.Option("--full", "-f", help="Print all fields, one per line")
    ] = False,
    every: Annotated[bool, typer.Option("--every", help=_EVERY)] = False,
    json_output: JsonOption = False,
    csv_output: CsvOption = False,
    interval: Annotated[
        float, typer.Option(min=0.0, help="Minimum time between messages of a stream, in s")
    ] = 0.0,
    max_rate: Annotated[float | None, typer.Option(metavar="HZ", help=_RATE)] = None,
    once: Annotated[
        bool, typer.Option("--once", help="Stop after one message, same as --count 1")
    ] = False,
    count: CountOption = None,
    duration: DurationOption = None,
) -> None:
    """Print messages as they arrive, one line each.

    If the terminal or pipe is too slow, older messages are skipped (see --every).
    """
    allow_one({"--full": full, "--json": json_output, "--csv": csv_output})
    allow_one({"--once": once, "--count": count is not None})
    if max_rate is not None:
        check_max_rate(max_rate)
    fields = parse_fields(field, selection)
    form: Callable[[Sample[Any], Sequence[str]], str] = Lines()
    if json_output:
        form = to_json
    if full:
        form = to_fields
    if csv_output:
        form = CsvLines()
    due: dict[Address, float] = {}

    def print_one(sample: Sample[Any]) -> bool:
        if interval:
            now = time.monotonic()
            if now < due.get(sample.address, 0.0):
                return False
            due[sample.address] = now + interval
        write(form(sample, fields))
        return True

    mode: Mode = "latest"
    if every:
        mode = "every"
    if once:
        count = 1
    with (
        open_bus() as bus,
        bus.subscribe(
            *selection.topics,
            vehicle=selection.vehicles,
            instance=selection.instance,
            mode=mode,
            max_rate=max_rate,
        ) as subscription,
    ):
        try:
            follow(bus, subscription, print_one, count=count, duration=duration)
        finally:
            if not isinstance(sys.exception(), BrokenPipeError):  # `| head` has read enough
                counts = subscription.counts
                if csv_output or _is_incomplete(counts):
                    write_stderr(_describe_counts(counts, every=every))


def _is_incomplete(counts: Counts) -> bool:
    return any((counts.lost, counts.dropped, counts.invalid, counts.discarded))


def _describe_counts(counts: Counts, *, every: bool) -> str:
    """Describe which messages were shown, and which were not."""
    unread = "dropped" if every else "skipped (--every prints all)"
    text = f"{counts.received} received, {counts.lost} lost, {counts.dropped} {unread}, {counts.invalid} invalid"
    if counts.discarded:
        text += f", {counts.discarded} discarded"
    return text
