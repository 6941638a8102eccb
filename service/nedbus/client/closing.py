"""Finalizers: close unreferenced objects on a separate thread, and all open ones before the process exits."""

import atexit
import ctypes
import os
import signal
import threading
import time
import weakref
from collections.abc import Callable

from nedbus.transport import is_forked

from .io_thread import CallThread

_closer = CallThread("nedbus-closer")
_owners: weakref.WeakSet[object] = weakref.WeakSet()


def join_thread(thread: threading.Thread, timeout: float) -> None:
    """Wait up to `timeout` seconds for a thread to end, even if Ctrl-C interrupted its start and it has yet to run."""
    end = time.monotonic() + timeout
    while (left := end - time.monotonic()) > 0:
        try:
            thread.join(left)
        except RuntimeError:  # not started
            time.sleep(0.005)
        else:
            return


class Finalizer:
    """Call `close` once: from `close_now`, after garbage collection of the owner, or at process exit.

    Collected objects are closed on a separate thread, because closing waits for Zenoh, and the garbage collector runs
    on any thread, perhaps one that holds a lock `close` needs.
    `close` must not reference the owner.
    """

    def __init__(self, owner: object, close: Callable[[], object]) -> None:
        self._close = close
        _owners.add(owner)
        self._finalize = weakref.finalize(owner, _close_later, close)
        _closer.start()

    @property
    def alive(self) -> bool:
        """True until `close` has been called."""
        return self._finalize.alive

    def close_now(self) -> None:
        """Close on this thread; a second call does nothing."""
        if self._finalize.detach():
            self._close()


def _close_later(close: Callable[[], object]) -> None:
    if is_forked():
        return  # the session belongs to the parent process
    if threading.main_thread().is_alive():
        _closer.put(close)
    else:  # the process is exiting and no longer waits for threads
        _let_interrupts_kill()
        close()


@atexit.register
def _drain() -> None:
    """Wait for the closing thread: one that is still in Zenoh at interpreter exit aborts the process."""
    _let_interrupts_kill()
    _closer.drain(timeout=2.0)


def _let_interrupts_kill() -> None:
    """End the process at once on Ctrl-C, instead of leaving a bus open, and its threads in Zenoh, during its exit."""
    is_main = threading.current_thread() is threading.main_thread()
    if is_main and signal.getsignal(signal.SIGINT) is signal.default_int_handler:
        signal.signal(signal.SIGINT, signal.SIG_DFL)


def _after_fork() -> None:
    """Leak inherited objects in a forked process: dropping Zenoh's objects there would hang."""
    for owner in list(_owners):
        ctypes.pythonapi.Py_IncRef(ctypes.py_object(owner))


os.register_at_fork(after_in_child=_after_fork)
