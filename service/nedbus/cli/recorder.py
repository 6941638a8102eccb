"""Recorder of a subscription to an MCAP file."""

import math
import threading
import time
from contextlib import suppress
from itertools import repeat
from pathlib import Path
from typing import Any, Final

from nedbus import Batch, Subscription, clock
from nedbus.errors import ClosedError, NoDataError
from nedbus.flights import RecordingWriter, check_recording
from nedbus_msgs.text import counted

_FLUSH_INTERVAL: Final = 1.0  # s; a power cut costs the messages since the last flush
_POLL_INTERVAL: Final = 0.2  # s between checks of `stop`


class Recorder:
    """Write every message of a subscription in mode "every" to a new MCAP file.

    Raises ConfigError for a suffix other than .mcap.
    """

    def __init__(self, subscription: Subscription[Any], path: Path) -> None:
        check_recording(path)
        self._subscription = subscription
        self._path = path
        self._writer: RecordingWriter | None = None

    @property
    def messages(self) -> int:
        """The number of messages recorded so far."""
        if self._writer is None:
            return 0
        return self._writer.messages

    @property
    def status(self) -> str:
        """The counts so far as text, such as "120 messages, 2 lost"."""
        texts = [counted(self.messages, "message")]
        counts = self._subscription.counts
        for name in ("lost", "dropped", "invalid", "discarded", "forgotten"):
            count = getattr(counts, name)
            if count:
                texts.append(f"{count} {name}")
        if self._writer is not None and self._writer.omitted:
            texts.append(f"{self._writer.omitted} not recorded")
        return ", ".join(texts)

    def run(self, stop: threading.Event, *, duration: float | None = None) -> None:
        """Record until `stop` is set, for `duration` seconds, or until the subscription is closed; then drain it.

        Raises OutputError if the file exists or cannot be written. Raises NoDataError, and removes the file, if no
        message arrived.
        """
        start = time.monotonic()
        now = start
        if duration is None:
            end = math.inf
        else:
            end = start + duration
        next_flush = start + _FLUSH_INTERVAL
        # raised once all is written
        with RecordingWriter(self._path) as self._writer, suppress(ClosedError):
            while True:
                if stop.is_set() or now >= end:
                    self._subscription.drain()
                timeout = max(0.0, min(_POLL_INTERVAL, end - now))
                with suppress(NoDataError):
                    _write(self._writer, self._subscription.receive_batch(timeout))
                now = time.monotonic()
                if now >= next_flush:
                    self._writer.flush()
                    next_flush = now + _FLUSH_INTERVAL
        if not self.messages:
            self._path.unlink(missing_ok=True)
            raise NoDataError(self._subscription.name, time.monotonic() - start)


def _write(writer: RecordingWriter, batch: Batch) -> None:
    now = clock.utc_ns()  # log times in order of arrival, also for recovered messages
    addresses = (batch.addresses[index] for index in batch.address_index.tolist())
    writer.write(
        batch.messages,
        batch.message.DEFINITION,
        zip(addresses, batch.provenances, strict=True),
        logged=repeat(now),
        published=[time if time > 0 else now for time in batch.sent.tolist()],
        sequence=batch.sequence.tolist(),
    )
