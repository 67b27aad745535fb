"""A session as an mcap file of ROS 2 (by ``rosbags``): poses in tf, intrinsics, images, flowers as point clouds."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from cluster_slam.errors import InputError, OutputError
from cluster_slam.geometry import Array, tum_from_pose
from cluster_slam.io.camera_info import read_camera
from cluster_slam.io.exporters.tum import listed_images
from cluster_slam.io.importers.poses import read_pose_file
from cluster_slam.io.importers.session_files import COV_NAMES, number
from cluster_slam.io.metadata import read_metadata
from cluster_slam.records import Session

WORLD, FLANGE, CAMERA = "world", "flange", "camera"
ROS_SCALE = 0.001  # m per unit of depth, by REP 118; another unit is told as RealSense's recorder does
UNITS = "/camera/depth/option/Depth_Units/value"
_DEPTH_HEADER = b"\0" * 12  # before the PNG of compressed depth: its format and quantisation, none here
_FLOAT64 = 8  # of PointField
_UPPER = np.triu_indices(3)


class Messages:
    """Messages of ROS 2 Humble, made and written."""

    def __init__(self, path: Path) -> None:
        """
        Raises
        ------
        InputError
            ``rosbags`` is not installed.
        """
        try:
            from rosbags.rosbag2 import StoragePlugin, Writer
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise InputError(f"{path}: rosbags is missing (pip install 'cluster-slam[bags]')") from None
        self._store = get_typestore(Stores.ROS2_HUMBLE)
        self._writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
        self._connections: dict[str, Any] = {}
        self._writer.open()

    def make(self, kind: str, *values: Any) -> Any:
        """A message of a type (``geometry_msgs/msg/Vector3``) with its fields in their order."""
        return self._store.types[kind](*values)

    def header(self, stamp: float, frame: str) -> Any:
        """A header; nanoseconds are rounded."""
        nanoseconds = _nanoseconds(stamp)
        time = self.make("builtin_interfaces/msg/Time", nanoseconds // 10**9, nanoseconds % 10**9)
        return self.make("std_msgs/msg/Header", time, frame)

    def write(self, topic: str, stamp: float, message: Any) -> None:
        """Append a message."""
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self._store)
        self._writer.write(self._connections[topic], _nanoseconds(stamp), self._store.serialize_cdr(message, kind))

    def close(self) -> None:
        """Finish the file."""
        self._writer.close()


def export_mcap(session: Session, folder: Path, out: Path) -> dict[str, int]:
    """Write the file ``out``; how many messages each topic has.

    Raises
    ------
    InputError
        ``rosbags`` is not installed, or an image is missing.
    OutputError
        ``out`` cannot be written.
    """
    images = listed_images(folder)
    try:
        with tempfile.TemporaryDirectory(dir=out.parent, prefix=f".{out.name}.") as place:
            bag = Path(place) / "bag"
            messages = Messages(bag)
            counts = _write_all(messages, session, folder, images)
            messages.close()
            shutil.move(next(bag.glob("*.mcap")), out)
    except OSError as error:
        raise OutputError(f"{out}: cannot be written ({error.strerror})") from None
    return counts


def _write_all(messages: Messages, session: Session, folder: Path, images: Sequence[Path]) -> dict[str, int]:
    stamps, rows, _, _ = read_pose_file(folder / "poses.txt", 0.0)
    child = CAMERA if session.T_flange_camera is None else FLANGE
    if session.T_flange_camera is not None:
        _transform(messages, "/tf_static", float(stamps[0]), FLANGE, CAMERA, tum_from_pose(session.T_flange_camera))
    for stamp, row in zip(stamps.tolist(), rows, strict=True):
        _transform(messages, "/tf", stamp, WORLD, child, row)
    counts = {"/tf": len(stamps)}
    if (folder / "camera.yaml").is_file():
        _camera_info(messages, folder / "camera.yaml", float(stamps[0]))
        counts["/camera/color/camera_info"] = 1
    scale = read_metadata(folder / "session.toml")[0].depth.scale
    if images and scale != ROS_SCALE:
        messages.write(UNITS, float(stamps[0]), messages.make("std_msgs/msg/String", number(scale)))
        counts[UNITS] = 1
    for name, path in _stamped(folder, images):
        counts[name] = counts.get(name, 0) + 1
        _image(messages, name, *path)
    if session.level > 1 and len(session.observations):
        counts["/flowers"] = _flowers(messages, session)
    return counts


def _transform(messages: Messages, topic: str, stamp: float, parent: str, child: str, row: Array) -> None:
    t = messages.make("geometry_msgs/msg/Vector3", *map(float, row[:3]))
    q = messages.make("geometry_msgs/msg/Quaternion", *map(float, row[3:]))
    transform = messages.make("geometry_msgs/msg/Transform", t, q)
    header = messages.header(stamp, parent)
    stamped = messages.make("geometry_msgs/msg/TransformStamped", header, child, transform)
    messages.write(topic, stamp, messages.make("tf2_msgs/msg/TFMessage", [stamped]))


def _camera_info(messages: Messages, path: Path, stamp: float) -> None:
    camera = read_camera(path)
    k = np.array([camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1], float)
    p = np.array([camera.fx, 0, camera.cx, 0, 0, camera.fy, camera.cy, 0, 0, 0, 1, 0], float)
    is_rational = bool(camera.distortion[5:].any())
    d = camera.distortion if is_rational else camera.distortion[:5]
    roi = messages.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
    size = int(camera.height or 0), int(camera.width or 0)
    model = "rational_polynomial" if is_rational else "plumb_bob"
    info = messages.make(
        "sensor_msgs/msg/CameraInfo",
        messages.header(stamp, CAMERA),
        *size,
        model,
        d,
        k,
        np.eye(3).ravel(),
        p,
        0,
        0,
        roi,
    )
    messages.write("/camera/color/camera_info", stamp, info)


def _stamped(folder: Path, images: Sequence[Path]) -> list[tuple[str, tuple[float, Path]]]:
    """Topic, stamp and file of each image, by stamp."""
    stamps: dict[Path, float] = {}
    for name in ("rgb.txt", "depth.txt"):
        if (folder / name).is_file():
            for line in (folder / name).read_text("utf-8").splitlines():
                cells = line.split("#", 1)[0].split()
                if cells:
                    stamps[folder / cells[-1]] = float(cells[0])
    depth = "/camera/aligned_depth_to_color/image_raw/compressedDepth"
    topics = {
        image: depth if image.parent.name == "depth" else "/camera/color/image_raw/compressed" for image in images
    }
    return sorted((topics[image], (stamps[image], image)) for image in images)


def _image(messages: Messages, topic: str, stamp: float, path: Path) -> None:
    data = path.read_bytes()
    if topic.endswith("compressedDepth"):
        data, kind = _DEPTH_HEADER + data, "16UC1; compressedDepth png"
    else:
        kind = "bgr8; jpeg compressed bgr8" if path.suffix.lower() in (".jpg", ".jpeg") else "bgr8; png compressed bgr8"
    array = np.frombuffer(data, np.uint8)
    header = messages.header(stamp, CAMERA)
    messages.write(topic, stamp, messages.make("sensor_msgs/msg/CompressedImage", header, kind, array))


def _flowers(messages: Messages, session: Session) -> int:
    """One cloud a frame, empty ones too; how many."""
    seen = session.observations
    columns = [seen.points]
    names = ["x", "y", "z"]
    if np.isfinite(seen.scores).any():
        columns, names = [*columns, seen.scores[:, None]], [*names, "score"]
    if seen.has_covariance:
        columns, names = [*columns, seen.covs[:, _UPPER[0], _UPPER[1]]], [*names, *COV_NAMES]
    values = np.concatenate(columns, axis=1)
    fields = [messages.make("sensor_msgs/msg/PointField", name, 8 * k, _FLOAT64, 1) for k, name in enumerate(names)]
    for i, stamp in enumerate(session.stamps.tolist()):
        rows = np.ascontiguousarray(values[seen.frame == i], "<f8")
        data = np.frombuffer(rows.tobytes(), np.uint8)
        step = 8 * len(names)
        cloud = messages.make(
            "sensor_msgs/msg/PointCloud2",
            messages.header(stamp, CAMERA),
            1,
            len(rows),
            fields,
            False,
            step,
            step * len(rows),
            data,
            True,
        )
        messages.write("/flowers", stamp, cloud)
    return session.n_frames


def _nanoseconds(stamp: float) -> int:
    whole = int(stamp // 1)
    return whole * 10**9 + round((stamp - whole) * 1e9)
