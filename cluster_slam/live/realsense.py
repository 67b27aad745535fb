"""A RealSense camera by ``pyrealsense2`` (extra ``realsense``): colour, and depth aligned to it."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Any, Self

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.io.importers.session_files import DepthCamera
from cluster_slam.live.view import View, empty_view
from cluster_slam.sensors.camera import Camera


class RealSenseCamera:
    """Views of a RealSense: images in, no points; a detector comes after.

    Stamps are the camera's, in seconds; with global time, librealsense's default, that is this machine's clock.
    """

    def __init__(
        self, queue: Any, stop: Callable[[], None], depth_scale: float, depth_camera: DepthCamera | None = None
    ) -> None:
        """
        Parameters
        ----------
        queue
            A running pipeline or a syncer of librealsense: what has ``poll_for_frames``.
        stop
            Ends it.
        depth_scale
            Metres per unit of the depth images.
        depth_camera
            Whose depth it is, where that is known.
        """
        import pyrealsense2 as rs

        self.depth_scale: float | None = depth_scale
        self.depth_camera = depth_camera
        self.intrinsics: Camera | None = None  # known with the first view
        self._queue, self._stop = queue, stop
        self._align = rs.align(rs.stream.color)
        self._last: float | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stop()

    @property
    def is_over(self) -> bool:
        """A camera is never over."""
        return False

    def take(self) -> list[View]:
        """What has come since the last call."""
        views = []
        while frames := self._queue.poll_for_frames():
            view = self._view(frames)
            if view is not None:
                views.append(view)
        return views

    def problems(self) -> list[str]:
        """None: what does not come is not there."""
        return []

    def _view(self, frames: Any) -> View | None:
        if not (frames.get_color_frame() and frames.get_depth_frame()):
            return None
        both = frames if _share_pixels(frames) else self._align.process(frames)
        colour, depth = both.get_color_frame(), both.get_depth_frame()
        stamp = 1e-3 * float(colour.get_timestamp())
        if stamp == self._last:
            return None
        self._last = stamp
        self.intrinsics = self.intrinsics or camera_of(colour.get_profile().as_video_stream_profile().get_intrinsics())
        seen = empty_view(stamp, time.time())
        image = np.array(colour.get_data(), np.uint8)
        if "rgb8" in str(colour.get_profile().format()):
            image = image[..., ::-1].copy()
        return View(stamp, seen.arrival, seen.points, seen.covs, seen.scores, image, np.array(depth.get_data()))


def _share_pixels(frames: Any) -> bool:
    """Whether depth and colour come from one imager, as a D405's: aligning would only leave holes."""
    depth = frames.get_depth_frame().get_profile().as_video_stream_profile()
    colour = frames.get_color_frame().get_profile().as_video_stream_profile()
    a, b, T = depth.get_intrinsics(), colour.get_intrinsics(), depth.get_extrinsics_to(colour)
    names = ("width", "height", "fx", "fy", "ppx", "ppy")
    is_one_camera = all(getattr(a, name) == getattr(b, name) for name in names)
    return is_one_camera and np.allclose(T.rotation, np.eye(3).ravel(), atol=1e-6) and not np.any(T.translation)


def camera_of(intrinsics: Any) -> Camera:
    """The camera of librealsense's intrinsics.

    Raises
    ------
    InputError
        A distortion model that a pinhole with plumb bob is not.
    """
    coefficients: Array = np.zeros(8)
    coefficients[:5] = intrinsics.coeffs
    model = str(intrinsics.model).rpartition(".")[2]
    if coefficients.any() and model not in ("brown_conrady", "modified_brown_conrady"):
        raise InputError(f"RealSense: distortion model {model} with coefficients, expected brown_conrady or none")
    size = int(intrinsics.width), int(intrinsics.height)
    return Camera(intrinsics.fx, intrinsics.fy, intrinsics.ppx, intrinsics.ppy, coefficients, *size)


def open_realsense(*, serial: str | None = None, width: int = 848, height: int = 480, fps: int = 30) -> RealSenseCamera:
    """The camera that is attached, or the one with a serial number.

    Raises
    ------
    InputError
        ``pyrealsense2`` is not installed, or no such camera is there.
    """
    try:
        import pyrealsense2 as rs
    except ImportError:
        raise InputError("camera realsense: pyrealsense2 is missing (pip install 'cluster-slam[realsense]')") from None
    config, pipeline = rs.config(), rs.pipeline()
    if serial is not None:
        config.enable_device(serial)
    config.enable_stream(rs.stream.depth, width, height, rs.format.z16, fps)
    config.enable_stream(rs.stream.color, width, height, rs.format.bgr8, fps)
    try:
        profile = pipeline.start(config)
    except RuntimeError as error:
        raise InputError(f"camera realsense: {error}, expected a RealSense with {width} x {height} at {fps}") from None
    device = profile.get_device()
    scale = float(device.first_depth_sensor().get_depth_scale())
    return RealSenseCamera(pipeline, pipeline.stop, scale, _model(str(device.get_info(rs.camera_info.name))))


def _model(name: str) -> DepthCamera | None:
    """How the depths of a camera err, by its name: ``Intel RealSense D435I`` is a D435."""
    words = name.lower()
    return "d405" if "d405" in words else "d435" if "d435" in words else None
