"""``cluster-slam record``: an emulated arm and a folder as camera become a session, whatever happens on the way."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from rtde_help import SPEED, EmulatedRobot, free_host, line_motion

from cluster_slam.cli.app import run
from cluster_slam.geometry import so3_log
from cluster_slam.io.camera_info import read_camera
from cluster_slam.io.exporters.pictures import open_pictures
from cluster_slam.io.importers.rtde_csv import read_rtde_csv
from cluster_slam.io.metadata import read_metadata
from cluster_slam.io.session import open_session

Process = subprocess.Popen[str]


def recorder(robot: EmulatedRobot, out: Path, *options: str) -> Process:
    """``cluster-slam record`` as a process of its own."""
    command = [sys.executable, "-m", "cluster_slam.cli", "record", "--robot", robot.host, "-o", str(out), "--json"]
    return subprocess.Popen([*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def wait_for(path: Path) -> None:
    end = time.monotonic() + 20
    while not path.exists():
        assert time.monotonic() < end, f"{path} does not come"
        time.sleep(0.02)


def fill(camera: Path, seconds: float) -> None:
    """Two points thirty times a second, with stamps of now."""
    end = time.time() + seconds
    with (camera / "flowers.csv").open("a") as file:
        while (now := time.time()) < end:
            file.write(f"{now!r},0.1,0.2,0.5\n{now!r},0.2,0.2,0.6\n")
            file.flush()
            time.sleep(1 / 30)


def camera_folder(tmp_path: Path) -> Path:
    camera = tmp_path / "camera"
    camera.mkdir()
    (camera / "flowers.csv").write_text("timestamp,x,y,z\n")
    return camera


def test_a_camera_on_an_arm(tmp_path: Path) -> None:
    """Each frame has the pose of its time: the arm moves at 0.1 m/s, so 1 ms is 0.1 mm. The clocks' offset is known to
    the smallest delay; a busy machine may make that a few milliseconds.
    """
    camera, out = camera_folder(tmp_path), tmp_path / "session"
    with EmulatedRobot(line_motion(tmp_path), "--fault", "skew:200@0") as robot:
        process = recorder(robot, out, "--camera", str(camera), "--hand-eye", "0 0 0.05 0 0 0 1", "--plant", "row3")
        wait_for(tmp_path / "session.recording" / "robot.csv")
        time.sleep(0.3)
        fill(camera, 3.0)
        (camera / "done").touch()
        told = json.loads(process.communicate(timeout=20)[0])
    assert process.returncode == 0, told
    session = open_session(out)
    assert session.warnings == ()
    assert session.pose_frame == "T_world_flange"
    assert session.T_flange_camera is not None
    assert session.T_flange_camera[2, 3] == 0.05
    assert (session.id, session.plant) == ("session", "row3")
    assert session.n_frames == told["frames"] > 60
    assert len(session.observations) == 2 * session.n_frames
    x = session.poses[:, 0, 3]
    truth = SPEED * (session.stamps - robot.summary["began"])
    assert np.abs(x - truth).max() < 0.01 * SPEED + 1e-6
    speed = np.polyfit(session.stamps - session.stamps[0], x, 1)[0]
    assert speed == pytest.approx(SPEED, rel=2e-3)
    assert so3_log(session.poses[:, :3, :3])[:, 2] == pytest.approx(2 * x, abs=1e-6)  # 0.2 rad/s beside 0.1 m/s


def test_a_loss_does_not_end_it(tmp_path: Path) -> None:
    """Frames of the time without the robot have no pose, all others have, and the rows of the former are kept aside."""
    camera, out = camera_folder(tmp_path), tmp_path / "session"
    with EmulatedRobot(line_motion(tmp_path)) as robot:
        process = recorder(robot, out, "--camera", str(camera))
        wait_for(tmp_path / "session.recording" / "robot.csv")
        fill(camera, 1.0)
        robot.do("drop:0.5")
        fill(camera, 2.5)
        (camera / "done").touch()
        told = json.loads(process.communicate(timeout=20)[0])
    assert process.returncode == 1  # more than a tenth of the frames
    assert told["status"] == "poor"
    assert len(told["robot_lost_s"]) == 1
    assert 0.4 < told["robot_lost_s"][0] < 2.0
    session = open_session(out)
    aside = len((out / "unlocated.csv").read_text().splitlines()) - 1
    assert aside == 2 * told["frames_without_pose"] > 0
    rows = len((out / "rows.csv").read_text().splitlines()) - 1
    assert rows == aside + len(session.observations)
    assert np.abs(session.poses[:, 0, 3] - SPEED * (session.stamps - robot.summary["began"])).max() < 0.01 * SPEED
    assert "lost" in (out / "notices.csv").read_text()


def test_pictures_on_an_arm(tmp_path: Path) -> None:
    """Images that a program drops into a folder, bit by bit, with the folder's intrinsics and unit of depth."""
    camera, out = tmp_path / "camera", tmp_path / "session"
    for name in ("rgb", "depth"):
        (camera / name).mkdir(parents=True)
    matrix = "  rows: 3\n  cols: 3\n  data: [30.0, 0, 15.5, 0, 30, 11.5, 0, 0, 1]\n"
    (camera / "camera.yaml").write_text(f"image_width: 32\nimage_height: 24\ncamera_matrix:\n{matrix}")
    toml = 'format = 1\nid = "c"\n[frames]\npose = "T_world_camera"\n[depth]\nscale = 0.0001\ncamera = "d405"\n'
    (camera / "session.toml").write_text(toml)
    rng = np.random.default_rng(6)
    colours = rng.integers(0, 256, (10, 24, 32, 3), dtype=np.uint8)
    depths = rng.integers(3000, 8000, (10, 24, 32)).astype(np.uint16)
    with EmulatedRobot(line_motion(tmp_path)) as robot:
        process = recorder(robot, out, "--camera", str(camera))
        wait_for(tmp_path / "session.recording" / "robot.csv")
        time.sleep(0.3)
        for colour, depth in zip(colours, depths, strict=True):
            now = repr(time.time())
            cv2.imwrite(str(camera / "depth" / f"{now}.png"), depth)
            cv2.imwrite(str(camera / "rgb" / f"{now}.png"), colour)
            time.sleep(0.1)
        (camera / "done").touch()
        told = json.loads(process.communicate(timeout=20)[0])
    assert process.returncode == 0, told
    assert told["frames"] == 10
    session = open_pictures(out)
    assert np.abs(session.poses[:, 0, 3] - SPEED * (session.stamps - robot.summary["began"])).max() < 0.01 * SPEED
    metadata, _ = read_metadata(out / "session.toml")
    assert (metadata.depth.scale, metadata.depth.camera) == (0.0001, "d405")
    assert read_camera(out / "camera.yaml").cx == 15.5
    for name, images in (("rgb", colours), ("depth", depths)):
        rows = [line.split() for line in (out / f"{name}.txt").read_text().splitlines()[1:]]
        assert [float(stamp) for stamp, _ in rows] == session.stamps.tolist()
        found = [cv2.imread(str(out / file), cv2.IMREAD_UNCHANGED) for _, file in rows]
        assert np.array_equal(np.stack(found), images)


