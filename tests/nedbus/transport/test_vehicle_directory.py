"""The vehicle directory: a look at the publishers waits no longer than its timeout, also for another thread."""

import threading
from concurrent.futures import ThreadPoolExecutor

import pytest

from nedbus.transport import LivelinessTokens, Session, VehicleDirectory
from nedbus_msgs import Address, Selection
from tests.flights.messages import VLP
from tests.waits import DEADLINE


@pytest.mark.parametrize("timeout", [-1.0, 0.0, 0.01])
def test_look_does_not_wait_for_a_thread_that_lists(zenoh_session: Session, timeout: float) -> None:
    """While another thread lists, a look returns the last list, incomplete before the first one."""
    listing, connected = threading.Event(), threading.Event()

    def follow() -> LivelinessTokens:
        listing.set()
        assert connected.wait(DEADLINE)
        return LivelinessTokens(zenoh_session, *Selection().alive_key_exprs(prefix="nedbus"))

    token = zenoh_session.liveliness().declare_token(f"nedbus/1/@alive/0/{VLP}")
    directory = VehicleDirectory(follow, prefix="nedbus")
    with ThreadPoolExecutor(1) as threads:
        listed = threads.submit(directory.publishers, timeout=DEADLINE)
        assert listing.wait(DEADLINE)
        before = directory.publishers(timeout=timeout)
        assert not listed.done()
        connected.set()
        assert not before
        assert not before.complete
        assert listed.result(DEADLINE) == {Address("1", VLP): 1}
    with directory._lock:  # another thread polls
        after = directory.publishers(timeout=timeout)
    assert after == {Address("1", VLP): 1}
    assert after.complete
    directory.close()
    token.undeclare()
