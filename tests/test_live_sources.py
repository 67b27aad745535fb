"""Sources of frames: poses at a camera's stamps, folders that grow, sessions replayed."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from folders import FLOWERS_COV, LEVEL_3, write_folder

from cluster_slam.errors import ConfigError, InputError
from cluster_slam.geometry import se3_exp, se3_log
from cluster_slam.io.session import open_session
from cluster_slam.live.collect import Collector
from cluster_slam.live.motion_file import read_motion
from cluster_slam.live.replay import Replay
from cluster_slam.live.robot_poses import PoseState, RobotPoses
from cluster_slam.live.setup import live_header, mount_of_numbers, open_camera, read_mount
from cluster_slam.live.watched import WatchedFolder
from cluster_slam.sensors.interpolation import interpolate, pose_from_rotation_vector, rotation_vector_from_pose
from cluster_slam.sensors.rtde.link import RobotSample

UNIX = 1.7e9
STILL = (0.0, -1.0, 1.0, 0.0, 0.5, 0.0)


def sample(stamp: float, x: float, *, arrival: float | None = None, joints: tuple[float, ...] = STILL) -> RobotSample:
    """A sample at x whose joints turn with it, unless they are given."""
    turned = joints if joints is not STILL else (x, *STILL[1:])
    return RobotSample(UNIX + stamp if arrival is None else arrival, stamp, (x, 0, 0, 0, 0, x), turned, 7, 1)


def test_rotation_vectors_are_rotations() -> None:
    rng = np.random.default_rng(3)
    T = se3_exp(rng.normal(size=(50, 6)))
    assert np.abs(pose_from_rotation_vector(rotation_vector_from_pose(T)) - T).max() < 1e-12


def test_interpolation_keeps_constant_motion() -> None:
    """A turn at a constant rate about a fixed axis, positions on a line: met exactly in between."""
    t = np.array([0.0, 1.0, 3.0])
    rows = np.column_stack([0.1 * t, -t, 2 * t, 0 * t, 0.4 * t, 0 * t])
    at = np.array([-1.0, 0.25, 1.0, 2.5, 9.0])
    clipped = np.clip(at, 0, 3)
    truth = np.column_stack([0.1 * clipped, -clipped, 2 * clipped, 0 * at, 0.4 * clipped, 0 * at])
    found = interpolate(t, pose_from_rotation_vector(rows), at)
    assert np.abs(se3_log(np.linalg.solve(pose_from_rotation_vector(truth), found))).max() < 1e-12


def test_the_pose_at_a_time() -> None:
    poses = RobotPoses()
    assert poses.at(UNIX).state is PoseState.NOT_YET
    poses.add(sample(100 + 0.01 * k, 0.001 * k) for k in range(101))
    answer = poses.at(UNIX + 100.505)
    assert answer.T_world_flange is not None
    assert rotation_vector_from_pose(answer.T_world_flange) == pytest.approx([0.0505, 0, 0, 0, 0, 0.0505])
    assert poses.at(UNIX + 101.02).state is PoseState.NOT_YET
    assert poses.at(UNIX + 99.0).state is PoseState.TOO_OLD


def test_no_pose_is_made_up_where_the_robot_was_silent() -> None:
    poses = RobotPoses()
    poses.add([sample(100 + 0.01 * k, 0.0) for k in range(100)])
    poses.add([sample(102 + 0.01 * k, 0.0) for k in range(100)])
    assert poses.at(UNIX + 101.5).state is PoseState.LOST
    assert poses.at(UNIX + 102.5).state is PoseState.KNOWN


def test_a_controller_that_restarts_begins_a_new_stretch() -> None:
    poses = RobotPoses()
    poses.add([sample(100 + 0.01 * k, 0.001 * k) for k in range(100)])
    told = poses.add([sample(0.01 * k, 0.5, arrival=UNIX + 105 + 0.01 * k) for k in range(100)])
    assert len(told) == 1
    assert "clock was set" in told[0]
    states = [poses.at(UNIX + t).state for t in (90, 100.5, 103, 105.5, 107)]
    assert states == [PoseState.TOO_OLD, PoseState.KNOWN, PoseState.LOST, PoseState.KNOWN, PoseState.NOT_YET]
    answer = poses.at(UNIX + 105.5).T_world_flange
    assert answer is not None
    assert answer[0, 3] == pytest.approx(0.5)


def test_late_arrivals_do_not_move_the_poses() -> None:
    """Delays of up to 20 ms; the pose at a time is that of the controller's clock, within the smallest of a second."""
    rng = np.random.default_rng(5)
    poses = RobotPoses()
    stamps = 50 + np.arange(0, 20, 0.008)
    late = rng.exponential(0.005, len(stamps))
    for s, d in zip(stamps.tolist(), late.tolist(), strict=True):
        poses.add([sample(s, 0.25 * (s - 50), arrival=UNIX + s + d)])
    found = poses.at(UNIX + 69.0).T_world_flange
    assert found is not None
    assert found[0, 3] == pytest.approx(0.25 * 19.0, abs=0.25 * 5e-4)


