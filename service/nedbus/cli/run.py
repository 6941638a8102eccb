"""Run the body of a command in a thread until it ends or a signal arrives; also works as PID 1 of a container."""

import gc
import logging
import os
import queue
import signal
import sys
import threading
from collections.abc import Callable
from concurrent.futures import Future
from contextlib import suppress
from types import FrameType
from typing import Final

import typer

from nedbus.log_event import about

_log = logging.getLogger("nedbus")

# s between a signal and a forced exit; systemd and Docker kill after 10 s
_END_TIMEOUT: Final = 8.0
# s for Zenoh to close a session: it waits 10 s for a peer that does not read
_CLOSE_TIMEOUT: Final = 1.6
_TICK: Final = 0.5  # s between two calls of `on_tick`
_HANGUP_PAUSE: Final = 0.2  # s; some shells forward SIGHUP before the terminal is closed


def run_until_stopped(
    body: Callable[[threading.Event], object],
    *,
    on_stop: Callable[[], object] = lambda: None,
    on_tick: Callable[[], object] = lambda: None,
    on_hangup: Callable[[], object] | None = None,
    closing: threading.Event | None = None,
) -> None:
    """Run `body` in a thread until it returns; Ctrl-C, SIGTERM or SIGHUP set its stop event.

    `on_stop` is called from the signal handler, `on_tick` twice a second from the main thread. `on_hangup` is called
    instead of stopping after a SIGHUP that does not come from a closed terminal. `nohup` keeps SIGHUP ignored.
    `body` sets `closing` when only its session is left to close, which has a shorter timeout.
    The main thread does not call Zenoh, so it handles signals at once even while Zenoh blocks.

    Raises typer.Exit with 130 after Ctrl-C, with 1 if the body returned False.
    """
    stop = threading.Event()
    closing = closing or threading.Event()
    outcome: Future[object] = Future()
    signals: list[int] = []
    hangup = threading.Event()
    changed: queue.SimpleQueue[None] = queue.SimpleQueue()  # `put` is reentrant

    def run() -> None:
        try:
            outcome.set_result(body(stop))
        except BaseException as exc:  # noqa: BLE001 - raised again below, in the main thread
            outcome.set_exception(exc)
        closing.set()
        changed.put(None)

    def end(number: int) -> None:
        if signals:
            os._exit(130 if number == signal.SIGINT else 1)  # the second signal exits at once
        signals.append(number)
        stop.set()
        on_stop()

    def on_signal(number: int, _: FrameType | None) -> None:
        if number == signal.SIGHUP:
            hangup.set()
        else:
            end(number)
        changed.put(None)

    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
            signal.signal(number, on_signal)
    on_terminal = _has_terminal()
    gc.freeze()  # modules live as long as the process, so collections need not examine them
    gc.set_threshold(10_000)  # by default, each read of a log or link is examined several times
    thread = threading.Thread(target=run, name="nedbus-run", daemon=True)
    thread.start()
    while thread.is_alive() and not signals:
        if hangup.is_set():
            hangup.clear()
            thread.join(_HANGUP_PAUSE)
            if signals:
                break
            if on_hangup is not None and _has_terminal() == on_terminal:
                on_hangup()
            else:
                end(signal.SIGHUP)
        on_tick()
        with suppress(queue.Empty):
            changed.get(timeout=_TICK)
    if signals:
        _log.info("stopping on %s", signal.Signals(signals[0]).name, extra=about("shutdown"))
    _await_end(thread, closing, signals)
    result = outcome.result()
    if signals and signals[0] == signal.SIGINT:
        raise typer.Exit(130)
    if result is False:
        raise typer.Exit(1)


def _await_end(thread: threading.Thread, closing: threading.Event, signals: list[int]) -> None:
    """Wait until the body has finished, then until its session is closed; log an error and exit on a timeout."""
    if closing.wait(_END_TIMEOUT):
        thread.join(_CLOSE_TIMEOUT)
        if not thread.is_alive():
            return
        reason = f"links not closed within {_CLOSE_TIMEOUT:g} s, exiting anyway: messages not yet sent on them are lost"
    else:
        reason = f"command still running {_END_TIMEOUT:g} s after the signal, exiting anyway: unfinished work is lost"
    _log.error(reason, extra=about("shutdown"))
    sys.stderr.flush()
    os._exit(130 if signals[0] == signal.SIGINT else 1)


def _has_terminal() -> bool:
    with suppress(OSError):
        os.close(os.open("/dev/tty", os.O_RDONLY | os.O_NOCTTY))
        return True
    return False
