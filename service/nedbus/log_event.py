"""The closed list of log events, and the structured data of a log record: stream, source, reason."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from nedbus_msgs import Address


@dataclass(frozen=True, slots=True)
class Event:
    """One kind of log event.

    `doc`: its meaning, for the manual.
    `limited`: rate-limited, as a peer can cause it at any rate. Events of the process's own lifecycle, and those that
    its own pauses limit, are always logged.
    """

    doc: str
    limited: bool = True


EVENTS: Final[Mapping[str, Event]] = {
    # the process
    "router": Event("a router listens, or ignores part of its configuration file", limited=False),
    "client": Event("the service is a client of a router", limited=False),
    "http": Event("metrics, health or the page are served, and to which hosts; or too many clients", limited=False),
    "setting": Event("a setting or an environment variable looks wrong", limited=False),
    "reload": Event("SIGHUP was received: the changes, or the reason for none", limited=False),
    "ending": Event("the process stops on a signal, or fails to stop in time", limited=False),
    "notice": Event("information for a user at a terminal", limited=False),
    "error": Event("the command failed and exits", limited=False),
    "bug": Event("an unexpected error, a bug in nedbus; one message, answer or page is skipped"),
    "left-out": Event("`count` lines of the event `of` were left out", limited=False),
    # a source
    "listening": Event("a live source is open", limited=False),
    "opened": Event("a replay is open: its content", limited=False),
    "waiting": Event("a replay waits for its first reader", limited=False),
    "damaged": Event("a file is damaged, or part of it is left out", limited=False),
    "late": Event("a replay fell behind, and continues without catching up"),
    "retrying": Event("a source failed, and restarts after a pause", limited=False),
    "done": Event("a source has ended", limited=False),
    "failed": Event("a source has failed for good", limited=False),
    "progress": Event("the number of messages that a source has published", limited=False),
    # a stream
    "published": Event("a live stream is published"),
    "back": Event("a stale stream is published again"),
    "stale": Event("a live stream received no message for 3 s: it is no longer published"),
    "silent": Event("a vehicle announces a topic, but sends no messages on it while others arrive"),
    "rejected": Event("a message from a source is not published: it cannot be decoded, or violates a rule"),
    "duplicate": Event("another process publishes the same stream, or another MAVLink sender has the same system id"),
    "rebooted": Event("a vehicle rebooted"),
    "log-stream": Event("the ULog stream of a vehicle begins, ends or is refused, or its file is opened or given up"),
    "unsupported": Event("a vehicle does not send a requested message"),
    "looped": Event("a key comes from `nedbus ros2`, and is ignored"),
    # a reader
    "invalid": Event("a received message or answer cannot be decoded"),
    "newer-layout": Event("messages have a layout that is newer than this reader"),
    "described": Event("a message that nedbus has no file for is decoded as its publisher describes it"),
    "dropped": Event("a reader is slower than the data: messages are dropped"),
    "incomplete": Event("not all vehicles are known, or not all answers were kept"),
    "slow-reader": Event("a lossless publisher waits for a reader, or gives up on it"),
    # a link
    "link-broken": Event("the link to a router broke, or does not come up"),
    "link-back": Event("the link to a router is up, or up again"),
    "client-refused": Event("a router refuses a client, usually for its certificate"),
    "refused": Event("the router's access rules drop the messages of a vehicle"),
    "accepted": Event("the router accepts the messages of a vehicle that it refused before"),
    # nedbus ros2
    "bridged": Event("a stream is published in ROS 2"),
    "conflict": Event("a stream is not published in ROS 2: another stream or node has its topic"),
    "withdrawn": Event("a stream is no longer published in ROS 2"),
    "held-back": Event("messages were too late for ROS 2"),
}
"""All events logged above DEBUG, by stable name."""


@dataclass(frozen=True, slots=True)
class About:
    """Structured data of a log record, in its attribute `about`."""

    event: str
    vehicle: str | None = None
    topic: str | None = None
    instance: int | None = None
    source: str | None = None
    reason: str | None = None
    count: int | None = None
    of: str | None = None


def about(
    event: str, address: Address | None = None, *, source: str | None = None, reason: str | None = None
) -> dict[str, About]:
    """Return the `extra` of a log call: an event of EVENTS, with its stream, source and reason if known."""
    if address is None:
        return {"about": About(event, source=source, reason=reason)}
    return {"about": About(event, address.vehicle, address.topic, address.instance, source, reason)}