def test_a_camera_that_gives_nothing(tmp_path: Path) -> None:
    """Rows that are none are told, and a recording without a view is poor."""
    camera = camera_folder(tmp_path)
    with EmulatedRobot(line_motion(tmp_path)) as robot:
        process = recorder(robot, tmp_path / "session", "--camera", str(camera))
        wait_for(tmp_path / "session.recording" / "robot.csv")
        (camera / "flowers.csv").write_text("timestamp,x,y,z\n" + "now,1,2,3\n" * 12)
        time.sleep(0.5)
        (camera / "done").touch()
        told = json.loads(process.communicate(timeout=20)[0])
    assert process.returncode == 1
    assert told["views"] == 0
    texts = [text for text in told["notices"] if text.startswith("camera: ")]
    assert len(texts) == 2
    assert texts[1].endswith("(10 in all)")


def test_the_arm_alone_until_ctrl_c(tmp_path: Path) -> None:
    out = tmp_path / "session"
    with EmulatedRobot(line_motion(tmp_path)) as robot:
        process = recorder(robot, out, "--rate", "50")
        wait_for(tmp_path / "session.recording" / "robot.csv")
        time.sleep(1.0)
        process.send_signal(signal.SIGINT)
        told = json.loads(process.communicate(timeout=20)[0])
    assert process.returncode == 0
    session = open_session(out)
    assert session.n_frames == told["robot_samples"] > 30
    assert len(session.observations) == 0
    assert read_rtde_csv(out / "robot.csv").poses.shape == (session.n_frames, 4, 4)
    assert run(["rtde-emulator", str(out / "robot.csv"), "--duration", "0", "--bind", free_host(), "--quiet"]) == 0


