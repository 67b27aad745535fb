"""RealSense recordings: ``.db3`` by librealsense's own recorder, ``.bag`` with the topics of its predecessor."""

from __future__ import annotations

import json
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="rosbags (extra bags) is not installed")

import bags
import cv2
from bags import BagWriter
from test_import_bags import images, listed

from cluster_slam.cli.app import run
from cluster_slam.geometry import so3_exp, transform
from cluster_slam.io.camera_info import read_camera
from cluster_slam.io.importers.registration import Registration
from cluster_slam.io.metadata import read_metadata
from cluster_slam.sensors.camera import Camera

TURN = so3_exp(np.array([0.0, 0.02, 0.0]))


def shots(height: int, width: int) -> tuple[np.ndarray, np.ndarray]:
    """Colour (4, h, w, 3) and depth (4, h, w): a wall at half a metre, a box before it, in units of 0.1 mm."""
    colour = np.random.default_rng(1).integers(0, 256, (4, height, width, 3), dtype=np.uint8)
    depth = np.full((4, height, width), 5000, np.uint16)
    depth[:, 10:30, 20:30] = 4000
    return colour, depth


def record(path: Path, translation: list[float], rotation: np.ndarray) -> float:
    """Let librealsense record a software device; the stamp of the first frame, s."""
    rs: Any = pytest.importorskip("pyrealsense2", reason="pyrealsense2 (extra realsense) is not installed")
    from test_live_realsense import HEIGHT, SCALE, WIDTH, Device

    device = Device(start=False)
    extrinsics = rs.extrinsics()
    extrinsics.rotation, extrinsics.translation = rotation.T.ravel().tolist(), translation  # column by column
    device.profiles[0].register_extrinsics_to(device.profiles[1], extrinsics)
    recorder = rs.recorder(str(path), device.device)
    queue = rs.frame_queue(100)
    sensors = recorder.query_sensors()
    for sensor in sensors:
        sensor.open(sensor.get_stream_profiles()[0])
        sensor.start(queue)
    begin_ms = 1e3 * time.time()
    colour, depth = shots(HEIGHT, WIDTH)
    for k in range(4):
        device.show(k + 1, begin_ms + 100 / 3 * k, colour[k], depth[k])
        time.sleep(0.04)
    time.sleep(0.3)
    for sensor in sensors:
        sensor.stop()
        sensor.close()
    recorder.pause()
    assert SCALE == 0.0001
    return 1e-3 * begin_ms


