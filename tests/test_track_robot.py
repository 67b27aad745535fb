"""``track --robot``: an emulated arm and a folder as camera, played at their own pace, against the truth."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest
from rtde_help import UPTIME, EmulatedRobot

from cluster_slam.cli.app import run
from cluster_slam.evaluation.trajectory import hand_eye_truth
from cluster_slam.geometry import tum_from_pose
from cluster_slam.io.read_result import read_result
from cluster_slam.io.session import open_session, open_truth
from cluster_slam.online.journal import journal_of
from cluster_slam.records import Session, Truth
from cluster_slam.sensors.rtde.link import RobotLink
from tracking.metrics import identity_scores


def recording(tmp_path: Path, seconds: float) -> tuple[Path, Session, Truth]:
    folder = tmp_path / "session"
    words = ["simulate", str(folder), "--preset", "sample", "--seed", "5", "--set", f"duration_s={seconds}", "-q"]
    assert run(words) == 0
    session = open_session(folder)
    truth = open_truth(folder, session)
    assert truth is not None
    true = hand_eye_truth(session, truth)
    assert true is not None
    rows = np.diag(np.repeat([3e-4, 2e-4], 3) ** 2).tolist()
    text = f"T_flange_camera = {tum_from_pose(true.T_flange_camera).tolist()}\ncovariance = {rows}\n"
    (tmp_path / "calibration.toml").write_text(text)
    (tmp_path / "camera").mkdir()
    header = (folder / "flowers.csv").read_text().splitlines()[0]
    (tmp_path / "camera" / "flowers.csv").write_text(header + "\n")
    return folder, session, truth


def clock_of(robot: EmulatedRobot) -> float:
    """Unix time at which the arm was at the first pose of its motion."""
    with RobotLink(robot.host) as link:
        link.wait(10.0)
        sample = link.take()[0][-1]
    return sample.arrival - (sample.stamp - UPTIME)


def play(folder: Path, session: Session, camera: Path, begin: float) -> None:
    """Fill the camera's folder at the session's pace; frames that are past already are left out."""
    rows = [line.split(",", 1)[1] for line in (folder / "flowers.csv").read_text().splitlines()[1:]]
    with (camera / "flowers.csv").open("a") as file:
        for i, stamp in enumerate(session.stamps.tolist()):
            now = begin + stamp - float(session.stamps[0])
            if now < time.time():
                continue
            time.sleep(now - time.time())
            file.writelines(f"{now!r},{rows[k]}\n" for k in np.flatnonzero(session.observations.frame == i))
            file.flush()


def start(robot: EmulatedRobot, tmp_path: Path, *options: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "cluster_slam.cli", "track", "--robot", robot.host, "-o", str(tmp_path / "out")]
    command += ["--camera", str(tmp_path / "camera"), "--calibration", str(tmp_path / "calibration.toml"), "--json"]
    return subprocess.Popen([*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def flower_idf1(out: Path, recorded: Path, session: Session, truth: Truth) -> tuple[float, int]:
    """Identities of the rows that came through; a point is in both files with the same digits."""
    assert truth.flower_ids is not None
    known = dict(zip(map(tuple, session.observations.points.tolist()), truth.flower_ids.tolist(), strict=True))
    seen = open_session(recorded)
    result = read_result(out, seen)
    true = np.array([known[point] for point in map(tuple, seen.observations.points.tolist())])
    return identity_scores(true, result.flower_ids).idf1, seen.n_frames


def test_a_robot_is_followed_through_a_loss(tmp_path: Path) -> None:
    """The same flowers are the same before and after the arm was gone, and all of it is on disk as a session."""
    folder, session, truth = recording(tmp_path, 14.0)
    with EmulatedRobot(folder / "poses.txt", "--fault", "drop:0.5@5") as robot:
        process = start(robot, tmp_path, "--record", str(tmp_path / "kept"))
        begin = clock_of(robot)
        player = threading.Thread(target=play, args=(folder, session, tmp_path / "camera", begin))
        player.start()
        player.join()
        (tmp_path / "camera" / "done").touch()
        text, errors = process.communicate(timeout=180)
    assert process.returncode == 0, errors
    said = json.loads(text)
    assert said["command"] == "track"
    assert any("robot" in w and "lost" in w for w in said["warnings"]), said["warnings"]
    idf1, n_frames = flower_idf1(tmp_path / "out", tmp_path / "kept", session, truth)
    assert n_frames > 50
    assert idf1 > 0.95
    assert not journal_of(tmp_path / "out").exists()


def test_sigterm_ends_a_live_run_in_order_and_a_kill_can_be_resumed(tmp_path: Path) -> None:
    folder, session, truth = recording(tmp_path, 14.0)
    with EmulatedRobot(folder / "poses.txt") as robot:
        first = start(robot, tmp_path)
        begin = clock_of(robot)
        player = threading.Thread(target=play, args=(folder, session, tmp_path / "camera", begin))
        player.start()
        journal = journal_of(tmp_path / "out")
        end = time.monotonic() + 90
        while not (journal / "frames.bin").exists() or (journal / "frames.bin").stat().st_size < 20 * 64:
            assert time.monotonic() < end
            time.sleep(0.05)
        first.kill()
        first.communicate(timeout=10)
        before = (journal / "frames.bin").stat().st_size
        second = start(robot, tmp_path, "--resume", "--record", str(tmp_path / "kept"))
        player.join()
        while (journal / "frames.bin").stat().st_size <= before:  # it goes on
            assert time.monotonic() < end
            time.sleep(0.05)
        time.sleep(0.5)
        second.send_signal(signal.SIGTERM)
        text, errors = second.communicate(timeout=180)
    assert second.returncode == 0, errors
    assert json.loads(text)["counts"]["frames"] > 40
    idf1, _ = flower_idf1(tmp_path / "out", tmp_path / "kept", session, truth)
    assert idf1 > 0.95


@pytest.mark.parametrize(
    ("words", "match"),
    [
        ([], "expected a SESSION or --robot"),
        (["--robot", "127.1.1.9"], "without --camera"),
        (["--robot", "127.1.1.9", "--camera", "none-such"], "--calibration FILE or --hand-eye"),
        (["--robot", "127.1.1.9", "--camera", "x", "--hand-eye", "1 2"], "expected tx ty tz"),
        (["--robot", "127.1.1.9", "--camera", "x", "--hand-eye", "0 0 0 0 0 0 1", "--realtime"], "--realtime"),
        (["data/sample", "--camera", "x"], "--camera without --robot"),
    ],
)
def test_options_that_do_not_go_together(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str], match: str
) -> None:
    assert run(["track", *words, "-o", str(tmp_path / "out")]) == 2
    error = capsys.readouterr().err
    assert match in error
    assert len(error.splitlines()) == 1
    assert not list(tmp_path.iterdir())
