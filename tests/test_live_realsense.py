"""A RealSense that is software: images go in and come out as views, depth aligned to colour."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import pytest

from cluster_slam.errors import InputError
from cluster_slam.live.realsense import RealSenseCamera, camera_of, open_realsense
from cluster_slam.live.view import View

rs: Any = pytest.importorskip("pyrealsense2", reason="pyrealsense2 (extra realsense) is not installed")
WIDTH, HEIGHT = 64, 48
SCALE = 0.0001  # a D405's: 0.1 mm


def intrinsics() -> Any:
    out = rs.intrinsics()
    out.width, out.height = WIDTH, HEIGHT
    out.fx, out.fy, out.ppx, out.ppy = 60.0, 61.0, 31.5, 23.5
    out.model, out.coeffs = rs.distortion.brown_conrady, [0.0] * 5
    return out


class Device:
    """A camera whose depth is ``baseline`` metres to the side of its colour; 0: one imager for both, as in a D405."""

    def __init__(self, baseline: float = 0.0, *, start: bool = True) -> None:
        self.device = rs.software_device()
        self.sensors = [self.device.add_sensor("Depth"), self.device.add_sensor("Color")]
        self.profiles = [
            self.sensors[0].add_video_stream(self._stream(rs.stream.depth, 0, 2, rs.format.z16)),
            self.sensors[1].add_video_stream(self._stream(rs.stream.color, 1, 3, rs.format.bgr8)),
        ]
        self.sensors[0].add_read_only_option(rs.option.depth_units, SCALE)
        if not start:
            return
        extrinsics = rs.extrinsics()
        extrinsics.rotation = [1.0, 0, 0, 0, 1, 0, 0, 0, 1]
        extrinsics.translation = [baseline, 0.0, 0.0]
        self.profiles[0].register_extrinsics_to(self.profiles[1], extrinsics)
        self.syncer = rs.syncer()
        self.device.create_matcher(rs.matchers.dlr_c)
        for sensor, profile in zip(self.sensors, self.profiles, strict=True):
            sensor.open(profile)
            sensor.start(self.syncer)

    @staticmethod
    def _stream(kind: Any, uid: int, n_bytes: int, pixel: Any) -> Any:
        out = rs.video_stream()
        out.type, out.uid, out.width, out.height, out.fps = kind, uid, WIDTH, HEIGHT, 30
        out.bpp, out.fmt, out.intrinsics = n_bytes, pixel, intrinsics()
        return out

    def show(self, number: int, stamp_ms: float, colour: Any, depth: Any) -> None:
        """One frame of each stream."""
        for sensor, profile, image, n in zip(self.sensors, self.profiles, (depth, colour), (2, 3), strict=True):
            frame = rs.software_video_frame()
            frame.pixels, frame.stride, frame.bpp = image, n * WIDTH, n
            frame.timestamp, frame.frame_number = stamp_ms, number
            frame.domain, frame.profile = rs.timestamp_domain.system_time, profile.as_video_stream_profile()
            if n == 2:
                frame.depth_units = SCALE
            sensor.on_video_frame(frame)


def take(camera: RealSenseCamera, n: int) -> list[View]:
    views: list[View] = []
    end = time.monotonic() + 5
    while len(views) < n and time.monotonic() < end:
        views += camera.take()
        time.sleep(0.01)
    return views


def test_images_come_through_unchanged() -> None:
    """The syncer lets the first frame of each stream go alone, so that one makes no view."""
    rng = np.random.default_rng(2)
    device, stopped = Device(), []
    colours = rng.integers(0, 255, (6, HEIGHT, WIDTH, 3), dtype=np.uint8)
    depth = np.full((HEIGHT, WIDTH), 5000, np.uint16)
    depth[10:20, 10:20] = 4000
    begin_ms = 1e3 * time.time()
    views: list[View] = []
    with RealSenseCamera(device.syncer, lambda: stopped.append(1), SCALE) as camera:
        for k in range(6):
            device.show(k + 1, begin_ms + 1000 / 30 * k, colours[k], depth)
            time.sleep(1 / 30)
            views += camera.take()
        views += take(camera, 5 - len(views))
    assert stopped == [1]
    assert len(views) == 5
    for k, view in enumerate(views, 1):
        assert view.stamp == pytest.approx(1e-3 * begin_ms + k / 30, abs=1e-6)
        assert view.colour is not None
        assert view.depth is not None
        assert np.array_equal(view.colour, colours[k])
        assert view.depth.dtype == np.uint16
        assert np.array_equal(view.depth, depth)
    assert camera.intrinsics is not None
    assert (camera.intrinsics.fx, camera.intrinsics.cy, camera.intrinsics.width) == (60.0, 23.5, WIDTH)


def test_depth_is_aligned_to_colour() -> None:
    """A wall at 0.5 m, a square at 0.4 m before it: 2 cm to the side is a shift of fx * 0.02 / z = 3 pixels."""
    device = Device(0.02)
    depth = np.full((HEIGHT, WIDTH), 5000, np.uint16)
    depth[10:30, 20:30] = 4000
    begin_ms = 1e3 * time.time()
    views: list[View] = []
    with RealSenseCamera(device.syncer, lambda: None, SCALE) as camera:
        for k in range(4):
            device.show(k + 1, begin_ms + 1000 / 30 * k, np.zeros((HEIGHT, WIDTH, 3), np.uint8), depth)
            time.sleep(1 / 30)
            views += camera.take()
    aligned = views[-1].depth
    assert aligned is not None
    columns = np.flatnonzero(np.median(aligned[15:25], axis=0) == 4000)
    assert abs(columns.mean() - (24.5 + 60 * 0.02 / 0.4)) <= 1.0


def test_a_distortion_that_is_not_ours_is_refused() -> None:
    wrong = intrinsics()
    wrong.model, wrong.coeffs = rs.distortion.inverse_brown_conrady, [0.1, 0, 0, 0, 0]
    with pytest.raises(InputError, match="inverse_brown_conrady"):
        camera_of(wrong)


def test_no_camera_is_attached() -> None:
    if len(rs.context().query_devices()):
        pytest.skip("a RealSense is attached")
    with pytest.raises(InputError, match="camera realsense"):
        open_realsense()
