"""``cluster-slam rtde-emulator``: what it says, and what it refuses."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from rtde_help import EmulatedRobot, free_host, line_motion

from cluster_slam.cli.app import run


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["{motion}", "--bind", "203.0.113.1"], "203.0.113.1:30004: cannot listen there"),
        (["{motion}", "--series", "x"], "expected e or cb3"),
        (["{motion}", "--fault", "stal:1"], "did you mean stall"),
        (["nowhere.txt"], "missing, expected a TUM trajectory or an RTDE log"),
    ],
)
def test_what_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], match: str) -> None:
    motion = str(line_motion(tmp_path))
    assert run(["rtde-emulator", *(one.replace("{motion}", motion) for one in arguments)]) == 2
    error = capsys.readouterr().err
    assert match in error
    assert len(error.splitlines()) == 1


def test_a_port_that_is_taken(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    with EmulatedRobot(line_motion(tmp_path)) as robot:
        assert run(["rtde-emulator", str(tmp_path / "motion.txt"), "--bind", robot.host]) == 2
    assert "cannot listen there" in capsys.readouterr().err


def test_faults_at_their_time(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    motion = str(line_motion(tmp_path))
    options = ["--fault", "reset@0.2", "--fault", "skew:10@0.1", "--fault", "reset@5", "--duration", "0.5", "--json"]
    assert run(["rtde-emulator", motion, "--bind", free_host(), *options]) == 0
    assert json.loads(capsys.readouterr().out)["counts"] == {"fault reset": 1, "fault skew": 1}


@pytest.mark.parametrize("which", [signal.SIGINT, signal.SIGTERM])
def test_it_ends_when_it_is_told(tmp_path: Path, which: signal.Signals) -> None:
    command = [sys.executable, "-m", "cluster_slam.cli", "rtde-emulator", str(line_motion(tmp_path))]
    host = free_host()
    process = subprocess.Popen([*command, "--bind", host], stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == f"listening on {host}:30004\n"
    time.sleep(0.1)
    process.send_signal(which)
    process.communicate(timeout=10)
    assert process.returncode == 0
