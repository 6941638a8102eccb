"""A PX4 that receives an external position, as observed in main of 2026-08-21: its link, time, buffer, frames and EKF2.

It does with ODOMETRY what `external_vision.md` of the project's notes describes, and yields the messages that PX4
publishes: the echo, and an aid message for each quantity. Values are not estimated: what EKF2 accepts is fused.
"""

from __future__ import annotations

import math
import socket
import threading
import time
from collections import deque
from typing import Any, Final, Self

from pymavlink.dialects.v20 import common as dialect

from nedbus.fusion import FusionTracker

SYNC_ANSWERS: Final = 500  # answers to TIMESYNC after which PX4 uses time_usec
MAX_ROUND_TRIP: Final = 0.010  # s; a slower answer does not count
START_INTERVAL: Final = 0.200  # s; fusion starts only if two samples are closer
STOP: Final = 0.4  # s without a sample after which fusion stops
MIN_INTERVAL: Final = 0.008  # s; EKF2's buffer drops what is faster
MAX_AGE: Final = 0.2  # s; an older sample is not in the buffer's horizon
AID_DELAY: Final = 0.15  # s
FRAMES: Final = {dialect.MAV_FRAME_LOCAL_NED: 1, dialect.MAV_FRAME_LOCAL_FRD: 2}
VELOCITY_FRAMES: Final = FRAMES | {dialect.MAV_FRAME_BODY_FRD: 3}


class Px4Vision:
    """PX4's handling of ODOMETRY; times are monotonic [s]. `control`: EKF2_EV_CTRL, `min_quality`: EKF2_EV_QMIN.

    `published`: (topic, fields) of the messages so far. `answers`: answers to TIMESYNC that count.
    """

    def __init__(self, *, control: int = 15, min_quality: int = 0) -> None:
        self.control, self.min_quality = control, min_quality
        self.published: list[tuple[str, dict[str, Any]]] = []
        self.answers = 0
        self.offset = 0.0  # from the sender's clock to this one [s]
        self._newest = -math.inf  # newest time in the buffer
        self._last = -math.inf  # time of the last sample that EKF2 took
        self._counter: int | None = None
        self._is_fusing = False

    def on_timesync(self, remote_ns: int, sent_ns: int, now: float) -> None:
        """Take an answer to TIMESYNC: the sender's time, and when the request was sent."""
        round_trip = now - sent_ns / 1e9
        if round_trip > MAX_ROUND_TRIP:
            return
        self.answers += 1
        self.offset = now - round_trip / 2 - remote_ns / 1e9

    def on_odometry(self, message: Any, now: float) -> None:
        """Take ODOMETRY that arrived at `now`."""
        if message.estimator_type == dialect.MAV_ESTIMATOR_TYPE_MOCAP:
            self._publish("vehicle_mocap_odometry", now, {})
            return
        sample = now if self.answers < SYNC_ANSWERS else message.time_usec / 1e6 + self.offset
        position = message.x, message.y, message.z
        is_known = all(map(math.isfinite, position))
        frame = FRAMES.get(message.frame_id, 0) if is_known else 0
        velocity = message.vx, message.vy, message.vz
        echo = {
            "timestamp_sample": max(0, round(1e6 * sample)), "pose_frame": frame,
            "velocity_frame": VELOCITY_FRAMES.get(message.child_frame_id, 0), "velocity": velocity,
            "position": position if frame else (math.nan,) * 3, "q": tuple(message.q),
            "position_variance": tuple(message.pose_covariance[each] for each in (0, 6, 11)),
            "reset_counter": message.reset_counter, "quality": message.quality,
        }  # fmt: skip
        self._publish("vehicle_visual_odometry", now, echo)
        if not self._buffers(sample, now):
            return
        interval, self._last = sample - self._last, sample
        if interval > STOP:
            self._is_fusing = False
        has_reset, self._counter = (
            self._counter not in (None, message.reset_counter),
            message.reset_counter,
        )
        is_good = message.quality >= self.min_quality
        self._is_fusing = is_good and (self._is_fusing or interval < START_INTERVAL)
        can_fuse = self._is_fusing and not has_reset
        self._aid("pos", now, bit=1, can_fuse=can_fuse, is_valid=bool(frame))
        self._aid("hgt", now, bit=2, can_fuse=can_fuse, is_valid=bool(frame))
        if (
            self._is_fusing
            and frame
            and echo["velocity_frame"]
            and all(map(math.isfinite, velocity))
        ):
            self._aid("vel", now, bit=4, can_fuse=True, is_valid=True, only_fused=True)
        self._aid(
            "yaw", now, bit=8, can_fuse=can_fuse, is_valid=abs(math.hypot(*message.q) - 1) <= 1e-5
        )

    def _buffers(self, sample: float, now: float) -> bool:
        """Return whether EKF2's buffer takes a sample: newer than the newest, which a time ahead remains for good."""
        if sample < self._newest + MIN_INTERVAL:
            return False
        self._newest = sample
        return now - MAX_AGE <= sample <= now + MIN_INTERVAL

    def _aid(
        self,
        name: str,
        now: float,
        *,
        bit: int,
        can_fuse: bool,
        is_valid: bool,
        only_fused: bool = False,
    ) -> None:
        is_chosen = bool(self.control & bit)
        if only_fused and not is_chosen:
            return
        fields = {
            "fused": is_chosen and can_fuse and is_valid, "innovation_rejected": is_chosen and not is_valid,
            "test_ratio": 0.01 if is_valid else math.nan, "estimator_instance": 0,
        }  # fmt: skip
        self._publish(f"estimator_aid_src_ev_{name}", now, fields)

    def _publish(self, topic: str, now: float, fields: dict[str, Any]) -> None:
        self.published.append((topic, {"timestamp": round(1e6 * now)} | fields))


