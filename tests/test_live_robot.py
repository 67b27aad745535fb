"""A camera on an arm as a source of frames: poses, losses, detection, and a tracker that takes it all."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np
import pytest
from rtde_help import SPEED, EmulatedRobot, line_motion
from test_record import camera_folder, fill

from cluster_slam.geometry import Array
from cluster_slam.live.detecting import FlowerFinder
from cluster_slam.live.robot import open_robot
from cluster_slam.live.setup import NoCamera, mount_of_numbers
from cluster_slam.live.view import NoticeKind, View, empty_view
from cluster_slam.online.tracker import OnlineTracker
from cluster_slam.records import Frame, ImageDetections
from cluster_slam.sensors.camera import Camera

MOUNT = mount_of_numbers([0, 0, 0, 0, 0, 0, 1])


def test_a_tracker_goes_on_through_a_loss(tmp_path: Path) -> None:
    """Two flowers at rest past which the arm moves; the robot is gone for half a second. Frames without a pose say so,
    and the tracker knows its flowers again.
    """
    camera = camera_folder(tmp_path)
    frames: list[Frame] = []
    with EmulatedRobot(line_motion(tmp_path)) as robot, open_robot(robot.host, str(camera), MOUNT) as source:
        tracker = OnlineTracker(source.header.noise, source.header.T_flange_camera, calibration=None)
        time.sleep(0.2)

        def play() -> None:
            fill(camera, 1.5)
            robot.do("drop:0.5")
            fill(camera, 2.5)
            (camera / "done").touch()

        player = threading.Thread(target=play)
        player.start()
        for frame in source.frames():
            frames.append(frame)
            tracker.step(frame)
        player.join()
        notices = source.notices()
    known = np.array([np.isfinite(frame.pose).all() for frame in frames])
    stamps = np.array([frame.stamp for frame in frames])
    assert (np.diff(stamps) > 0).all()
    assert known[:20].mean() > 0.7  # a busy machine may make the robot seem silent for a moment
    assert known[-10:].mean() > 0.7
    assert 5 < (~known).sum() < 0.6 * len(frames)
    x = np.array([frame.pose[0, 3] for frame in frames])[known]
    assert np.abs(x - SPEED * (stamps[known] - robot.summary["began"])).max() < 0.01 * SPEED
    texts = [one.text for one in notices if one.kind is NoticeKind.NO_POSE]
    assert texts[0].startswith("the robot was silent at")
    counts = [int(text.split()[3]) for text in texts if text.startswith("poses again, after")]
    assert sum(counts) == (~known).sum()
    assert tracker.n_frames == known.sum()


def test_a_robot_that_is_lost_at_the_start(tmp_path: Path) -> None:
    from cluster_slam.errors import InputError
    from cluster_slam.live.robot_source import RobotSource
    from cluster_slam.live.setup import live_header
    from cluster_slam.sensors.rtde.link import RobotLink

    source = RobotSource(RobotLink("127.1.1.2"), NoCamera(), live_header(MOUNT), wait_s=0.5)
    with pytest.raises(InputError, match=r"127\.1\.1\.2: no data"), source:
        pass
    assert threading.active_count() < 20


class OneBox:
    """A detector that always sees one flower at pixel (200, 120)."""

    lean = 0.0

    def detect(self, image: np.ndarray) -> ImageDetections:
        assert image.shape == (240, 320, 3)
        return ImageDetections(np.array([[200.0, 120.0]]), np.array([[40.0, 40.0]]), np.array([0.75]))

    def sigma_px(self, sizes: Array) -> Array:
        return np.full(len(sizes), 0.5)


class Still(NoCamera):
    """Intrinsics and a unit, nothing else."""

    intrinsics = Camera(300.0, 300.0, 159.5, 119.5, np.zeros(8), 320, 240)
    depth_scale = 0.0001


def test_images_become_flowers() -> None:
    """A white disc at 0.6 m before a wall at 1 m: the flower is at (u - cx) / fx * z and so on."""
    v, u = np.mgrid[:240, :320]
    is_flower = (u - 200) ** 2 + (v - 120) ** 2 < 20**2
    colour = np.where(is_flower[..., None], 250, 60).astype(np.uint8) * np.ones(3, np.uint8)
    depth = np.where(is_flower, 6000, 10000).astype(np.uint16)
    base = empty_view(1.0, 1.0)
    view = View(1.0, 1.0, base.points, base.covs, base.scores, colour, depth)
    found = FlowerFinder(OneBox(), Still())(view)
    assert found.points == pytest.approx(np.array([[40.5 / 300 * 0.6, 0.5 / 300 * 0.6, 0.6]]), abs=5e-4)
    assert found.scores.tolist() == [0.75]
    assert 0.5 < found.covs[0, 1, 1] ** 0.5 / (0.5 / 300 * 0.6) < 2.0
    assert FlowerFinder(OneBox(), Still())(base) is base
