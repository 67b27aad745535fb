"""Bags made by rosbags' own writers: a camera on an arm, as small as it can be."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Writer2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

WIDTH, HEIGHT = 32, 24
K = [30.0, 0.0, 15.5, 0.0, 31.0, 11.5, 0.0, 0.0, 1.0]
D = [0.01, -0.02, 0.001, 0.002, 0.003]
COLOUR, DEPTH = "/camera/camera/color/image_raw", "/camera/camera/aligned_depth_to_color/image_raw"
INFO = "/camera/camera/color/camera_info"
BEGIN = 1_700_000_000


class BagWriter:
    """A ROS 1 bag, or a ROS 2 bag with sqlite3 or mcap. Use it as a context manager."""

    def __init__(self, path: Path, kind: str) -> None:
        self.kind = kind
        self.store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
        if kind == "ros1":
            tf = get_types_from_msg("geometry_msgs/TransformStamped[] transforms", "tf2_msgs/msg/TFMessage")
            self.store.register(tf)
            self._writer: Any = Writer1(path)
        else:
            plugin = StoragePlugin.MCAP if kind == "mcap" else StoragePlugin.SQLITE3
            self._writer = Writer2(path, version=9, storage_plugin=plugin)
        self._connections: dict[str, Any] = {}

    def __enter__(self) -> BagWriter:
        self._writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self._writer.close()

    def make(self, kind: str, *values: Any) -> Any:
        return self.store.types[kind](*values)

    def header(self, nanoseconds: int, frame: str) -> Any:
        time = self.make("builtin_interfaces/msg/Time", nanoseconds // 10**9, nanoseconds % 10**9)
        return self.make("std_msgs/msg/Header", *([0] if self.kind == "ros1" else []), time, frame)

    def write(self, topic: str, nanoseconds: int, message: Any) -> None:
        kind = message.__msgtype__
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, kind, typestore=self.store)
        serialize = self.store.serialize_ros1 if self.kind == "ros1" else self.store.serialize_cdr
        self._writer.write(self._connections[topic], nanoseconds, serialize(message, kind))

    def image(self, topic: str, ns: int, pixels: np.ndarray, encoding: str, *, arrival: int | None = None) -> None:
        data = np.frombuffer(np.ascontiguousarray(pixels).tobytes(), np.uint8)
        h, w = pixels.shape[:2]
        header = self.header(ns, "camera_color_optical_frame")
        message = self.make("sensor_msgs/msg/Image", header, h, w, encoding, 0, len(data) // h, data)
        self.write(topic, arrival or ns, message)

    def compressed(self, topic: str, ns: int, data: bytes, format: str) -> None:
        header = self.header(ns, "camera_color_optical_frame")
        array = np.frombuffer(data, np.uint8)
        self.write(topic, ns, self.make("sensor_msgs/msg/CompressedImage", header, format, array))

    def info(self, topic: str, ns: int, *, k: list[float] = K, size: tuple[int, int] = (HEIGHT, WIDTH)) -> None:
        roi = self.make("sensor_msgs/msg/RegionOfInterest", 0, 0, 0, 0, False)
        arrays = np.array(D), np.array(k, float), np.eye(3).ravel(), np.zeros(12)
        header = self.header(ns, "camera_color_optical_frame")
        self.write(topic, ns, self.make("sensor_msgs/msg/CameraInfo", header, *size, "plumb_bob", *arrays, 0, 0, roi))

    def pose(self, row: np.ndarray) -> Any:
        point = self.make("geometry_msgs/msg/Point", *map(float, row[:3]))
        turn = self.make("geometry_msgs/msg/Quaternion", *map(float, row[3:]))
        return self.make("geometry_msgs/msg/Pose", point, turn)

    def transforms(self, topic: str, ns: int, *edges: tuple[str, str, np.ndarray], arrival: int | None = None) -> None:
        found = []
        for parent, child, row in edges:
            t = self.make("geometry_msgs/msg/Vector3", *map(float, row[:3]))
            q = self.make("geometry_msgs/msg/Quaternion", *map(float, row[3:]))
            transform = self.make("geometry_msgs/msg/Transform", t, q)
            found.append(self.make("geometry_msgs/msg/TransformStamped", self.header(ns, parent), child, transform))
        self.write(topic, arrival or ns, self.make("tf2_msgs/msg/TFMessage", found))


def suffix(kind: str) -> str:
    """How a bag of a kind is called."""
    return ".bag" if kind == "ros1" else ""


def stamps(n: int = 5) -> list[int]:
    """Nanoseconds of frames, 33 ms apart."""
    return [BEGIN * 10**9 + k * 33_333_333 for k in range(n)]


def pose_rows(n: int = 5) -> np.ndarray:
    """Poses (n, 7) with quaternions that are unit to the last bit or so."""
    rng = np.random.default_rng(11)
    q = rng.normal(size=(n, 4))
    return np.column_stack([rng.normal(size=(n, 3)), q / np.linalg.norm(q, axis=1, keepdims=True)])


def colours(n: int = 5) -> np.ndarray:
    """Random pixels (n, h, w, 3), blue green red."""
    return np.random.default_rng(12).integers(0, 256, (n, HEIGHT, WIDTH, 3), dtype=np.uint8)


def depths(n: int = 5) -> np.ndarray:
    """Random depths (n, h, w) around half a metre in millimetres."""
    return np.random.default_rng(13).integers(300, 800, (n, HEIGHT, WIDTH)).astype(np.uint16)


MOUNT = np.array([0.01, -0.02, 0.05, 0.5, 0.5, -0.5, 0.5])


def arm_bag(path: Path, kind: str) -> Path:
    """Colour, depth, intrinsics; tf from the base through the tool to the camera."""
    path = path.with_name(path.name + suffix(kind))
    with BagWriter(path, kind) as bag:
        bag.transforms("/tf_static", stamps()[0], ("tool0", "camera_color_optical_frame", MOUNT))
        for k, ns in enumerate(stamps()):
            bag.transforms("/tf", ns, ("base_link", "tool0", pose_rows()[k]))
            bag.info(INFO, ns)
            bag.image(COLOUR, ns, colours()[k][..., ::-1], "rgb8")
            bag.image(DEPTH, ns, depths()[k], "16UC1")
    return path