def test_a_changed_tool_is_told() -> None:
    poses = RobotPoses()
    assert poses.add([sample(0.01 * k, 0.01 * k) for k in range(5)]) == []
    last = (0.04, *STILL[1:])
    told = poses.add([sample(0.05, 0.04, joints=last), sample(0.06, 0.06, joints=last)])
    assert len(told) == 1
    assert "TCP" in told[0]


def test_joints_that_never_move_tell_nothing() -> None:
    """A controller that has no joints says zero for ever."""
    poses = RobotPoses()
    assert poses.add([sample(0.01 * k, 0.01 * k, joints=(0.0,) * 6) for k in range(9)]) == []


def test_memory_stays_bounded() -> None:
    poses = RobotPoses()
    poses.add(sample(0.1 * k, 0.0) for k in range(2000))
    assert poses.at(UNIX + 150).state is PoseState.TOO_OLD
    assert poses.at(UNIX + 190).state is PoseState.KNOWN


# --- replay


def test_a_session_as_frames(tmp_path: Path) -> None:
    session = open_session(write_folder(tmp_path / "s", dict(LEVEL_3)))
    source = Replay(session)
    frames = list(source.frames())
    assert [frame.stamp for frame in frames] == session.stamps.tolist()
    assert [len(frame) for frame in frames] == [2, 0, 1]
    assert np.array_equal(frames[2].points, session.observations.points[2:])
    assert np.array_equal(np.stack([frame.pose for frame in frames]), session.poses)
    assert source.header.n_frames == 0
    assert source.header.noise == session.noise


def test_a_session_at_its_pace(tmp_path: Path) -> None:
    session = open_session(write_folder(tmp_path / "s", dict(LEVEL_3)))
    begin = time.monotonic()
    assert len(list(Replay(session, is_realtime=True).frames())) == 3
    assert 0.2 <= time.monotonic() - begin < 2.0


def test_frames_become_the_session_that_they_came_from(tmp_path: Path) -> None:
    """Those without a pose, doubled or late are not kept."""
    session = open_session(write_folder(tmp_path / "s", {**LEVEL_3, "flowers.csv": FLOWERS_COV}))
    source = Replay(session)
    collector = Collector(source.header)
    first, second, third = source.frames()
    lost = replace(second, pose=np.full((4, 4), np.nan))
    assert [collector.add(f) for f in (first, lost, second, second, first, third)] == [
        True,
        False,
        True,
        False,
        False,
        True,
    ]
    made = collector.session()
    assert np.array_equal(made.stamps, session.stamps)
    assert np.array_equal(made.poses, session.poses)
    for name in ("frame", "points", "covs", "scores"):
        assert np.array_equal(getattr(made.observations, name), getattr(session.observations, name), equal_nan=True)
    assert Collector(source.header).session().n_frames == 0


# --- a folder that grows


def take(camera: WatchedFolder, seconds: float = 0.05) -> list[tuple[float, int]]:
    """Stamps and numbers of points of what a camera gives now."""
    time.sleep(seconds)
    return [(view.stamp, len(view.points)) for view in camera.take()]


def test_rows_as_they_are_added(tmp_path: Path) -> None:
    table = tmp_path / "flowers.csv"
    camera = WatchedFolder(tmp_path)
    assert take(camera) == []
    with table.open("w") as file:
        file.write("timestamp,x,y,z,score\n1.0,0.1,0.2,0.5,0.9\n1.0,0.2,0.2,0.5,\n2.0,0.1,0.2,0")
        file.flush()
        assert take(camera) == []  # the frame may go on, and a row is half written
        file.write(".5,0.7\n")
        file.flush()
        assert take(camera) == [(1.0, 2)]
        assert take(camera, 0.3) == [(2.0, 1)]  # nothing came for a while
        file.write("rubbish\n3.0,a,b,c,d\n3.0,1,2,3,0.5\n4.0,1,1,1,1\n")
    assert take(camera) == [(3.0, 1)]
    (problem,) = camera.problems()
    assert "flowers.csv: 'rubbish' is no row of timestamp,x,y,z,score" in problem
    assert camera.problems() == []
    (tmp_path / "done").touch()
    assert take(camera, 0.3) == [(4.0, 1)]
    assert not camera.is_over
    assert take(camera) == []
    assert camera.is_over


