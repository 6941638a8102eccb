"""Bridge from a bus to ROS 2: CDR over rmw_zenoh, in the px4_msgs layout of the ROS 2 workspace."""

import logging
import os
import threading
import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any, Final

import zenoh

from nedbus import Bus, Sample, Session, Subscription, clock, limits
from nedbus.errors import NedbusError, NoDataError
from nedbus.log_event import about
from nedbus.rmw_zenoh import (
    BRIDGED_ENCODING,
    NO_HASH,
    Attachment,
    PublisherToken,
    TopicKey,
    gid_of_token,
    node_token,
    px4_publishers_key_expr,
    token_keys,
    translate_zenoh_errors,
)
from nedbus.timings import TIMINGS
from nedbus_msgs import (
    BY_TOPIC,
    DEFAULT,
    RELEASES,
    Address,
    DecodeError,
    Definition,
    Layout,
    LayoutError,
    Message,
    Selection,
    dds_type,
    encode_with,
    get_topic,
    hash_of,
    ros2_type,
)

from .late_filter import LateFilter
from .ros2_arbiter import Decision, Ros2Arbiter

_log = logging.getLogger(__name__)

# s after which a withdrawn address is forgotten; longer than the 20 s of loss recovery
_ABSENCE: Final = 60.0
_REFUSALS: Final = {
    "conflict": "%s is not published to ROS 2, because %s already uses the topic /%s: set --namespace",
    "defer": "%s is not published to ROS 2, because node %s already publishes /%s",
}  # by action


