"""A robot's poses as they come, through losses and returns: the parent of the process that holds the client."""

from __future__ import annotations

import os
import select
import subprocess
import sys
import threading
import time
from collections import deque
from dataclasses import dataclass
from enum import Enum

from cluster_slam.errors import InputError
from cluster_slam.sensors.rtde import child
from cluster_slam.sensors.rtde.fields import BIT_PROTECTIVE_STOP
from cluster_slam.sensors.rtde.wire import PackageReader

STALE_S = 0.1  # without a new sample for so long, the robot counts as lost
CONNECT_S = 6.0  # the client's constructor takes 2.5 s where no data come; longer, and it hangs
_PAUSES_S = (0.1, 0.2, 0.5, 1.0, 2.0)  # before the next try; the last one for ever


class LinkState(Enum):
    """How things stand with the robot."""

    CONNECTING = "connecting"
    STREAMING = "streaming"
    LOST = "lost"


@dataclass(frozen=True, slots=True)
class RobotSample:
    """What the controller said at one stamp."""

    arrival: float  # s, Unix time of this machine
    stamp: float  # s, the controller's clock
    pose: tuple[float, ...]  # (6,) x y z (m) and rotation vector (rad) of the active TCP in the base's frame
    joints: tuple[float, ...]  # (6,) rad, NaN where the controller does not say
    robot_mode: int  # -1 where the controller does not say
    safety_bits: int  # -1 where the controller does not say

    @property
    def is_stopped(self) -> bool:
        """Whether the arm stands in a protective stop."""
        return self.safety_bits >= 0 and bool(self.safety_bits & BIT_PROTECTIVE_STOP)


@dataclass(frozen=True, slots=True)
class LinkEvent:
    """Something that happened to the link."""

    time: float  # s, Unix time
    kind: str  # connected, lost, refused, protective_stop, released, mode
    text: str


class RobotLink:
    """Samples of a robot. Use it as a context manager; ``take`` never waits."""

    def __init__(
        self, host: str, *, rate_hz: float = 125.0, connect_s: float = CONNECT_S, max_samples: int = 200_000
    ) -> None:
        """
        Parameters
        ----------
        host
            Name or address of the controller; the port is RTDE's, 30004.
        rate_hz
            Samples a second to ask for.
        connect_s
            After so long a client that has not connected is ended.
        max_samples
            Kept at most between two calls of ``take``; the oldest go first.
        """
        self.host, self.rate_hz, self._connect_s = host, rate_hz, connect_s
        self.fields: tuple[str, ...] = ()  # that this controller has
        self._samples: deque[RobotSample] = deque(maxlen=max_samples)
        self._events: deque[LinkEvent] = deque(maxlen=10_000)
        self._last: RobotSample | None = None
        self._last_seen = -float("inf")  # monotonic
        self._is_open = True
        self._was_streaming = False
        self._n_failures = 0
        self._thread = threading.Thread(target=self._work, daemon=True)

    def __enter__(self) -> RobotLink:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._is_open = False
        self._thread.join()

    @property
    def state(self) -> LinkState:
        """How things stand now."""
        if time.monotonic() - self._last_seen < STALE_S:
            return LinkState.STREAMING
        return LinkState.LOST if self._last is not None else LinkState.CONNECTING

    def take(self) -> tuple[list[RobotSample], list[LinkEvent]]:
        """Samples and events since the last call, oldest first."""
        samples = [self._samples.popleft() for _ in range(len(self._samples))]
        return samples, [self._events.popleft() for _ in range(len(self._events))]

    def wait(self, timeout_s: float) -> None:
        """Return when the first sample is there.

        Raises
        ------
        InputError
            It did not come in time; the message has the last reason.
        """
        end = time.monotonic() + timeout_s
        while self._last is None:
            if time.monotonic() > end:
                reasons = [event.text for event in self._events]
                why = reasons[-1] if reasons else "no answer"
                raise InputError(f"robot {self.host}: no data in {timeout_s:g} s ({why}), expected RTDE on port 30004")
            time.sleep(0.01)

    def _work(self) -> None:
        """One child after another."""
        while self._is_open:
            self._one_life()
            pause = _PAUSES_S[min(self._n_failures, len(_PAUSES_S) - 1)]
            end = time.monotonic() + pause
            while self._is_open and time.monotonic() < end:
                time.sleep(0.02)

    def _one_life(self) -> None:
        self._n_failures += 1
        numbers = [str(self.rate_hz), str(self._connect_s)]
        command = [sys.executable, "-m", "cluster_slam.sensors.rtde.child", self.host, *numbers]
        process = subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, bufsize=0
        )
        try:
            why = self._listen(process)
        finally:
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()
        if self._is_open:
            self._event("lost" if self._was_streaming else "refused", why)
        self._was_streaming = False

    def _listen(self, process: subprocess.Popen[bytes]) -> str:
        """Take in what the child tells, until it ends; the reason in words."""
        if process.stdout is None:
            return "no pipe"
        reader, pipe = PackageReader(), process.stdout.fileno()
        why, heard = "the client hung or crashed", time.monotonic()
        while self._is_open:
            if not select.select([pipe], [], [], 0.1)[0]:
                if time.monotonic() - heard > self._connect_s + 1.0:  # its own alarm comes first
                    return "the client is silent"
                continue
            data = os.read(pipe, 65536)
            if not data:
                return why
            heard = time.monotonic()
            for kind, payload in reader.feed(data):
                if kind == child.SAMPLE:
                    self._take_in(RobotSample(*_split(child.SAMPLE_STRUCT.unpack(payload))))
                elif kind == child.CONNECTED:
                    self.fields = tuple(payload.decode().split(","))
                    missing = [name for name in child.OPTIONAL if name not in self.fields]
                    self._event("connected", f"{self.host}" + (f", without {', '.join(missing)}" if missing else ""))
                elif kind in (child.REFUSED, child.LOST):
                    why = payload.decode("utf-8", "replace")
        return "closed"

    def _take_in(self, sample: RobotSample) -> None:
        before = self._last
        if before is not None and before.is_stopped != sample.is_stopped:
            self._event(*(("protective_stop", "the arm stands") if sample.is_stopped else ("released", "it goes on")))
        if before is not None and before.robot_mode != sample.robot_mode:
            self._event("mode", f"robot mode {sample.robot_mode} after {before.robot_mode}")
        self._last, self._last_seen = sample, time.monotonic()
        self._was_streaming, self._n_failures = True, 0
        self._samples.append(sample)

    def _event(self, kind: str, text: str) -> None:
        self._events.append(LinkEvent(time.time(), kind, " ".join(text.split())))


def _split(values: tuple[float, ...]) -> tuple[float, float, tuple[float, ...], tuple[float, ...], int, int]:
    return values[0], values[1], values[2:8], values[8:14], int(values[14]), int(values[15])