def test_one_imager_is_read_back_exactly(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """A D405's: stamps from the metadata, the unit from the options, pixels bit by bit."""
    begin = record(tmp_path / "r.db3", [0.0, 0.0, 0.0], np.eye(3))
    out = tmp_path / "s"
    assert run(["import", str(tmp_path / "r.db3"), "-o", str(out), "--still", "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    colour, depth = shots(48, 64)
    assert np.array_equal(images(out, "rgb"), colour)
    assert np.array_equal(images(out, "depth"), depth)
    assert [stamp for stamp, _ in listed(out, "rgb")] == pytest.approx([begin + k / 30 for k in range(4)], abs=2e-6)
    assert read_metadata(out / "session.toml")[0].depth.scale == 0.0001
    assert told["median_depth_m"] == pytest.approx(0.5)
    camera = read_camera(out / "camera.yaml")
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (60.0, 61.0, 31.5, 23.5)


def test_depth_is_brought_to_the_colours_pixels(tmp_path: Path) -> None:
    """2 cm to the side and turned a little: each point of the box and the wall projects where colour sees it."""
    record(tmp_path / "r.db3", [0.02, 0.0, 0.0], TURN)
    assert run(["import", str(tmp_path / "r.db3"), "-o", str(tmp_path / "s"), "--still", "--quiet"]) == 0
    found = images(tmp_path / "s", "depth")[0]
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = TURN, [0.02, 0, 0]
    corners = np.array([[(u - 31.5) / 60 * 0.4, (v - 23.5) / 61 * 0.4, 0.4] for u in (20, 29) for v in (10, 29)])
    there = transform(T, corners)
    u = 60 * there[:, 0] / there[:, 2] + 31.5
    v = 61 * there[:, 1] / there[:, 2] + 23.5
    middle = found[int(v.mean()), int(u.mean())]
    assert middle == pytest.approx(there[:, 2].mean() / 0.0001, rel=2e-3)
    rows, columns = np.nonzero((found > 3900) & (found < 4200))
    assert [columns.min(), columns.max()] == pytest.approx([u.min(), u.max()], abs=1.01)
    assert [rows.min(), rows.max()] == pytest.approx([v.min(), v.max()], abs=1.01)
    inside = found[rows.min() + 1 : rows.max(), columns.min() + 1 : columns.max()]
    assert (inside > 0).all()  # no holes


def test_a_recording_of_before(tmp_path: Path) -> None:
    """``.bag``: raw images of 16 bits, the unit as a number, extrinsics as a transform. No real file was at hand."""
    stream = {"Depth_0": "/device_0/sensor_0/Depth_0", "Color_0": "/device_0/sensor_1/Color_0"}
    with BagWriter(tmp_path / "r.bag", "ros1") as bag:
        units = bag.make("std_msgs/msg/Float32", 0.0001)
        bag.write("/device_0/sensor_0/option/Depth_Units/value", 0, units)
        for k, name in enumerate(stream.values()):
            bag.info(f"{name}/info/camera_info", 0)
            shift = bag.make("geometry_msgs/msg/Vector3", 0.0, 0.0, 0.0)
            turn = bag.make("geometry_msgs/msg/Quaternion", 0.0, 0.0, 0.0, 1.0)
            bag.write(f"{name}/tf/0", k, bag.make("geometry_msgs/msg/Transform", shift, turn))
        for k, ns in enumerate(bags.stamps()):
            arrival = 33_000_000 * (k + 1)
            bag.image(f"{stream['Depth_0']}/image/data", ns, bags.depths()[k], "mono16", arrival=arrival)
            bag.image(f"{stream['Color_0']}/image/data", ns, bags.colours()[k][..., ::-1], "rgb8", arrival=arrival)
    out = tmp_path / "s"
    assert run(["import", str(tmp_path / "r.bag"), "-o", str(out), "--still", "--quiet"]) == 0
    assert np.array_equal(images(out, "depth"), bags.depths())
    assert np.array_equal(images(out, "rgb"), bags.colours())
    assert read_metadata(out / "session.toml")[0].depth.scale == 0.0001
    assert [stamp for stamp, _ in listed(out, "rgb")] == [ns / 10**9 for ns in bags.stamps()]


def test_the_nearest_of_two_wins() -> None:
    """A near and a far pixel that fall on the same place."""
    camera = Camera(10.0, 10.0, 4.5, 4.5, np.zeros(8), 10, 10)
    T = np.eye(4)
    T[0, 3] = 0.1
    depth = np.zeros((10, 10), np.uint16)
    depth[5, 2], depth[5, 3] = 500, 1000  # shifts by 2 pixels and by 1: both to column 4
    found = Registration(camera, camera, T, 0.001)(depth)
    assert found[5, 4] == 500
    assert np.count_nonzero(found) == 1


def test_a_finer_camera_has_no_holes() -> None:
    """Half the pixels in depth: each covers two by two of colour's."""
    coarse = Camera(10.0, 10.0, 4.5, 4.5, np.zeros(8), 10, 10)
    fine = Camera(20.0, 20.0, 9.5, 9.5, np.zeros(8), 20, 20)
    found = Registration(coarse, fine, np.eye(4), 0.001)(np.full((10, 10), 700, np.uint16))
    assert found.shape == (20, 20)
    assert (found == 700).all()
    assert cv2.imencode(".png", found)[0]