def test_what_stops_coming_is_complete(tmp_path: Path) -> None:
    (tmp_path / "flowers.csv").write_text("timestamp,x,y,z\n1.0,0.1,0.2,0.5\n")
    camera = WatchedFolder(tmp_path)
    first = take(camera)
    assert first + take(camera, 0.3) == [(1.0, 1)]


def test_sigmas_are_the_sessions(tmp_path: Path) -> None:
    write_folder(tmp_path, {"session.toml": LEVEL_3["session.toml"]})
    (tmp_path / "flowers.csv").write_text("timestamp,x,y,z\n1.0,0.1,0.2,0.5\n2.0,1,1,1\n")
    (view,) = WatchedFolder(tmp_path).take()
    assert np.allclose(view.covs, 0.004**2 * np.eye(3))
    assert view.points == pytest.approx(np.array([[0.1, 0.2, 0.5]]))
    assert np.isnan(view.scores).all()


def test_images_as_they_appear(tmp_path: Path) -> None:
    import cv2

    camera = WatchedFolder(tmp_path)
    (tmp_path / "rgb").mkdir()
    (tmp_path / "depth").mkdir()
    colour = np.arange(60, dtype=np.uint8).reshape(4, 5, 3)
    depth = np.arange(20, dtype=np.uint16).reshape(4, 5) * 1000
    cv2.imwrite(str(tmp_path / "depth" / "5.25.png"), depth)
    whole = cv2.imencode(".png", colour)[1].tobytes()
    (tmp_path / "rgb" / "5.25.png").write_bytes(b"")
    assert camera.take() == []
    (tmp_path / "rgb" / "5.25.png").write_bytes(whole)
    time.sleep(0.05)
    (view,) = camera.take()
    assert view.stamp == 5.25
    assert view.colour is not None
    assert view.depth is not None
    assert np.array_equal(view.colour, colour)
    assert np.array_equal(view.depth, depth)
    time.sleep(0.05)
    assert camera.take() == []


def test_depth_of_8_bits_is_refused(tmp_path: Path) -> None:
    import cv2

    for folder in ("rgb", "depth"):
        (tmp_path / folder).mkdir()
        cv2.imwrite(str(tmp_path / folder / "1.0.png"), np.zeros((4, 5), np.uint8))
    with pytest.raises(InputError, match="expected 16 bits"):
        WatchedFolder(tmp_path).take()


def test_a_folder_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="expected a folder"):
        open_camera(str(tmp_path / "nowhere"))


# --- what is known beforehand


def test_a_mount_by_numbers() -> None:
    mount = mount_of_numbers([0.0, 0.0, 0.05, 0.0, 0.0, 0.0, 1.0])
    header = live_header(mount, id="x", plant="row3")
    assert header.T_flange_camera is not None
    assert header.T_flange_camera[2, 3] == 0.05
    assert header.noise.hand_eye_translation == 0.005
    with pytest.raises(ConfigError, match="unit quaternion"):
        mount_of_numbers([0, 0, 0, 0, 0, 0, 2])


def test_a_mount_of_smooth(tmp_path: Path) -> None:
    path = tmp_path / "calibration.toml"
    rows = ", ".join(f"[{', '.join('4e-6' if i == j else '0.0' for j in range(6))}]" for i in range(6))
    path.write_text(f"T_flange_camera = [0, 0, 0.05, 0, 0, 0, 1]\ncovariance = [{rows}]\n")
    assert read_mount(path).sigma_translation == pytest.approx(0.002)
    path.write_text("T_flange = 1")
    with pytest.raises(InputError, match="expected T_flange_camera"):
        read_mount(path)


def test_a_motion_that_is_none(tmp_path: Path) -> None:
    path = tmp_path / "motion.txt"
    path.write_text("# nothing\n")
    with pytest.raises(InputError, match="no pose"):
        read_motion(path)
    with pytest.raises(InputError, match="missing"):
        read_motion(tmp_path / "nowhere.txt")
