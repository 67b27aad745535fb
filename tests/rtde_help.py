"""An emulated controller in a process of its own, at an address that no other test uses."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from itertools import count
from pathlib import Path
from typing import Any

import numpy as np

SPEED = 0.1  # m/s along x of the motion that tests play
UPTIME = 1000.0  # s, where the controller's clock begins
_NUMBER = count(1)


def line_motion(folder: Path, seconds: float = 100.0) -> Path:
    """A trajectory along x at ``SPEED``, turning about z by 0.2 rad/s, one pose a tenth of a second."""
    t = np.arange(0.0, seconds, 0.1)
    half = 0.5 * 0.2 * t
    rows = np.column_stack([t, SPEED * t, 0 * t + 0.3, 0 * t + 0.5, 0 * t, 0 * t, np.sin(half), np.cos(half)])
    path = folder / "motion.txt"
    np.savetxt(path, rows, fmt="%.9f")
    return path


def free_host() -> str:
    """An address of this machine that no other test uses, in whatever process."""
    pid = os.getpid()
    return f"127.{pid // 250 % 200 + 20}.{pid % 250 + 1}.{next(_NUMBER)}"


class EmulatedRobot:
    """``cluster-slam rtde-emulator`` with its faults on stdin. Use it as a context manager."""

    def __init__(self, motion: Path, *options: str) -> None:
        self.host = free_host()
        program = [sys.executable, "-m", "cluster_slam.cli", "rtde-emulator", str(motion), "--bind", self.host]
        self._command = [*program, "--control", "--json", "--uptime", str(UPTIME), *options]
        self.summary: dict[str, Any] = {}

    def __enter__(self) -> EmulatedRobot:
        self._process = subprocess.Popen(self._command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert self._process.stdin is not None
        self._stdin = self._process.stdin
        self._wait()
        return self

    def __exit__(self, *_: object) -> None:
        self._stdin.close()
        assert self._process.stdout is not None
        text = self._process.stdout.read()
        self._process.stdout.close()
        assert self._process.wait(10) == 0
        self.summary = json.loads(text)

    def do(self, fault: str) -> None:
        """Let a fault happen."""
        self._stdin.write(fault + "\n")
        self._stdin.flush()

    def _wait(self) -> None:
        import socket
        import time

        end = time.monotonic() + 20
        while True:
            try:
                socket.create_connection((self.host, 30004), 1.0).close()
                return
            except OSError:
                assert time.monotonic() < end, "the emulator does not listen"
                time.sleep(0.05)
