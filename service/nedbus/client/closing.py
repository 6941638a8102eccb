"""Finalizers: close what a script forgot, never in the thread that collects garbage, and before the process ends."""

from __future__ import annotations

import atexit
import ctypes
import logging
import os
import queue
import threading
import weakref
from collections.abc import Callable
from typing import Final

from nedbus.transport import is_forked

_log = logging.getLogger(__name__)

_DRAIN: Final = 2.0  # s that the end of a process waits for what is being closed
_pending: queue.SimpleQueue[Callable[[], object]] = queue.SimpleQueue()  # may be filled in the midst of anything
_owners: weakref.WeakSet[object] = weakref.WeakSet()
_start = threading.Lock()
_closer: list[threading.Thread] = []  # made when it is started: a fork marks a thread as stopped


class Finalizer:
    """Call `close` once: by `close_now`, when the owner is garbage, or at the end of the process.

    Garbage may be collected in any thread at any moment, also while that thread holds a lock that `close` needs, and
    closing waits for Zenoh: so a thread of its own closes then.
    `close` must not refer to the owner.
    """

    def __init__(self, owner: object, close: Callable[[], object]) -> None:
        self._close = close
        _owners.add(owner)
        self._finalize = weakref.finalize(owner, _close_later, close)
        with _start:
            if not _closer:
                _closer.append(threading.Thread(target=_run, name="nedbus-closer", daemon=True))
                _closer[0].start()

    @property
    def alive(self) -> bool:
        """True until it has been called."""
        return self._finalize.alive

    def close_now(self) -> None:
        """Close in this thread; a second call does nothing."""
        if self._finalize.detach():
            self._close()


def _close_later(close: Callable[[], object]) -> None:
    if is_forked():
        return  # the session belongs to the parent process
    if threading.main_thread().is_alive():
        _pending.put(close)
    else:  # the process ends, and does not wait for threads any more
        close()


def _run() -> None:
    while True:
        close = _pending.get()
        try:
            close()
        except Exception:  # noqa: BLE001 - what cannot be closed must not keep all else open
            _log.debug("something that was no longer referenced could not be closed", exc_info=True)


@atexit.register
def _drain() -> None:
    """Wait for the thread: one that is inside Zenoh when the interpreter ends aborts the process."""
    if _closer and _closer[0].is_alive():
        drained = threading.Event()
        _pending.put(drained.set)
        drained.wait(_DRAIN)


def _after_fork() -> None:
    """Never drop what a forked process inherited: Zenoh's objects hang when they are dropped there."""
    for owner in list(_owners):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(owner))


os.register_at_fork(after_in_child=_after_fork)
