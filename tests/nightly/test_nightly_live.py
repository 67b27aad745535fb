"""A session recorded live from an emulated arm, at its own pace, through faults; then smoothed."""

from __future__ import annotations

import json
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from rtde_help import UPTIME, EmulatedRobot
from test_record import Process, recorder, wait_for

from cluster_slam import open_session
from cluster_slam.cli.app import run
from cluster_slam.io.session import open_truth
from cluster_slam.records import Session

SEEDS = range(5, 6)
FAULTS = {
    "none": [],
    "stall": ["stall:0.5@6"],
    "reset": ["reset@6", "reset@12"],
    "drop": ["drop:1@8"],
    "silent": ["silent:1@8"],
    "half": ["half:5@5"],
    "skew": ["skew:200@0"],
    "restart": ["restart:0.5@9"],
}


def play(session: Session, folder: Path, camera: Path, begin: float) -> None:
    """Fill the camera's folder at the session's pace; the first frame is at ``begin``, Unix time."""
    header, *lines = (folder / "flowers.csv").read_text().splitlines()
    rows = [line.split(",", 1)[1] for line in lines]
    with (camera / "flowers.csv").open("w") as file:
        file.write(header + "\n")
        for i, stamp in enumerate(session.stamps.tolist()):
            now = begin + stamp - float(session.stamps[0])
            if now < time.time():
                continue
            time.sleep(now - time.time())
            file.writelines(f"{now!r},{rows[k]}\n" for k in np.flatnonzero(session.observations.frame == i))
            file.flush()
    (camera / "done").touch()


def record(robot: EmulatedRobot, folder: Path, session: Session, place: Path) -> Process:
    """Record the session as it is played."""
    camera = place / "camera"
    camera.mkdir()
    process = recorder(robot, place / "recorded", "--camera", str(camera))
    journal = place / "recorded.recording" / "robot.csv"
    wait_for(journal)
    time.sleep(1.5)
    arrival, stamp = (float(x) for x in journal.read_text().splitlines()[1].split(",")[:2])
    play(session, folder, camera, arrival - (stamp - UPTIME))
    return process


def copy_truth(folder: Path, recorded: Path) -> None:
    """Identities of the rows that were recorded: a point is in both files with the same digits."""
    session = open_session(folder)
    truth = open_truth(folder, session)
    assert truth is not None
    assert truth.flower_ids is not None
    assert truth.cluster_ids is not None
    ids = zip(truth.flower_ids.tolist(), truth.cluster_ids.tolist(), strict=True)
    known = dict(zip(map(tuple, session.observations.points.tolist()), ids, strict=True))
    found = [known[point] for point in map(tuple, open_session(recorded).observations.points.tolist())]
    (recorded / "truth").mkdir()
    text = "".join(f"{flower},{cluster}\n" for flower, cluster in found)
    (recorded / "truth" / "observations.csv").write_text("flower_id,cluster_id\n" + text)
    (recorded / "session.toml").write_text((folder / "session.toml").read_text())  # noise and mount of the simulation


@pytest.mark.nightly
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("fault", FAULTS)
def test_a_session_survives_its_recording(tmp_path: Path, fault: str, seed: int) -> None:
    """Who is who comes out as from the session itself, whatever the robot did on the way."""
    folder = tmp_path / "simulated"
    simulated = ["simulate", str(folder), "--preset", "moderate", "--seed", str(seed), "--set", "duration_s=20", "-q"]
    assert run(simulated) == 0
    session = open_session(folder)
    faults = [word for text in FAULTS[fault] for word in ("--fault", text)]
    with EmulatedRobot(folder / "poses.txt", *faults) as robot:
        process = record(robot, folder, session, tmp_path)
        told = json.loads(process.communicate(timeout=60)[0])
    assert process.returncode == 0, told
    copy_truth(folder, tmp_path / "recorded")
    command = [
        sys.executable,
        "-m",
        "cluster_slam.cli",
        "smooth",
        str(tmp_path / "recorded"),
        "-o",
        str(tmp_path / "r"),
    ]
    subprocess.run([*command, "--quiet"], check=True)
    metrics = json.loads((tmp_path / "r" / "metrics.json").read_text())
    print(fault, told["frames"], told["frames_without_pose"], told["robot_lost_s"], told["clock_drift_ppm"], metrics)  # noqa: T201
    assert metrics["cluster_idf1"] > 0.99
    assert metrics["flower_idf1"] > 0.98
    assert told["frames_without_pose"] < 0.12 * told["views"]
