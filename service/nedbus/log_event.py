"""The complete list of log events, the structured data of a log record, and the log of unexpected errors."""

import logging
from collections.abc import Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Final

from nedbus_msgs import Address


@dataclass(frozen=True, slots=True)
class Event:
    """One kind of log event.

    `doc`: its meaning, for the manual.
    `limited`: rate-limited, because peers can trigger it at any rate. Lifecycle events of the process, and events that
    a backoff already limits, are always logged.
    """

    doc: str
    limited: bool = True


EVENTS: Final[Mapping[str, Event]] = {
    # the process
    "router": Event("a router listens, or ignores part of its configuration file", limited=False),
    "client": Event("the service connects to a router as a client", limited=False),
    "http": Event(
        "the HTTP server listens, is open to other hosts, or refuses a client", limited=False
    ),
    "setting": Event("an environment variable looks like a misspelled setting", limited=False),
    "reload": Event(
        "settings were reloaded (SIGHUP) or rejected, or a removed source stopped", limited=False
    ),
    "shutdown": Event("the process stops on a signal, or did not stop in time", limited=False),
    "notice": Event("a hint for a user at a terminal", limited=False),
    "error": Event(
        "a command failed and exits, or a subscription ended unexpectedly", limited=False
    ),
    "internal_error": Event(
        "a bug in nedbus: an unexpected error; one message, reply or page is skipped"
    ),
    "suppressed": Event(
        "`count` lines of the event `of` were suppressed by the rate limit", limited=False
    ),
    # a source
    "listening": Event("a live source is open and waits for messages", limited=False),
    "replay_opened": Event("a replay is open; the text summarizes its content", limited=False),
    "replay_waiting": Event("a replay waits for its first subscriber", limited=False),
    "damaged": Event("a file or a definition is damaged, or part of it is skipped", limited=False),
    "replay_late": Event(
        "a replay fell behind its schedule, and continues from there without catching up"
    ),
    "retrying": Event("a source failed, and restarts after a backoff", limited=False),
    "done": Event("a source has ended", limited=False),
    "failed": Event("a source has failed, and is not restarted", limited=False),
    "progress": Event("the number of messages that a source has published", limited=False),
    # a stream
    "published": Event("a live stream is published"),
    "stream_resumed": Event("a stale stream is published again"),
    "stale": Event("a live stream has received no message for 3 s, and is no longer published"),
    "topic_silent": Event(
        "a vehicle advertises a topic but sends no message on it, while other topics arrive"
    ),
    "rejected": Event(
        "a message from a source is not published, because it cannot be decoded or violates a rule"
    ),
    "duplicate": Event(
        "another process publishes the same vehicle, or two MAVLink senders share a system id"
    ),
    "rebooted": Event("a vehicle rebooted, or its publisher restarted"),
    "log_stream": Event(
        "the ULog stream of a vehicle starts, ends or is refused, or its file is opened or abandoned"
    ),
    "position": Event("a source sends positions from the bus into its vehicle", limited=False),
    "unsupported": Event(
        "a vehicle, a publisher or ROS 2 does not support a requested message or rate"
    ),
    "bridge_loop": Event(
        "a topic published by `nedbus ros2` is ignored, because it would loop back"
    ),
    # a reader
    "invalid": Event("a received message or reply cannot be decoded"),
    "newer_layout": Event("messages have a newer layout than this version of nedbus supports"),
    "dropped": Event(
        "a reader, a host, or the link to a vehicle is too slow, and messages are dropped"
    ),
    "incomplete": Event(
        "a limit or a timeout was reached: vehicles, streams or replies are missing"
    ),
    "slow_reader": Event("a lossless publisher waits for a slow reader, or stops waiting for it"),
    # a link
    "link_lost": Event("the link to a router is lost, or does not come up"),
    "link_up": Event("the link to a router is up, for the first time or again"),
    "access_denied": Event("the router's access rules drop the messages of a vehicle"),
    "access_granted": Event(
        "the router now accepts the messages of a vehicle, which it dropped before"
    ),
    # nedbus ros2
    "bridged": Event("a stream is published to ROS 2"),
    "conflict": Event(
        "a stream is not published to ROS 2, because another stream or node publishes its topic"
    ),
    "withdrawn": Event("a stream is no longer published to ROS 2"),
    "bridge_late": Event("messages arrived too late to be published to ROS 2"),
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
    event: str,
    address: Address | None = None,
    *,
    source: str | None = None,
    reason: str | None = None,
) -> dict[str, About]:
    """Return the `extra` of a log call: an event of EVENTS, with its stream, source and reason if known."""
    if address is None:
        return {"about": About(event, source=source, reason=reason)}
    return {"about": About(event, address.vehicle, address.topic, address.instance, source, reason)}


class UnexpectedErrors(AbstractContextManager[None]):
    """A context manager that survives every error of its block, and logs the first one with `text`.

    For the loops of threads: a panic of Zenoh or Pydantic is a BaseException, not an Exception. Ctrl-C and exit pass.
    """

    def __init__(self, log: logging.Logger, text: str, *args: object) -> None:
        self._log = log
        self._text = (text, *args)
        self._logged = False

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> bool:
        return error is not None and self.survives(error)

    def survives(self, error: BaseException) -> bool:
        """Log an error and return True; return False for Ctrl-C and exit."""
        if isinstance(error, KeyboardInterrupt | SystemExit):
            return False
        if self._logged:
            level = logging.DEBUG
        else:
            level = logging.ERROR
        self._log.log(level, *self._text, exc_info=error, extra=about("internal_error"))
        self._logged = True
        return True
