"""Run a command in a thread until it ends or a signal comes, also as the first process of a container."""

from __future__ import annotations

import logging
import os
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from types import FrameType
from typing import Final

import typer

from nedbus.log_event import about

_log = logging.getLogger("nedbus")

_END_TIMEOUT: Final = 1.6  # s after a signal by which the process has ended


def _ignore_hangup() -> None:
    _log.info("SIGHUP is ignored: SIGTERM or Ctrl-C ends this process", extra=about("reload"))


def run_until_stopped(
    body: Callable[[threading.Event], object],
    *,
    on_stop: Callable[[], object] = lambda: None,
    on_tick: Callable[[], object] = lambda: None,
    on_hangup: Callable[[], object] = _ignore_hangup,
) -> None:
    """Run a body in a thread until it ends, or until Ctrl-C or SIGTERM sets its event.

    `on_stop` is called when the event is set, in the handler of the signal; `on_tick` ten times a second meanwhile, and
    `on_hangup` after SIGHUP, both in the main thread, which only waits: signals are handled at once, even while Zenoh
    blocks.

    Raises typer.Exit with 130 after Ctrl-C, with 1 if the body returned False.
    """
    stop = threading.Event()
    outcome: Future[object] = Future()
    signals: list[int] = []
    hangups: list[int] = []

    def run() -> None:
        try:
            outcome.set_result(body(stop))
        except BaseException as exc:  # noqa: BLE001 - raised again below, in the main thread
            outcome.set_exception(exc)

    def on_signal(number: int, _: FrameType | None) -> None:
        if signals:
            os._exit(130 if number == signal.SIGINT else 1)  # a second signal ends the process at once
        signals.append(number)
        stop.set()
        on_stop()

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, on_signal)
    signal.signal(signal.SIGHUP, lambda number, _: hangups.append(number))
    thread = threading.Thread(target=run, name="nedbus-run", daemon=True)
    thread.start()
    while thread.is_alive() and not signals:
        if hangups:
            hangups.clear()
            on_hangup()
        on_tick()
        thread.join(0.1)
    if signals:
        _log.info("ending: %s", signal.Signals(signals[0]).name, extra=about("ending"))
    thread.join(_END_TIMEOUT)
    if thread.is_alive():
        text = "not everything ended in time, perhaps because of a reader that is stuck: unsent messages are lost"
        _log.error(text, extra=about("ending"))
        sys.stderr.flush()
        os._exit(1)
    succeeded = outcome.result() is not False
    if signals[:1] == [signal.SIGINT]:
        raise typer.Exit(130)
    if not succeeded:
        raise typer.Exit(1)
