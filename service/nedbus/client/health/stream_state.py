"""Stream state: ok, slow, stale, gone or disconnected, with the reason; no I/O."""

from dataclasses import dataclass
from typing import Final, Literal, get_args

from nedbus import clock
from nedbus.client.sample import Sample
from nedbus.events import to_age
from nedbus_msgs import Message, describe_flags

from .stream_health import Health, StreamHealth

StateName = Literal["disconnected", "gone", "stale", "duplicate", "slow", "ok"]  # worst first

_LATE: Final = 1.0  # s; a higher latency makes a stream slow
_SLOW: Final = 0.5  # share of the usual rate; a lower rate makes a stream slow
_ABSENT: Final = 1.0  # s without a message until a stream without a liveliness token is gone


@dataclass(frozen=True, slots=True)
class StreamState:
    """Current state of a stream, with a reason unless it is ok."""

    name: StateName
    reason: str = ""

    @property
    def severity(self) -> int:
        """Index among the states; 0 is the worst."""
        return get_args(StateName).index(self.name)

    def __str__(self) -> str:
        return f"{self.name}: {self.reason}" if self.reason else self.name


def stream_state(health: Health, *, publishers: int | None = None, connected: bool = True) -> StreamState:
    """Return the state of a stream with the given health.

    `publishers`: the number of publishers with a liveliness token; None if unknown.
    `connected`: True if there is a link to the router.
    """
    if not connected:
        return StreamState("disconnected", "no link")
    age = health.age
    if age is not None and age > _ABSENT and publishers == 0:
        return StreamState("gone", f"last message {to_age(age)} ago")
    if age is not None and age > health.stale_after:
        return StreamState("stale", f"nothing for {to_age(age)}")
    if publishers is not None and publishers > 1:
        return StreamState("duplicate", f"{publishers} publishers: stop one, or give it another vehicle")
    reasons = []
    usual = None if health.on_change else health.usual_rate
    if health.rate is not None and usual is not None and health.rate < _SLOW * usual:
        reasons.append(f"{health.rate:.1f} Hz, usually {usual:.0f}")
    if health.latency is not None and health.latency > _LATE:
        reasons.append(f"{to_age(health.latency)} late, or clocks differ")
    return StreamState("slow", ", ".join(reasons)) if reasons else StreamState("ok")


def describe_stream(health: Health, state: StreamState) -> str:
    """Describe the faults of a stream (state, flags, gaps, order and reboots) in one line; "ok" if there are none."""
    doubts = "ok" if health.flags is None else describe_flags(health.flags)
    counts = (health.gaps, "gaps"), (health.out_of_order, "out of order"), (health.reboots, "reboots")
    events = [f"{count} {name}" for count, name in counts if count and state.name != "duplicate"]
    return ", ".join([*(text for text in (str(state), doubts) if text != "ok"), *events]) or "ok"


def health_of_last(sample: Sample[Message]) -> Health:
    """Return the health of a stream with only its last message known; the age is by the wall clock."""
    stream = StreamHealth(sample.topic)
    stream.add(sample.message, received=0, missing=sample.missing)
    return stream.snapshot(0 if sample.sent is None else max(0, clock.utc_ns() - sample.sent))
