"""Fill recordings: from what arrives on a bus, and from flight logs."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from itertools import repeat
from pathlib import Path
from typing import Final

from pydantic import ValidationError

from nedbus_msgs import Address, Origin, VehicleLocalPosition, upgrade
from nedbus_msgs.arrays import to_records

from .batches import Batch
from .errors import ClosedError, NoDataError
from .recording import Recording
from .sources import Flight
from .subscriber import Subscription

_FLUSH: Final = 1.0  # s: what a power cut costs at most
_LOOK: Final = 0.2  # s between two looks at whether to end
_LATEST: Final = 2**64 - 1  # ns: a damaged log may say anything
_AT_ONCE: Final = 1024  # messages of a flight that are written together


class Recorder:
    """Write what a subscription of mode "every" gives to a new MCAP file.

    Raises RecordError when the file is there already or cannot be written.
    """

    def __init__(self, subscription: Subscription, path: Path) -> None:
        self._subscription = subscription
        self._recording = Recording(path)

    @property
    def status(self) -> str:
        """What was recorded so far, in one line."""
        counts = self._subscription.counts
        trouble = ", ".join(
            f"{count} {word}" for count, word in ((counts.lost, "lost"), (counts.invalid, "invalid")) if count
        )
        return f"{self._recording.messages} messages" + (f", {trouble}" if trouble else "")

    def run(self, stop: threading.Event, *, duration: float | None = None) -> None:
        """Record until `stop` is set, for so many seconds, or until the subscription is closed."""
        now = time.monotonic()
        end = float("inf") if duration is None else now + duration
        flush = now + _FLUSH
        with self._recording:
            while not stop.is_set() and now < end:
                try:
                    self._write(self._subscription.receive_batch(min(_LOOK, end - now)))
                except NoDataError:
                    pass
                except ClosedError:
                    return
                now = time.monotonic()
                if now >= flush:
                    self._recording.flush()
                    flush = now + _FLUSH

    def _write(self, batch: Batch) -> None:
        received = batch.received
        self._recording.write(
            batch.messages,
            zip((batch.addresses[place] for place in batch.which.tolist()), batch.origins, strict=True),
            logged=repeat(received),
            published=[time if time > 0 else received for time in batch.sent.tolist()],
            sequence=batch.sequence.tolist(),
        )


def convert(flight: Flight, path: Path, *, source: str, on_progress: Callable[[int], object]) -> str:
    """Write a flight, validated, to a new MCAP file, with PX4's own times; return in one line what became of it.

    Raises RecordError when the file is there already or cannot be written.
    """
    waiting: list[tuple[Address, Origin, VehicleLocalPosition]] = []
    rejected = 0
    with Recording(path) as recording:

        def write() -> None:
            times = [min(message.timestamp * 1000, _LATEST) for *_, message in waiting]
            streams = ((address, origin) for address, origin, _ in waiting)
            recording.write(to_records([each for *_, each in waiting]), streams, logged=times, published=times)
            waiting.clear()

        for done, record in enumerate(flight.records, 1):
            try:
                message = upgrade(record.fields)
            except ValidationError:
                rejected += 1
                continue
            missing = frozenset(VehicleLocalPosition.model_fields.keys() - message.model_fields_set)
            waiting.append((record.address, Origin(source, missing), message))
            if len(waiting) >= _AT_ONCE:
                write()
                on_progress(done)
        write()
    return f"{recording.messages} messages" + (f", {rejected} rejected" if rejected else "")
