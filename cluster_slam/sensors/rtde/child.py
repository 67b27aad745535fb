"""The process that holds ur_rtde's client for one connection, and dies with it.

ur_rtde's constructor can hang for ever with the interpreter's lock held, its getters return old values after a loss,
and ``reconnect`` can crash. So the client lives here, alone: it tells its parent on stdout what it reads, an alarm
ends the process where it hangs, and for the next connection there is a new one. It reads; it never commands.

Run by :class:`cluster_slam.sensors.rtde.link.RobotLink` as ``python -m cluster_slam.sensors.rtde.child HOST RATE
SECONDS``: how long connecting may take.
"""

from __future__ import annotations

import ctypes
import os
import re
import signal
import struct
import sys
import time
from typing import Any

from cluster_slam.sensors.rtde.wire import pack

REQUIRED = ("timestamp", "actual_TCP_pose")
OPTIONAL = ("actual_q", "robot_mode", "safety_status_bits")
SAMPLE, ALIVE, CONNECTED, REFUSED, LOST = range(5)  # kinds of messages
SAMPLE_STRUCT = struct.Struct(">dd6d6dii")  # arrival, stamp, pose, joints, robot mode, safety bits
HANG_S = 2.0  # so long for one round of reading
_ALIVE_S = 0.1  # a sign of life so often
_PR_SET_PDEATHSIG = 1


def main(host: str, rate_hz: float, connect_s: float) -> int:
    """Connect, read until the connection is lost, end."""
    out = os.dup(1)
    null = os.open(os.devnull, os.O_WRONLY)
    os.dup2(null, 1)  # the client writes its messages there
    _die_with_parent()
    signal.setitimer(signal.ITIMER_REAL, connect_s)  # its default action ends the process, lock held or not
    try:
        receiver, names = _connect(host, rate_hz)
    except RuntimeError as error:
        _tell(out, REFUSED, str(error).encode())
        return 1
    _tell(out, CONNECTED, ",".join(names).encode())
    _tell(out, LOST, _read(out, receiver, names, 1.0 / rate_hz).encode())
    os._exit(0)  # disconnecting in order takes half a second and can hang; the kernel closes the connection


def _connect(host: str, rate_hz: float) -> tuple[Any, tuple[str, ...]]:
    """A client that asks for what this controller has of the fields.

    Raises
    ------
    RuntimeError
        No controller there, or one without a field that is needed.
    """
    from rtde_receive import RTDEReceiveInterface

    names: tuple[str, ...] = (*REQUIRED, *OPTIONAL)
    while True:
        try:
            return RTDEReceiveInterface(host, rate_hz, list(names)), names
        except RuntimeError as error:
            missing = set(re.findall(r"[\w]+", str(error).partition("controller")[2]))
            if missing & set(REQUIRED) or not missing & set(names):
                raise
            names = tuple(name for name in names if name not in missing)


def _read(out: int, receiver: Any, names: tuple[str, ...], period: float) -> str:
    """Tell each new sample; the end of it is the reason."""
    last = told = 0.0
    while True:
        signal.setitimer(signal.ITIMER_REAL, HANG_S)
        stamp = receiver.getTimestamp()
        now = time.time()
        if stamp != last:
            sample = _sample(receiver, names, stamp, now)
            if sample is None:  # the next one came in between
                continue
            last, told = stamp, now
            _tell(out, SAMPLE, sample)
        elif not 0 <= now - told < _ALIVE_S:
            if not receiver.isConnected():
                return "the connection is lost"
            told = now
            _tell(out, ALIVE)
        time.sleep(period / 8)


def _sample(receiver: Any, names: tuple[str, ...], stamp: float, now: float) -> bytes | None:
    """Pose, joints and state between two readings of the same stamp; None where the stamps differ."""
    pose = receiver.getActualTCPPose()
    joints = receiver.getActualQ() if "actual_q" in names else [float("nan")] * 6
    mode = receiver.getRobotMode() if "robot_mode" in names else -1
    bits = receiver.getSafetyStatusBits() if "safety_status_bits" in names else -1
    if receiver.getTimestamp() != stamp or len(pose) != 6:
        return None
    return SAMPLE_STRUCT.pack(now, stamp, *pose, *joints, mode, bits)


def _tell(out: int, kind: int, payload: bytes = b"") -> None:
    try:
        os.write(out, pack(kind, payload[:60000]))
    except BrokenPipeError:  # nobody listens any more
        os._exit(0)


def _die_with_parent() -> None:
    if sys.platform.startswith("linux"):
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1], float(sys.argv[2]), float(sys.argv[3])))
