"""State machine for one vehicle's ULog stream: events in, commands out; no I/O, callers pass the time [s]."""

import math
from collections.abc import Mapping, Set
from typing import Final, Literal, NamedTuple

from pymavlink.dialects.v20 import common as dialect

from nedbus.sources.log_header import COUNT_PER_TOPIC, DEFAULT_COUNT, FIXED_COUNT, PROCESSING
from nedbus.timings import TIMINGS

COMMANDS: Final = {"start": dialect.MAV_CMD_LOGGING_START, "stop": dialect.MAV_CMD_LOGGING_STOP}

_TRIES: Final = 3  # transmissions of an unanswered command
_RESTARTS: Final = 2  # after START was accepted, but no data arrived
# TIMESYNC requests of a measurement; the shortest round trip counts, the others may have been queued
_PINGS: Final = 3
_MEASUREMENTS: Final = 3  # before the stream is refused, because a vehicle that boots answers late
# messages of a header before its duration is estimated, or fewer if they took `_MIN_TIME`
_MIN_COUNT: Final = 32
_MIN_TIME: Final = 1.0  # s
# consecutive LOGGING_DATA_ACKED before silence that mean STOP: PX4 then sends 44, else up to 2
_STOP_TAIL: Final = 10
_DECAY: Final = 0.98  # decay of the longest interval between messages, per message

LogReason = Literal[
    "not_px4", "armed", "taken", "bandwidth", "unsupported", "failed", "no_answer", "no_data", "slow_link", "stalled",
    "silent", "stopped_elsewhere", "link_lost", "unreadable", "left",
]  # fmt: skip
_TEXTS: Final[Mapping[LogReason, str]] = {
    "not_px4": "only PX4 has a ULog stream, and this autopilot is {}",
    "armed": "the vehicle is armed; the ULog stream starts after disarming, or in flight with log=armed",
    "taken": "PX4 rejected the ULog stream, because {} already receives it (log=take ends that client's stream)"
    " or PX4 logs to files only (set SDLOG_BACKEND to 3 and reboot the vehicle)",
    "bandwidth": "PX4 denied the ULog stream, because the rate of this MAVLink instance is below 5000 B/s; raise"
    " MAV_x_RATE, or option -r of `mavlink start`",
    "unsupported": "PX4 does not support the ULog stream on this link; update its firmware",
    "failed": "PX4 did not start the ULog stream, and answered MAV_CMD_LOGGING_START with {}",
    "no_answer": "PX4 does not answer MAV_CMD_LOGGING_START; if its logger is not running, set SDLOG_BACKEND to 3"
    " and reboot the vehicle",
    "no_data": "PX4 accepted MAV_CMD_LOGGING_START, but sends no data; if another link receives the stream, stop it"
    " there, or reboot the vehicle",
    "slow_link": "the header of the ULog stream would take {:.0f} s, at {:.0f} ms for each acknowledged message, and"
    " block PX4's logger meanwhile; {:.0f} s are allowed, enough for {}; use a link with a shorter round trip, or set"
    " header={:.0f}",
    "stalled": "the header of the ULog stream stalled for {:.1f} s; PX4 may not receive the acknowledgements",
    "silent": "the ULog stream seems to have ended; no data arrived for {:.1f} s",
    "stopped_elsewhere": "PX4 stopped the ULog stream, probably because another client requested it; it is requested"
    " again {}",
    "link_lost": "no message arrived from the vehicle for {:.1f} s; the link seems to be lost",
    "unreadable": "the ULog stream cannot be read, because {}",
    "left": "the ULog stream of the armed vehicle continues, for the next process",
}
_REFUSALS: Final[Mapping[int, LogReason]] = {
    dialect.MAV_RESULT_TEMPORARILY_REJECTED: "taken",
    dialect.MAV_RESULT_DENIED: "bandwidth",
    dialect.MAV_RESULT_UNSUPPORTED: "unsupported",
}
_SLOW_RETRY: Final[Set[LogReason | None]] = {
    "bandwidth", "unsupported", "slow_link", "stalled", "no_data", "unreadable",
}  # fmt: skip
"""Reasons that hardly end by themselves: START is retried later."""
LogState = Literal[
    "idle",
    "waiting_for_disarm",
    "starting",
    "header",
    "streaming",
    "refused",
    "ended",
    "stopping",
    "stopped",
]


class LogStatus(NamedTuple):
    """State of the stream, its cause, and a description for the log.

    `idle`: before the first heartbeat. `starting`: a command is pending. `header`, `streaming`: data arrives.
    `waiting_for_disarm`, `refused`, `ended`: START is retried when allowed. `stopping`, `stopped`: after `stop`.
    """

    state: LogState
    reason: LogReason | None = None
    text: str = ""