class Ros2Bridge:
    """Publish addresses of a bus to ROS 2 nodes that use rmw_zenoh on the router of `session`.

    While a vehicle is published, `ros2 topic list` shows its topics as `/fmu/out/<topic>`, prefixed with a namespace
    (see `Ros2Arbiter`). The topic of an instance ends with its number, as in `estimator_local_position_0`; the first
    instance of `battery_status` and other topics of PX4's default list has no suffix.
    A topic that another node, such as PX4's Zenoh module, already publishes in the same layout is not published.

    `selection`: the addresses to publish, by default all; `layout`: a PX4 release or a layout.
    `hashed`: False for ROS 2 Humble, whose keys have no type hash.
    `observer`: a second session to the same router, to detect access control, which denies without an error.

    Raises LayoutError for an unknown layout, AddressError for a namespace that is invalid in ROS 2.
    """

    def __init__(
        self,
        bus: Bus,
        session: Session,
        *,
        observer: Session | None = None,
        selection: Selection | None = None,
        layout: str = RELEASES[-1],
        domain: int = 0,
        hashed: bool = True,
        namespaces: Mapping[str, str] | None = None,
    ) -> None:
        known = dict.fromkeys((*RELEASES, *DEFAULT.layouts))
        if layout not in known:
            raise LayoutError(f"unknown layout {layout!r}: choose from {', '.join(known)}")
        self._bus = bus
        self._session = session
        self._observer = observer
        self._selection = selection or Selection()
        self._layout = layout
        self._domain = domain
        self._types = _types_of(layout, hashed=hashed)
        self._zid = str(session.info.zid())
        self._node = f"nedbus_{os.getpid()}"
        self._arbiter = Ros2Arbiter(namespaces or {})
        self._late_filter = LateFilter()
        # withdrawal time [s]; the late filter still has its clock
        self._withdrawn: dict[Address, float] = {}
        self._publishers: dict[Address, _Ros2Publisher] = {}
        self._entities = 0  # entity ids used so far
        self._unsupported: dict[Address, None] = {}  # those logged, the oldest first
        # last sample of streams without a rate, kept until published
        self._held: dict[Address, Sample[Any]] = {}

    def run(self, stop: threading.Event) -> None:
        """Publish until `stop` is set.

        Raises ClosedError if the bus or the session is closed, NedbusError if access control hides the bridge.
        """
        key = node_token(self._domain, self._zid, self._node)
        with translate_zenoh_errors():
            token = self._session.liveliness().declare_token(key)
        try:
            if self._observer is not None:
                self._require_visible(self._observer, key, stop)
            with self._bus.subscribe(
                *self._selection.topics,
                vehicle=self._selection.vehicles,
                instance=self._selection.instance,
                mode="every",
            ) as subscription:
                self._forward(subscription, stop)
        finally:
            for address in list(self._publishers):
                self._close(address)
            token.undeclare()

    def _require_visible(self, observer: Session, token: str, stop: threading.Event) -> None:
        """Wait until the observer sees this node's token; raise NedbusError if the router hides it."""
        end = time.monotonic() + TIMINGS.token_visible
        while not stop.is_set() and not token_keys(observer, token, timeout=0.5):
            is_linked = observer.info.routers_zid() and self._session.info.routers_zid()
            if not is_linked:
                # Without a link, the timeout begins again.
                end = time.monotonic() + TIMINGS.token_visible
            elif time.monotonic() > end:
                raise NedbusError(
                    "no ROS 2 node sees this bridge, probably because the router's access control denies ROS 2's keys:"
                    " start ROS 2's router and set its endpoint with --to"
                )
            stop.wait(0.05)

    def _forward(self, subscription: Subscription[Any], stop: threading.Event) -> None:
        next_poll = 0.0
        while not stop.is_set():
            if time.monotonic() >= next_poll:
                self._poll()
                next_poll = time.monotonic() + TIMINGS.bridge_poll
            try:
                sample = subscription.receive(0.1)
            except NoDataError:
                continue
            # In a stream without a rate, a message is current until the next one.
            has_rate = get_topic(sample.topic).rate > 0
            if has_rate and not self._late_filter.admits(sample, arrived=time.monotonic_ns()):
                continue
            if sample.address in self._arbiter.published:
                self._put(sample)
            elif not has_rate and sample.topic in self._types:
                self._hold(sample)

    def _hold(self, sample: Sample[Any]) -> None:
        """Keep the last message of a stream without a rate until its topic is published."""
        is_full = len(self._held) >= limits.BRIDGED_STREAMS
        if is_full and sample.address not in self._held:
            address = next(iter(self._held))
            _log.debug("%s: dropped a message that waits for its ROS 2 topic", address)
            del self._held[address]
        self._held[sample.address] = sample

    def _poll(self) -> None:
        """Report late samples, query the bus and the ROS 2 nodes, and apply the decisions."""
        held_back = self._late_filter.report()
        if held_back:
            text = "%s; ROS 2 nodes would treat old messages as current"
            _log.warning(text, held_back, extra=about("bridge_late"))
        self._forget_withdrawn()
        addresses = [address for address in self._bus.publishers() if self._is_bridged(address)]
        is_linked = self._bus.connected and self._session.info.routers_zid()
        if not is_linked:
            return  # the replies are incomplete
        nodes = self._other_nodes()
        others = dict[Address, str]()
        for address in addresses:
            node = nodes.get(self._key(address))
            if node is not None:
                others[address] = node
        for decision in self._arbiter.update(addresses, others, now=time.monotonic()):
            self._apply(decision)

    def _forget_withdrawn(self) -> None:
        """Forget addresses that have been absent for a minute."""
        before = time.monotonic() - _ABSENCE
        ended = [address for address, since in self._withdrawn.items() if since < before]
        for address in ended:
            del self._withdrawn[address]
            self._held.pop(address, None)
            self._late_filter.forget(address)

    def _other_nodes(self) -> dict[TopicKey, str]:
        """Return the other nodes that publish PX4 messages, by their topic."""
        nodes = dict[TopicKey, str]()
        key_expr = px4_publishers_key_expr(self._domain)
        for text in token_keys(self._session, key_expr, timeout=0.5):
            with suppress(DecodeError):
                token = PublisherToken.parse(text)
                if token.session != self._zid:
                    nodes.setdefault(token.key, token.node)
        return nodes

    def _apply(self, decision: Decision) -> None:
        address = decision.address
        topic = decision.topic
        other = decision.other
        if decision.action == "publish":
            self._open(address)
            self._withdrawn.pop(address, None)
            definition, layout, _ = self._types[address.topic]
            text = "%s -> /%s, %s of layout %s"
            values = (address, topic, ros2_type(definition), layout.name)
            _log.info(text, *values, extra=about("bridged", address))
            if address in self._held:
                self._put(self._held.pop(address))
        elif decision.action in _REFUSALS:
            self._close(address)
            text = _REFUSALS[decision.action]
            _log.warning(text, address, other, topic, extra=about("conflict", address))
        else:
            self._close(address)
            # After a router restart the address soon returns, with the messages of the outage.
            self._withdrawn[address] = time.monotonic()
            text = "%s is no longer on the bus: /%s is withdrawn"
            _log.info(text, address, topic, extra=about("withdrawn", address))

    def _open(self, address: Address) -> None:
        key = self._key(address)
        self._entities += 1
        token = key.token("MP", self._zid, self._node, self._entities)
        with translate_zenoh_errors():
            publisher = self._session.declare_publisher(
                str(key),
                encoding=BRIDGED_ENCODING,
                congestion_control=zenoh.CongestionControl.DROP,
            )
            declared = self._session.liveliness().declare_token(token)
        self._publishers[address] = _Ros2Publisher(gid_of_token(token), publisher, declared)

    def _close(self, address: Address) -> None:
        publisher = self._publishers.pop(address, None)
        if publisher is not None:
            publisher.token.undeclare()
            publisher.publisher.undeclare()

    def _put(self, sample: Sample[Message]) -> None:
        publisher = self._publishers[sample.address]
        definition, layout, _ = self._types[sample.topic]
        fields = definition.downgrade(sample.message.__dict__, layout)
        payload = encode_with(definition, fields, layout)
        publisher.sequence += 1
        attachment = bytes(Attachment(publisher.sequence, clock.utc_ns(), publisher.gid))
        with translate_zenoh_errors():
            publisher.publisher.put(payload, attachment=attachment)

    def _key(self, address: Address) -> TopicKey:
        definition, _, type_hash = self._types[address.topic]
        name = dds_type(ros2_type(definition))
        return TopicKey(self._domain, self._arbiter.topic_of(address), name, type_hash)

    def _is_bridged(self, address: Address) -> bool:
        """Return whether an address is selected and the workspace has its message type; log a missing type once."""
        if not self._selection.matches(address):
            return False
        if address.topic in self._types:
            return True
        if address not in self._unsupported:
            if len(self._unsupported) >= limits.BRIDGED_STREAMS:
                oldest = next(iter(self._unsupported))
                del self._unsupported[oldest]
            self._unsupported[address] = None
            reason = "its px4_msgs type is unknown"
            if address.topic in BY_TOPIC:
                reason = f"PX4 {self._layout} has no such message"
            text = "%s is not published to ROS 2: %s"
            _log.warning(text, address, reason, extra=about("unsupported", address))
        return False


def _types_of(release: str, *, hashed: bool) -> dict[str, tuple[Definition[Any], Layout, str]]:
    """Return definition, layout and type hash by topic, for the messages that a release has."""
    types = dict[str, tuple[Definition[Any], Layout, str]]()
    for topic, definition in BY_TOPIC.items():
        layout = definition.layout_of_release(release)
        if layout is None:
            continue
        type_hash = NO_HASH
        if hashed:
            type_hash = hash_of(layout, ros2_type(definition))
        types[topic] = definition, layout, type_hash
    return types


@dataclass(slots=True, eq=False)
class _Ros2Publisher:
    gid: bytes
    publisher: zenoh.Publisher
    token: zenoh.LivelinessToken
    sequence: int = 0  # of the last message