def test_whoever_is_killed_loses_a_second(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Kill -9; what was recorded becomes a session by --finish, and nobody writes over it before."""
    out = tmp_path / "session"
    with EmulatedRobot(line_motion(tmp_path)) as robot:
        process = recorder(robot, out)
        wait_for(tmp_path / "session.recording" / "robot.csv")
        time.sleep(2.6)
        process.kill()
        process.communicate()
        assert not out.exists()
        assert run(["record", "--robot", robot.host, "-o", str(out)]) == 2
        assert "record --finish" in capsys.readouterr().err
    assert run(["record", "--finish", "-o", str(out), "--quiet"]) == 0
    session = open_session(out)
    assert session.stamps[-1] - session.stamps[0] > 1.0
    assert not (tmp_path / "session.recording").exists()
    assert run(["record", "--finish", "-o", str(out)]) == 2
    assert "expected an unfinished recording" in capsys.readouterr().err


def test_a_row_that_is_cut_off_is_left_out(tmp_path: Path) -> None:
    from cluster_slam.live.finish import finish
    from cluster_slam.live.journal import FRAME_COLUMNS, ROBOT_COLUMNS, ROW_COLUMNS

    journal = tmp_path / "s.recording"
    journal.mkdir()
    rows = [f"{1.7e9 + 0.01 * k},{0.01 * k},{0.001 * k},0,0,0,0,0,0,0,0,0,0,0,7,1" for k in range(100)]
    (journal / "robot.csv").write_text("\n".join([ROBOT_COLUMNS, *rows, "1700000001.0,1.0,0.1,0,0"]))
    (journal / "frames.csv").write_text(f"{FRAME_COLUMNS}\n1700000000.5,5.0,6.0,1\n17000000")
    (journal / "rows.csv").write_text(f"{ROW_COLUMNS}\n1700000000.5,0,0,1,,1e-6,0,0,1e-6,0,1e-6\n1700000000.5,0,0")
    (journal / "session.toml").write_text('format = 1\nid = "s"\n[frames]\npose = "T_world_camera"\n')
    done = finish(tmp_path / "s")
    assert (done.n_samples, done.n_frames, done.n_points) == (100, 1, 1)
    session = open_session(tmp_path / "s")
    assert session.poses[0, 0, 3] == pytest.approx(0.05, abs=1e-6)


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (["-o", "{tmp}/s"], "no --robot HOST"),
        (["--robot", "127.1.1.1", "-o", "{tmp}"], "expected a free name"),
        (["--robot", "127.1.1.1", "-o", "{tmp}/s", "--camera", "{tmp}/none"], "expected a folder"),
        (["--robot", "127.1.1.1", "-o", "{tmp}/s", "--hand-eye", "1 2 x"], "seven numbers"),
        (["--robot", "127.1.1.1", "-o", "{tmp}/s", "--hand-eye", "1 2", "--calibration", "c"], "one of them"),
        (["--robot", "127.1.1.1", "-o", "{tmp}/s", "--calibration", "{tmp}/c.toml"], "missing"),
    ],
)
def test_bad_options(tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], match: str) -> None:
    (tmp_path / "something").touch()
    assert run(["record", *(one.replace("{tmp}", str(tmp_path)) for one in arguments)]) == 2
    error = capsys.readouterr().err
    assert match in error
    assert len(error.splitlines()) == 1
    assert sorted(os.listdir(tmp_path)) == ["something"]


def test_no_robot(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    from cluster_slam.live import robot_source

    monkeypatch.setattr(
        robot_source.RobotSource.__init__,
        "__kwdefaults__",
        {
            **robot_source.RobotSource.__init__.__kwdefaults__,
            "wait_s": 0.7,
        },
    )
    assert run(["record", "--robot", "127.1.1.1", "-o", str(tmp_path / "s")]) == 2
    assert "robot 127.1.1.1: no data" in capsys.readouterr().err
    assert os.listdir(tmp_path) == []


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full on this system")
def test_a_full_disk(tmp_path: Path) -> None:
    """What was recorded stays; the message says how to go on."""
    from cluster_slam.errors import OutputError
    from cluster_slam.live.journal import Journal

    with Journal(tmp_path / "s", "") as journal:
        journal._files["robot.csv"].close()
        journal._files["robot.csv"] = Path("/dev/full").open("w")  # noqa: SIM115
        journal._files["robot.csv"].write("x\n")
        journal._synced -= 10.0
        with pytest.raises(OutputError, match=r"No space left.*record --finish"):
            journal.keep()