class Command(NamedTuple):
    """A message to send: a command to the autopilot, LOGGING_ACK with this sequence, TIMESYNC with this time [ns]."""

    kind: Literal["start", "stop", "acknowledge", "ping"]
    sequence: int = 0


class LogStreamClient:
    """Request the stream, acknowledge it, and detect its end, which PX4 does not announce.

    Pass every event to its method, call `tick` several times a second, and send the returned commands at once.
    Log `status` when it changes; repeated attempts with the same outcome do not change it.

    `log`: "armed" allows START in flight; "take" allows STOP of another client's stream, once until the next reboot.
    Without "take", a rejected client stops only a stream addressed to its own ids, left by an earlier process.
    `system`, `component`: the MAVLink ids of this client. `header`: the longest header [s]; None for the default.
    `header_seconds`: duration of the last header; None until it is complete.
    """

    def __init__(
        self,
        log: Set[Literal["1", "armed", "take"]],
        *,
        system: int,
        component: int,
        header: float | None = None,
    ) -> None:
        self._log = log
        self._ids = (system, component)
        self._longest_header = header
        self._owner = "another client"
        self.header_seconds: float | None = None
        self._is_px4 = False
        self._armed = False
        self._is_left = False
        self._reset()

    def _reset(self) -> None:
        self.status = LogStatus("idle")
        self._unreadable = ""  # reason given to `reject`, until the next `tick`
        self._awaited: Literal["pong", "start", "stop", "data"] | None = None
        self._pings: set[int] = set()  # times of unanswered TIMESYNC requests [ns]
        self._round_trips: list[float] = []  # since the first measurement [s]
        self._measurements = 0  # of the link, since START became due
        self._expected_count = DEFAULT_COUNT  # messages of the next header
        self._due = 0.0  # deadline of the awaited event, or else time of the next START
        self._tries = 0
        self._restarts = 0
        self._has_sent_command = False
        self._took_over = False
        self._has_header = False  # definitions of the current stream have arrived, at least in part
        self._header_messages = 0
        self._header_start = 0.0
        self._acked_in_row = 0
        self._interval = 0.0  # longest recent time between messages
        # longest pause in the header, not part of the round trip: it may be a burst of losses
        self._header_pause = 0.0
        self._last_heartbeat = -math.inf
        self._last_data = -math.inf
        self._last_acked = -math.inf
        self._sequence = -1

    def accepts(self, target_system: int, target_component: int) -> bool:
        """Return whether LOGGING_DATA or LOGGING_DATA_ACKED is for this client."""
        is_for_us = (target_system, target_component) == self._ids
        if not is_for_us and target_system:
            self._owner = f"system {target_system} component {target_component}"
            if self.status.reason == "taken":
                self.status = self.status._replace(text=_TEXTS["taken"].format(self._owner))
        return self._has_sent_command and is_for_us

    def on_heartbeat(self, autopilot: int, now: float, *, armed: bool) -> list[Command]:
        """Handle a HEARTBEAT of the autopilot; `autopilot`: MAV_AUTOPILOT."""
        self._is_px4 = autopilot == dialect.MAV_AUTOPILOT_PX4
        self._armed = armed
        self._last_heartbeat = now
        if not self._is_px4 and self.status.state == "idle":
            self._enter("refused", "not_px4", now, _name("MAV_AUTOPILOT", autopilot))
        elif self.status.reason == "link_lost":
            self._resume(now)  # PX4 continues to stream without a client
        return self.tick(now)

    def adopt(self, now: float) -> None:
        """Continue a stream of an earlier process that is addressed to this client, and whose definitions are known."""
        self._awaited = None
        self._has_header = True
        self._has_sent_command = True
        self._resume(now)

    def leave(self) -> None:
        """Let `stop` leave the stream of an armed vehicle running; like `reject`, may be called on any thread."""
        self._is_left = True

    def on_reboot(self) -> None:
        """Handle a reboot of the vehicle, which ends the stream."""
        if self.status.state not in ("stopping", "stopped"):
            self._reset()

    def on_data(self, sequence: int, now: float, *, acked: bool, begins: bool) -> list[Command]:
        """Handle a message that `accepts` accepted; `acked`: LOGGING_DATA_ACKED; `begins`: `Chunk.begins`."""
        is_new = sequence != self._sequence
        self._sequence = sequence
        self._interval = max(now - self._last_data, _DECAY * self._interval)
        self._last_data = now
        if not acked:
            self._acked_in_row = 0
        elif is_new:
            self._acked_in_row += 1
        commands = list[Command]()
        if acked and not self._is_aborting:
            commands.append(Command("acknowledge", sequence))
        if self._is_ending:
            return commands
        state, reason, _ = self.status
        if begins:
            self._begin_header(now)
        elif state == "header" and not acked:
            self._end_header(now)
        elif state == "header" and is_new:
            return self._continue_header(now) or commands
        elif state in ("refused", "ended") and self._has_header:
            self._awaited = None
            self._enter("streaming", None, now)
        elif reason == "taken" and self._may_start() and not self._took_over:
            commands += self._take_over(now)
        return commands

    @property
    def _is_aborting(self) -> bool:
        """True while PX4 shall stop a header, which it does only if an acknowledgement is missing."""
        return self._awaited == "stop" and self.status.reason in ("slow_link", "unreadable")

    @property
    def _is_ending(self) -> bool:
        """True while data changes nothing, because the stream was stopped, or shall be."""
        if self._awaited == "stop" or self.status.state in ("stopping", "stopped"):
            return True
        return self._awaited is None and self.status.reason == "unreadable"

    def on_command_ack(
        self, command: int, result: int, target_system: int, target_component: int, now: float
    ) -> list[Command]:
        """Handle a COMMAND_ACK of the autopilot; ignore it unless it answers this client's command."""
        # 0, 0: without target ids
        is_for_us = (target_system, target_component) in (self._ids, (0, 0))
        if not is_for_us or self._awaited is None or command != COMMANDS.get(self._awaited):
            return []
        if result == dialect.MAV_RESULT_IN_PROGRESS:
            self._due = now + TIMINGS.log_answer
        elif self._awaited == "start":
            return self._on_start_result(result, now)
        else:
            self._end_stop(now)
        return []

    def on_timesync(self, sent: int, now: float) -> list[Command]:
        """Handle an answer to TIMESYNC; ignore it unless it answers this client's request, sent at this time [ns]."""
        if sent not in self._pings or self._awaited != "pong":
            return []
        self._pings.remove(sent)
        self._round_trips.append(now - sent / 1e9)
        if self._tries < _PINGS:
            return self._ping(now)
        return self._start(now)

    def tick(self, now: float) -> list[Command]:
        """Return the commands that are due."""
        if self._unreadable and self.status.state in ("header", "streaming"):
            self._has_header = False
            self._enter("refused", "unreadable", now, self._unreadable)
            self._unreadable = ""
            return self._send("stop", now)
        state = self.status.state
        is_receiving = state in ("header", "streaming")
        silence = now - max(self._last_heartbeat, self._last_data)
        is_lost = silence > TIMINGS.log_link
        if is_lost and is_receiving:
            self._lose_link(silence, now)
            return []
        if self._awaited is not None:
            return self._on_timeout(now, is_lost=is_lost) if now >= self._due else []
        if is_receiving:
            return self._check_silence(now)
        if state in ("stopping", "stopped") or not self._is_px4 or is_lost or now < self._due:
            return []
        return self._begin_start(now)

    def _begin_start(self, now: float) -> list[Command]:
        state = self.status.state
        if self._may_start():
            if state in ("idle", "waiting_for_disarm"):
                self._enter("starting", None, now)
            return self._ping(now)
        if state in ("idle", "starting"):
            self._enter("waiting_for_disarm", "armed", now)
        return []

    def _lose_link(self, silence: float, now: float) -> None:
        """End the stream; PX4 continues it without a client, but gives up on a header."""
        self._awaited = None
        self._has_header = self.status.state == "streaming"
        self._enter("ended", "link_lost" if self._has_header else "stalled", now, silence)

    def reject(self, reason: str) -> None:
        """Stop the current stream, which cannot be read; unlike most methods, may be called on any thread."""
        self._unreadable = reason

    def stop(self, now: float) -> list[Command]:
        """End this client's stream; call `on_data`, `on_command_ack` and `tick` until the state is `stopped`."""
        if self._awaited == "pong":
            self._awaited = None
        if self._is_left and self._armed and self.status.state == "streaming":
            self._enter("stopped", "left", now)
            return []
        is_ours = self.status.state in ("header", "streaming") or self._awaited == "data"
        self._enter("stopping" if is_ours or self._awaited else "stopped", None, now)
        return self._send("stop", now) if is_ours else []

    def _may_start(self) -> bool:
        return not self._armed or "armed" in self._log

    def _enter(
        self, state: LogState, reason: LogReason | None, now: float, *values: object
    ) -> None:
        """Change the state, and set the time of the next START unless an answer is awaited."""
        if (state, reason) != self.status[:2]:
            if reason == "taken":
                values = (self._owner,)
            text = _TEXTS[reason].format(*values) if reason else ""
            self.status = LogStatus(state, reason, text)
        if self._awaited is not None:
            return
        self._due = now
        if reason in _SLOW_RETRY:
            self._due += TIMINGS.log_slow_retry
        elif state in ("refused", "ended"):
            self._due += TIMINGS.log_retry

    def _send(self, kind: Literal["start", "stop"], now: float, *, tries: int = 0) -> list[Command]:
        self._awaited = kind
        self._tries = tries + 1
        self._has_sent_command = True
        self._due = now + TIMINGS.log_answer
        if kind == "start":
            self._due = now + TIMINGS.log_answer * 2**tries
        return [Command(kind)]

    def _ping(self, now: float) -> list[Command]:
        """Measure the round trip, before START."""
        ping = round(now * 1e9)
        if self._awaited != "pong":
            self._tries = 0
            self._pings.clear()
            if not self._measurements:
                self._round_trips = []
        self._awaited = "pong"
        self._tries = self._tries + 1
        self._due = now + TIMINGS.log_answer
        self._pings.add(ping)
        return [Command("ping", ping)]

    def _start(self, now: float) -> list[Command]:
        """Send START, unless the header would take too long; without an answer to TIMESYNC, START will show it.

        A vehicle that boots, or a busy link, answers late: the link is measured several times before the stream is
        refused, and again while it waits.
        """
        self._awaited = None
        if not self._may_start():
            return []
        interval = min(self._round_trips, default=0.0) + PROCESSING
        self._measurements += 1
        is_slow = self._expected_count * interval > self._limit
        if is_slow and self._measurements < _MEASUREMENTS:
            self._due = now + TIMINGS.log_measure
            return []
        self._measurements = 0
        if not self._allows(self._expected_count, interval, now):
            self._due = now + TIMINGS.log_measure_again
            return []
        return self._send("start", now)

    @property
    def _limit(self) -> float:
        """The longest header [s]."""
        return self._longest_header or TIMINGS.log_header

    def _allows(self, count: int, interval: float, now: float, elapsed: float = 0.0) -> bool:
        """Return whether the header may take as long as `count` more messages need; if not, refuse the stream."""
        limit = self._limit
        expected = elapsed + count * interval
        if expected <= limit:
            return True
        topics = 0
        if interval:
            topics = int((limit / interval - FIXED_COUNT) / COUNT_PER_TOPIC)
        fit = "none, because of the vehicle's parameters alone"
        if topics > 0:
            fit = f"the header of {topics} topics"
        self._has_header = False
        remedy = math.ceil(1.2 * expected)
        values = (expected, 1e3 * interval, limit, fit, remedy)
        self._enter("refused", "slow_link", now, *values)
        return False

    def _end_stop(self, now: float) -> None:
        self._awaited = None
        state, reason, _ = self.status
        self._enter("stopped" if state == "stopping" else state, reason, now)
        self._due = max(self._due, now + TIMINGS.log_timeout)

    def _take_over(self, now: float) -> list[Command]:
        """Send STOP now, and START after its acknowledgement or timeout."""
        self._took_over = True
        self._has_header = False
        self._enter("starting", None, now)
        return self._send("stop", now)

    def _resume(self, now: float) -> None:
        """Assume that a silent stream continues, until `_check_silence` finds that it does not."""
        self._last_data = now
        self._acked_in_row = 0
        self._enter("streaming", None, now)

    def _begin_header(self, now: float) -> None:
        self._awaited = None
        self._has_header = True
        self._restarts = 0
        self.header_seconds = None
        self._unreadable = ""
        self._header_start = now
        self._header_messages = 1
        self._header_pause = 0.0
        self._last_acked = now
        self._interval = 0.0
        self._enter("header", None, now)

    def _end_header(self, now: float) -> None:
        self.header_seconds = self._last_acked - self._header_start
        self._expected_count = self._header_messages
        self._acked_in_row = 0
        self._enter("streaming", None, now)

    def _continue_header(self, now: float) -> list[Command]:
        """Count a message of the header; stop a stream whose header takes too long, or is expected to."""
        self._header_pause = max(now - self._last_acked, self._header_pause)
        self._last_acked = now
        self._header_messages += 1
        count = self._header_messages
        elapsed = now - self._header_start
        interval = (elapsed - self._header_pause) / max(1, count - 2)
        remaining = 0
        if count >= _MIN_COUNT or elapsed >= _MIN_TIME:
            remaining = max(0, self._expected_count - count)
        if self._allows(remaining, interval, now, elapsed):
            return []
        return self._send("stop", now)

    def _on_start_result(self, result: int, now: float) -> list[Command]:
        self._awaited = None
        is_accepted = result == dialect.MAV_RESULT_ACCEPTED
        is_taken = result == dialect.MAV_RESULT_TEMPORARILY_REJECTED
        if self.status.state == "stopping":
            if is_accepted:
                return self._send("stop", now)
            self._enter("stopped", None, now)
        elif is_accepted:
            self._await_data(now)
        elif is_taken and self._has_header:
            self._keep_stream(now)
        elif is_taken and "take" in self._log and not self._took_over:
            return self._take_over(now)
        else:
            reason = _REFUSALS.get(result, "failed")
            self._enter("refused", reason, now, _name("MAV_RESULT", result))
        return []

    def _await_data(self, now: float) -> None:
        """PX4 begins a new stream."""
        if self.status.state in ("header", "streaming"):
            self._enter("starting", "silent", now, now - self._last_data)
        elif self.status.reason != "no_data":  # "no_data" stays while START is retried
            self._enter("starting", None, now)
        self._awaited = "data"
        self._has_header = False
        self._due = now + TIMINGS.log_answer

    def _keep_stream(self, now: float) -> None:
        """PX4 still has the stream, which is slow."""
        if self.status.state == "header":
            self._end_header(now)
        elif self.status.state != "streaming":
            self._resume(now)
        self._due = now + self._silence_limit()

    def _on_timeout(self, now: float, *, is_lost: bool) -> list[Command]:
        state = self.status.state
        awaited = self._awaited
        self._awaited = None
        may_repeat = self._tries < _TRIES
        if awaited == "stop":
            if may_repeat:
                return self._send("stop", now, tries=self._tries)
            self._end_stop(now)
        elif state == "stopping":  # START was not answered, so there is no stream to stop
            self._enter("stopped", None, now)
        elif is_lost:
            self._cancel_start(now)
        elif awaited == "pong":
            self._awaited = "pong"
            return self._ping(now) if may_repeat else self._start(now)
        elif awaited == "data":
            self._restart(now)
        elif not self._may_start():
            self._cancel_start(now)
        elif may_repeat:
            return self._send("start", now, tries=self._tries)
        elif state in ("header", "streaming"):
            reason: LogReason = "stalled" if state == "header" else "silent"
            self._enter("ended", reason, now, now - self._last_data)
        else:
            self._enter("refused", "no_answer", now)
        return []

    def _cancel_start(self, now: float) -> None:
        if self.status.state == "starting":
            self._enter("idle", None, now)

    def _restart(self, now: float) -> None:
        """Repeat an accepted START without data, which may go to another client.

        Therefore no STOP is sent; without acknowledgements PX4 gives up.
        """
        self._restarts += 1
        if self._restarts > _RESTARTS:
            self._enter("refused", "no_data", now)
            return
        self._enter("starting", None, now)
        self._due = now + TIMINGS.log_timeout

    def _silence_limit(self) -> float:
        """Return the silence after which the stream may have ended [s]."""
        return min(max(TIMINGS.log_silence, 3 * self._interval), TIMINGS.log_longest_silence / 2)

    def _check_silence(self, now: float) -> list[Command]:
        """Probe a silent stream with START: PX4 rejects it and continues, or begins a new stream."""
        silence = now - self._last_data
        since_acked = now - self._last_acked
        if self.status.state == "header":
            only_repeats = since_acked - silence > TIMINGS.log_silence
            if since_acked > TIMINGS.log_timeout and only_repeats:
                self._has_header = False
                self._enter("ended", "stalled", now, since_acked)
                return []
        elif self._acked_in_row >= _STOP_TAIL and silence > TIMINGS.log_silence:
            self._has_header = False
            again = f"in {TIMINGS.log_retry:.0f} s" if self._may_start() else "after disarming"
            self._enter("ended", "stopped_elsewhere", now, again)
            return []
        limit = self._silence_limit()
        if not self._may_start():
            if silence > max(TIMINGS.log_timeout, 2 * limit):
                self._enter("ended", "silent", now, silence)
                self._due = now
        elif silence > TIMINGS.log_longest_silence:
            self._has_header = False
            self._enter("refused", "taken", now)
        elif silence > limit and self._last_heartbeat > self._last_data and now >= self._due:
            return self._send("start", now)
        return []


def _name(enum: str, number: int) -> str:
    entry = dialect.enums[enum].get(number)
    return entry.name if entry else f"{enum} {number}"