class Px4OnLink:
    """Such a PX4 at a UDP port of a source: it sends heartbeats and TIMESYNC, and receives on a thread."""

    def __init__(
        self, port: int, *, system: int = 1, timesync_rate: float = 10.0, **options: int
    ) -> None:
        self.vision, self.tracker = Px4Vision(**options), FusionTracker()
        self.messages: list[tuple[float, Any]] = []  # ODOMETRY with its time of arrival
        self.timesyncs = 0  # answers
        self.lock = threading.Lock()
        self._encoder, self._decoder = dialect.MAVLink(None, system, 1), dialect.MAVLink(None)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.connect(("127.0.0.1", port))
        self._socket.settimeout(0.005)
        self._interval, self._stop = 1 / timesync_rate, threading.Event()
        self._waiting: deque[tuple[str, dict[str, Any]]] = deque()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join()
        self._socket.close()

    def state(self) -> dict[str, str]:
        """Return the state of each quantity, from what this PX4 has published."""
        with self.lock:
            return {each.name: each.state for each in self.tracker.fusion("1").quantities}

    def count(self) -> int:
        """Return the number of ODOMETRY messages so far."""
        with self.lock:
            return len(self.messages)

    def _run(self) -> None:
        next_heartbeat = next_timesync = 0.0
        while not self._stop.is_set():
            now = time.monotonic()
            if now >= next_heartbeat:
                next_heartbeat = now + 0.2
                kind, autopilot = dialect.MAV_TYPE_QUADROTOR, dialect.MAV_AUTOPILOT_PX4
                self._send(
                    dialect.MAVLink_heartbeat_message(
                        kind, autopilot, 0, 0, dialect.MAV_STATE_ACTIVE, 3
                    )
                )
                self._send(
                    dialect.MAVLink_local_position_ned_message(round(1e3 * now) % 2**32, *[0.0] * 6)
                )
            if now >= next_timesync:
                next_timesync = now + self._interval
                self._send(dialect.MAVLink_timesync_message(0, time.monotonic_ns()))
            try:
                data = self._socket.recv(2048)
            except OSError:
                continue
            with self.lock:
                for message in self._decoder.parse_buffer(data) or ():
                    self._receive(message, time.monotonic())

    def _receive(self, message: Any, now: float) -> None:
        if message.get_type() == "TIMESYNC" and message.tc1:
            self.timesyncs += 1
            self.vision.on_timesync(message.tc1, message.ts1, now)
        if message.get_type() == "ODOMETRY":
            self.messages.append((now, message))
            before = len(self.vision.published)
            self.vision.on_odometry(message, now)
            for topic, fields in self.vision.published[before:]:
                self.tracker.add(topic, fields)

    def _send(self, message: Any) -> None:
        try:
            self._socket.send(message.pack(self._encoder))
        except OSError:  # no service has opened the port yet
            return
        self._encoder.seq = (self._encoder.seq + 1) % 256
