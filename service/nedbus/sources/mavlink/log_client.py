"""Client of PX4's ULog stream for one vehicle, as a state machine: events in, messages to send out; no I/O, no clock.

Times are monotonic seconds of the caller's clock.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Set
from dataclasses import dataclass
from typing import Final, Literal, NamedTuple

from pymavlink.dialects.v20 import common as dialect

_TRIES: Final = 3  # of a command without an answer
_RESTARTS: Final = 2  # times that STOP and START follow a START that was accepted without data
_JUDGED: Final = 32  # messages of the header whose round trips are enough to judge the link
_EXPECTED_MESSAGES: Final = 400  # of a header; 274 to 410 were seen
_STOP_TAIL: Final = 10  # LOGGING_DATA_ACKED in a row before silence: PX4 sends 44 when it is stopped, and seldom 2 else
_DECAY: Final = 0.98  # of the longest interval between messages, at each message
_COMMANDS: Final = {"start": dialect.MAV_CMD_LOGGING_START, "stop": dialect.MAV_CMD_LOGGING_STOP}


@dataclass(frozen=True, slots=True)
class LogStreamTimes:
    """Times of the protocol [s].

    `answer`: wait for a COMMAND_ACK, doubled for each repetition of START.
    `first_data`: wait for LOGGING_DATA_ACKED after START was accepted.
    `pause`: between STOP and START; PX4 gives up an unacknowledged message after as long.
    `stall`: wait for the next LOGGING_DATA_ACKED of a header.
    `silence`: without LOGGING_DATA, after which PX4 is asked, or three times the interval between them if longer.
    `longest_silence`: of a stream that exists: its synchronisation records alone (22 B/s) fill a message in 11.3 s.
    `link`: without any message of the vehicle, after which the link is considered lost.
    `retry`, `slow_retry`: between attempts, after refusals that may pass, and after those that configuration causes.
    `header`: maximum duration of the header; the vehicle's own log has a hole of the same length.
    """

    answer: float = 1.0
    first_data: float = 1.0
    pause: float = 2.5
    stall: float = 2.5
    silence: float = 1.0
    longest_silence: float = 15.0
    link: float = 3.0
    retry: float = 30.0
    slow_retry: float = 300.0
    header: float = 10.0


LogReason = Literal[
    "not_px4", "armed", "taken", "bandwidth", "unsupported", "failed", "no_answer", "no_data", "slow_link", "stalled",
    "silent", "stopped_elsewhere", "link_lost",
]  # fmt: skip
"""Cause of a state: keys of the texts below."""

_TEXTS: Final[Mapping[LogReason, str]] = {
    "not_px4": "only PX4 streams its ULog, and this autopilot is {}",
    "armed": "the vehicle is armed; the ULog stream starts once it is disarmed, or in flight with log=armed",
    "taken": "PX4 rejected the ULog stream: another client has it (log=take ends that client's stream), or PX4 logs to"
    " files only (set SDLOG_BACKEND to 3 and reboot the vehicle)",
    "bandwidth": "PX4 denied the ULog stream: the rate of this MAVLink instance is below 5000 B/s; raise MAV_x_RATE, or"
    " option -r of `mavlink start`",
    "unsupported": "PX4 does not support the ULog stream on this link; update its firmware",
    "failed": "PX4 answered MAV_CMD_LOGGING_START with {}",
    "no_answer": "PX4 does not answer MAV_CMD_LOGGING_START: its logger does not run; set SDLOG_BACKEND to 3 and reboot"
    " the vehicle",
    "no_data": "PX4 accepted MAV_CMD_LOGGING_START, but sends nothing: the stream may be bound to another link; stop it"
    " there or reboot the vehicle",
    "slow_link": "the header of the ULog stream would take {:.0f} s at {:.0f} ms per acknowledged message, and blocks"
    " PX4's logger for as long; use a link with a shorter round trip",
    "stalled": "the header of the ULog stream stalled for {:.1f} s: PX4 does not receive the acknowledgements",
    "silent": "the ULog stream ended: no LOGGING_DATA for {:.1f} s",
    "stopped_elsewhere": "another client stopped the ULog stream",
    "link_lost": "no message from the vehicle for {:.1f} s",
}


_REFUSALS: Final[Mapping[int, LogReason]] = {
    dialect.MAV_RESULT_TEMPORARILY_REJECTED: "taken",
    dialect.MAV_RESULT_DENIED: "bandwidth",
    dialect.MAV_RESULT_UNSUPPORTED: "unsupported",
}

LogState = Literal[
    "idle", "waiting_for_disarm", "starting", "header", "streaming", "refused", "ended", "stopping", "stopped"
]


class LogStatus(NamedTuple):
    """State of the stream, with its cause and a text for the log; they change only together.

    `idle`: no heartbeat yet, or none since a reboot. `waiting_for_disarm`, `refused`: START follows later.
    `starting`: commands are under way. `header`, `streaming`: data arrive.
    `ended`: the stream is over, or seems to be; it is started again as the policy allows.
    `stopping`, `stopped`: after `stop`.
    """

    state: LogState
    reason: LogReason | None = None
    text: str = ""


class Command(NamedTuple):
    """A message to send: a command to the autopilot, or LOGGING_ACK with this sequence."""

    kind: Literal["start", "stop", "acknowledge"]
    sequence: int = 0


class LogStreamClient:
    """Requests the ULog stream of one vehicle, acknowledges it, and notices its end.

    Pass every event to the method for it, and call `tick` several times a second; send the returned commands at once.
    Log `status` when it changes: repeated attempts do not change it while their outcome is the same.

    `log`: "armed" allows the start in flight. "take" allows to end the stream of another client, once until the vehicle
    reboots. Without it, the only stream that is ended to start anew, once as well, is one to `system` and `component`
    themselves whose header was missed: that of an earlier process with the same ids.
    `system`, `component`: the MAVLink ids of this client.

    `rejected`: LOGGING_DATA to other ids or from a vehicle that was not asked.
    `header_seconds`, `round_trip`: duration of the last header, and of its average message [s]; None before.
    """

    def __init__(
        self,
        log: Set[Literal["1", "armed", "take"]],
        *,
        system: int,
        component: int,
        times: LogStreamTimes = LogStreamTimes(),
    ) -> None:
        self._log, self._ids, self._times = log, (system, component), times
        self.rejected = 0
        self.header_seconds: float | None = None
        self.round_trip: float | None = None
        self._is_px4 = self._armed = False
        self._reset()

    def _reset(self) -> None:
        """Forget the stream, before the first one and after a reboot."""
        self.status = LogStatus("idle")
        self._asked = self._took_over = False
        self._has_definitions = False  # of the current stream: it began with its header
        self._acknowledges = True
        self._awaited: Literal["start", "stop", "data"] | None = None
        self._deadline = self._next_start = 0.0
        self._tries = self._restarts = 0
        self._last_heartbeat = self._last_data = self._last_acked = self._quiet_since = -math.inf
        self._header_start = self._interval = 0.0
        self._header_messages = self._acked_in_row = 0
        self._sequence = -1

    def accepts(self, target_system: int, target_component: int) -> bool:
        """Return whether LOGGING_DATA or LOGGING_DATA_ACKED is for this client; count it if it is not."""
        is_accepted = self._asked and (target_system, target_component) == self._ids
        self.rejected += not is_accepted
        return is_accepted

    def on_heartbeat(self, autopilot: int, now: float, *, armed: bool) -> list[Command]:
        """Take a HEARTBEAT of the autopilot: its MAV_AUTOPILOT, and whether base_mode has it armed."""
        self._armed, self._is_px4 = armed, autopilot == dialect.MAV_AUTOPILOT_PX4
        if not self._is_px4 and self.status.state == "idle":
            self._set("refused", "not_px4", _name("MAV_AUTOPILOT", autopilot))
        if now - self._last_heartbeat > self._times.link:
            self._quiet_since, self._acked_in_row = now, 0
            if self.status.reason == "link_lost":
                self._set("streaming")  # PX4 streams on without a client
        self._last_heartbeat = now
        return self.tick(now)

    def on_reboot(self) -> None:
        """Take a reboot of the vehicle, as time_boot_ms shows it: its stream is gone."""
        if self.status.state not in ("stopping", "stopped"):
            self._reset()

    def on_data(self, sequence: int, now: float, *, acked: bool, begins: bool) -> list[Command]:
        """Take a message that `accepts` has accepted; `acked`: it is LOGGING_DATA_ACKED.

        `begins`: a new stream begins with it, as `Reassembly` states, which tells it from a repetition.
        """
        commands = [Command("acknowledge", sequence)] if acked and self._acknowledges else []
        state = self.status.state
        self._interval = max(now - self._last_data, _DECAY * self._interval)
        self._last_data = now
        is_new, self._sequence = sequence != self._sequence, sequence
        self._acked_in_row = self._acked_in_row + is_new if acked else 0
        if self._awaited == "stop" or state in ("stopping", "stopped"):
            return commands
        if begins:
            self._set("header")
            self._awaited, self._has_definitions, self._next_start, self._restarts = None, True, now, 0
            self._header_start = self._last_acked = now
            self._header_messages, self._interval, self.header_seconds = 1, 0.0, None
        elif state == "header" and not acked:
            self._end_header()
        elif state == "header" and is_new:
            self._last_acked = now
            self._header_messages += 1
            return self._judge_link(now) or commands
        elif state in ("refused", "ended") and self._has_definitions:
            self._awaited, self._next_start = None, now
            self._set("streaming")
        elif self.status.reason == "taken" and self._may_start() and not self._took_over:
            return [*commands, *self._take_over(now)]
        return commands

    def on_command_ack(
        self, command: int, result: int, target_system: int, target_component: int, now: float
    ) -> list[Command]:
        """Take a COMMAND_ACK of the autopilot; those of other commands and for other ids are ignored."""
        is_for_us = (target_system, target_component) in (self._ids, (0, 0))  # zeros: without ids
        if not is_for_us or self._awaited is None or command != _COMMANDS.get(self._awaited):
            return []
        if result == dialect.MAV_RESULT_IN_PROGRESS:
            self._deadline = now + self._times.answer
        elif self._awaited == "stop":
            self._end_stop(now)
        else:
            return self._on_start_result(result, now)
        return []

    def tick(self, now: float) -> list[Command]:
        """Return the commands that are due."""
        state, is_lost = self.status.state, self._silence(now) > self._times.link
        if self._awaited is not None:
            return self._on_timeout(now, is_lost=is_lost) if now >= self._deadline else []
        if state in ("header", "streaming"):
            return self._check_silence(now, is_lost=is_lost)
        if state in ("stopping", "stopped") or not self._is_px4 or is_lost or now < self._next_start:
            return []
        if self._may_start():
            if state in ("idle", "waiting_for_disarm"):
                self._set("starting")
            return self._send("start", now)
        if state in ("idle", "starting"):
            self._set("waiting_for_disarm", "armed")
        return []

    def stop(self, now: float) -> list[Command]:
        """End the stream; go on with `on_data`, `on_command_ack` and `tick` until the state is `stopped`.

        A stream that is not this client's is left alone: an open START is answered first.
        """
        owns = self.status.state in ("header", "streaming") or self._awaited in ("data", "stop")
        self._set("stopping" if owns or self._awaited else "stopped")
        return self._stop(now) if owns and self._awaited != "stop" else []

    def _may_start(self) -> bool:
        return not self._armed or "armed" in self._log

    def _silence(self, now: float) -> float:
        """Return the time without any message from the vehicle [s]."""
        return now - max(self._last_heartbeat, self._last_data)

    def _set(self, state: LogState, reason: LogReason | None = None, *values: object) -> None:
        if (state, reason) != self.status[:2]:
            self.status = LogStatus(state, reason, _TEXTS[reason].format(*values) if reason else "")

    def _send(self, kind: Literal["start", "stop"], now: float, *, tries: int = 0) -> list[Command]:
        self._awaited, self._tries, self._asked = kind, tries + 1, True
        self._deadline = now + self._times.answer * (2**tries if kind == "start" else 1)
        return [Command(kind)]

    def _stop(self, now: float) -> list[Command]:
        """Send STOP; the status set before remains."""
        self._has_definitions = False
        return self._send("stop", now)

    def _end_stop(self, now: float) -> None:
        self._awaited, self._acknowledges = None, True
        self._next_start = max(self._next_start, now + self._times.pause)
        if self.status.state == "stopping":
            self._set("stopped")

    def _restart(self, now: float) -> list[Command]:
        """Send STOP; START follows after the pause."""
        self._set("starting")
        self._next_start = now
        return self._stop(now)

    def _take_over(self, now: float) -> list[Command]:
        self._took_over = True
        return self._restart(now)

    def _end_header(self) -> None:
        self._set("streaming")
        self.header_seconds, self._acked_in_row = self._last_acked - self._header_start, 0

    def _judge_link(self, now: float) -> list[Command]:
        """Stop a stream whose header would take too long."""
        elapsed = now - self._header_start
        self.round_trip = elapsed / (self._header_messages - 1)
        expected = max(elapsed, self.round_trip * _EXPECTED_MESSAGES)
        if elapsed <= self._times.header and (expected <= self._times.header or self._header_messages < _JUDGED):
            return []
        self._set("refused", "slow_link", expected, 1e3 * self.round_trip)
        self._next_start = now + self._times.slow_retry
        self._acknowledges = False  # PX4 obeys no command during the header: an acknowledgement missing ends it sooner
        return self._stop(now)

    def _on_start_result(self, result: int, now: float) -> list[Command]:
        state, times, self._awaited = self.status.state, self._times, None
        if state == "stopping":
            if result == dialect.MAV_RESULT_ACCEPTED:
                return self._stop(now)
            self._set("stopped")
        elif result == dialect.MAV_RESULT_ACCEPTED:
            if state in ("header", "streaming"):  # sent because of silence
                self._set("starting", "silent", now - self._last_data)
            else:
                self._set("starting")
            self._awaited, self._deadline, self._has_definitions = "data", now + times.first_data, False
        elif result == dialect.MAV_RESULT_TEMPORARILY_REJECTED and self._has_definitions:
            self._next_start = now + self._patience()  # the stream exists: it is only slow
            if state == "header":
                self._end_header()
            elif state != "streaming":
                self._quiet_since = now
                self._set("streaming")
        elif result == dialect.MAV_RESULT_TEMPORARILY_REJECTED and "take" in self._log and not self._took_over:
            return self._take_over(now)
        else:
            reason = _REFUSALS.get(result, "failed")
            self._set("refused", reason, _name("MAV_RESULT", result))
            self._next_start = now + (times.slow_retry if reason in ("bandwidth", "unsupported") else times.retry)
        return []

    def _on_timeout(self, now: float, *, is_lost: bool) -> list[Command]:
        state, awaited, self._awaited = self.status.state, self._awaited, None
        if awaited == "stop":
            if self._tries < _TRIES:
                return self._send("stop", now, tries=self._tries)
            self._end_stop(now)
        elif state == "stopping":  # START was not answered: there is nothing to stop
            self._set("stopped")
        elif awaited == "data" and not is_lost:
            self._restarts += 1
            if self._restarts <= _RESTARTS:
                return self._restart(now)
            self._set("refused", "no_data")
            self._next_start = now + self._times.retry
            return self._stop(now)
        elif is_lost or not self._may_start():
            if state == "starting":
                self._set("idle")
        elif self._tries < _TRIES:
            return self._send("start", now, tries=self._tries)
        elif state in ("header", "streaming"):
            self._end("ended", "stalled" if state == "header" else "silent", now)
        else:
            self._end("refused", "no_answer", now)
        return []

    def _end(self, state: LogState, reason: LogReason, now: float) -> None:
        """Show the end of the stream; START follows after a while."""
        self._set(state, reason, now - self._last_data)
        self._next_start = now + self._times.retry

    def _patience(self) -> float:
        """Return the silence after which the stream may have ended [s]."""
        return min(max(self._times.silence, 3 * self._interval), self._times.longest_silence)

    def _check_silence(self, now: float, *, is_lost: bool) -> list[Command]:
        """Probe a silent stream with START: PX4 rejects it and leaves the stream alone, or begins a new one."""
        state, times, patience = self.status.state, self._times, self._patience()
        silence = now - max(self._last_data, self._quiet_since)
        repeated = self._last_data - self._last_acked  # time in which only repetitions arrived
        if is_lost:
            self._set("ended", "link_lost", self._silence(now))
        elif state == "header" and now - self._last_acked > times.stall and repeated > times.silence:
            self._has_definitions = False
            self._end("ended", "stalled", now)
        elif state == "streaming" and self._acked_in_row >= _STOP_TAIL and silence > times.silence:
            self._has_definitions = False
            self._end("ended", "stopped_elsewhere", now)
        elif not self._may_start():
            if silence > max(times.stall, 2 * patience):
                self._set("ended", "silent", silence)
        elif silence > times.longest_silence:
            self._has_definitions = False
            self._end("refused", "taken", now)
        elif silence > patience and now >= self._next_start:
            return self._send("start", now)
        return []


def _name(enum: str, number: int) -> str:
    entry = dialect.enums[enum].get(number)
    return entry.name if entry else f"{enum} {number}"
