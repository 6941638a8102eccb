"""The thinned copies of a stream: published beside it, on keys of their own, for readers who ask for at most so much.

`<key>/@rate/5` has at most 5 messages a second of `<key>`, with sequence numbers and a cache of their own: what is left
out is no gap, and what is lost is one. There is one for each of RATES, and only while somebody subscribes to it.
A vehicle of which nobody reads a thinned stream has one declaration for all of its streams, `Demand`; what a stream
declares more is declared when that one finds a reader.
"""

from __future__ import annotations

import math
import time
from contextlib import suppress
from typing import Final

import zenoh

from nedbus.transport import Session, while_open
from nedbus_msgs import ANY, Address

from .demand import Demand
from .qos import RATES, TOPIC_QOS
from .rate_gate import RateGate

HEARTBEAT: Final = 1.0  # s: how soon a reader learns that it missed the newest message
_CACHE: Final = 20.0  # s of messages that are kept for readers that missed some
_MIN_CACHE: Final = 20  # messages
_LINGER: Final = 60_000_000_000  # ns for which readers that are gone may come back, and get what they missed


class ThinnedStreams:
    """Publish the messages of one address thinned, to whoever subscribes to that.

    `vehicle` is the demand for any thinned stream of this vehicle. While it is wanted, or `opened`, each message is to
    be put here as well. For use from one thread at a time, that of the publisher.
    """

    def __init__(self, session: Session, address: Address, *, prefix: str, vehicle: Demand) -> None:
        self.vehicle = vehicle
        self.opened = False
        self._session = session
        self._address = address
        self._prefix = prefix
        self._demand: Demand | None = None  # for any rate of this address
        self._steps: list[_Step] = []

    def put(self, payload: bytes, stamp: zenoh.Timestamp, encoding: str) -> None:
        """Publish a message at the rates for which it is due; this never waits for a reader."""
        now = time.monotonic_ns()  # not the message's time: a replay at ten times the speed would fill a link
        if self._demand is None:
            self._demand = Demand(self._session, self._address.rate_key(ANY, prefix=self._prefix))
            self.opened = True
        wanted = self._demand.is_wanted()
        if wanted and not self._steps:
            self._steps = [_Step(self._session, self._address, rate, prefix=self._prefix) for rate in RATES]
        for step in self._steps:
            step.put(now, payload, stamp, encoding)
        if not wanted and not any(step.opened for step in self._steps):
            self._close_steps()
            if not self.vehicle.is_wanted():
                self.close()

    def close(self) -> None:
        """Withdraw all that is declared; a message that is put later declares it anew."""
        self._close_steps()
        if self._demand is not None:
            self._demand.close()
        self._demand = None
        self.opened = False

    def _close_steps(self) -> None:
        for step in self._steps:
            step.close()
        self._steps = []


class _Step:
    """One thinned stream; `opened` while it is published, or was a moment ago."""

    def __init__(self, session: Session, address: Address, rate: int, *, prefix: str) -> None:
        self._session = session
        self._priority = TOPIC_QOS[address.topic].priority
        self._key = address.rate_key(rate, prefix=prefix)
        self._rate = rate
        self._gate = RateGate(rate)
        self._demand = Demand(session, self._key)
        self._publisher: zenoh.ext.AdvancedPublisher | None = None
        self._token: zenoh.LivelinessToken | None = None  # so that routers know the key, as in Publisher
        self._wanted_at = 0

    @property
    def opened(self) -> bool:
        return self._publisher is not None

    def put(self, now: int, payload: bytes, stamp: zenoh.Timestamp, encoding: str) -> None:
        if self._demand.is_wanted():
            self._wanted_at = now
            if self._publisher is None:
                self._open()
        if self._publisher is None or not self._gate.passes(now):
            return
        if now - self._wanted_at > _LINGER:
            self._withdraw()
        else:
            # Without a reader this only fills the cache.
            self._publisher.put(payload, timestamp=stamp, encoding=encoding)

    def close(self) -> None:
        self._withdraw()
        self._demand.close()

    def _open(self) -> None:
        self._gate = RateGate(self._rate)
        misses = zenoh.ext.MissDetectionConfig(heartbeat=HEARTBEAT, sporadic_heartbeat=None)
        with while_open():
            self._token = self._session.liveliness().declare_token(self._key)
            self._publisher = zenoh.ext.declare_advanced_publisher(
                self._session,
                self._key,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=self._priority,
                cache=zenoh.ext.CacheConfig(max(_MIN_CACHE, math.ceil(_CACHE * self._rate))),
                sample_miss_detection=misses,
            )

    def _withdraw(self) -> None:
        with suppress(zenoh.ZError):  # closed already with the session
            if self._token is not None:
                self._token.undeclare()
        self._publisher = self._token = None  # dropped, not undeclared: see Publisher.close
