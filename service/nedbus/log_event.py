"""The events of the log, a closed list, and the facts of one: stream, source and reason."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

from nedbus_msgs import Address


@dataclass(frozen=True, slots=True)
class Event:
    """One event.

    `doc`: its meaning, as in the manual.
    `limited`: a peer can cause it at any rate, so the log leaves lines out. A process's own life, and what its own
    pauses limit, is never left out.
    """

    doc: str
    limited: bool = True


EVENTS: Final[Mapping[str, Event]] = {
    # the process
    "router": Event("a router listens, or cannot do all that its file says", limited=False),
    "client": Event("the service is a client of a router", limited=False),
    "http": Event("metrics and health are served, and the hosts that can read them", limited=False),
    "setting": Event("a setting, or a variable of the environment, looks wrong", limited=False),
    "reload": Event("SIGHUP arrived: its changes, or the reason that there are none", limited=False),
    "ending": Event("a signal ends the process, or it cannot end in time", limited=False),
    "notice": Event("information for a person at a terminal", limited=False),
    "error": Event("the command cannot go on; it ends", limited=False),
    "bug": Event("something unexpected, a bug of nedbus; one message, answer or page is left out"),
    "left-out": Event("`count` lines of the event `of` were left out", limited=False),
    # a source
    "listening": Event("a live source is open", limited=False),
    "opened": Event("a replay is open: its content", limited=False),
    "waiting": Event("a replay waits for its first reader", limited=False),
    "damaged": Event("a file is damaged, or something of it is left out", limited=False),
    "late": Event("a replay is late, and goes on from where it is"),
    "retrying": Event("a source failed, and is started again after a pause", limited=False),
    "done": Event("a source has ended", limited=False),
    "failed": Event("a source has ended by a failure", limited=False),
    "progress": Event("the number of messages that a source has published", limited=False),
    # a stream
    "published": Event("a live stream is published"),
    "back": Event("a stale stream is published again"),
    "stale": Event("nothing arrived of a live stream for 3 s: it is no longer published"),
    "silent": Event("a vehicle announces a topic, and nothing of it arrives while others do"),
    "rejected": Event("a message from a source is not published: it cannot be read, or violates a rule"),
    "duplicate": Event("another process publishes the same stream"),
    "rebooted": Event("a vehicle rebooted"),
    "unsupported": Event("a vehicle does not send a message that was requested"),
    "looped": Event("a key comes from `nedbus ros2`, and is ignored"),
    # a reader
    "invalid": Event("a message or an answer that arrived cannot be read"),
    "newer-layout": Event("messages have a layout that is newer than this reader"),
    "described": Event("a message that has no file here is read as its publisher describes it"),
    "dropped": Event("a reader is slower than the data: messages are dropped"),
    "incomplete": Event("not all vehicles are known, or not all answers kept"),
    "slow-reader": Event("a lossless publisher waits for a reader, or gives it up"),
    # a link
    "link-broken": Event("the link to a router is broken, or does not come up"),
    "link-back": Event("the link to a router is up, or up again"),
    "client-refused": Event("a router refuses a client, for its certificate as a rule"),
    "refused": Event("access rules of the router drop the messages published of a vehicle"),
    "accepted": Event("the router accepts the messages of a vehicle that it refused before"),
    # nedbus ros2
    "bridged": Event("a stream is published in ROS 2"),
    "conflict": Event("a stream is not published in ROS 2: its topic is that of another one, or of another node"),
    "withdrawn": Event("a stream is no longer published in ROS 2"),
    "held-back": Event("messages were too late for ROS 2"),
}
"""Everything that is logged above DEBUG, by its stable name."""


@dataclass(frozen=True, slots=True)
class About:
    """The facts of a line besides its text; a log record carries them as `about`."""

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
    """Return the `extra` of a log call: an event of EVENTS, and where it happened and why, if known."""
    if address is None:
        return {"about": About(event, source=source, reason=reason)}
    return {"about": About(event, address.vehicle, address.topic, address.instance, source, reason)}
