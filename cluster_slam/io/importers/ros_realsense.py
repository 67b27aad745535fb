"""What RealSense's recorder adds to a bag: stamps in metadata, the unit of depth, and how its imagers stand.

Topics are those of librealsense: ``/device_0/sensor_0/Depth_0/image/data``, with ``image/metadata`` and ``tf/...``
beside them. A file ``.db3`` (since 2026) is a ROS 2 bag with strings, ``.bag`` before it a ROS 1 bag with messages.
"""

from __future__ import annotations

import re
from typing import Any

import numpy as np

from cluster_slam.geometry import Array, inverse, pose_from_tum
from cluster_slam.io.importers.registration import Registration
from cluster_slam.io.importers.ros_bag import CAMERA_INFO, Bag
from cluster_slam.io.importers.ros_images import camera_of_info
from cluster_slam.io.importers.ros_tf import row_of
from cluster_slam.sensors.camera import Camera

_STRING, _FLOAT = "std_msgs/msg/String", "std_msgs/msg/Float32"
_TRANSFORM, _KEY_VALUE = "geometry_msgs/msg/Transform", "diagnostic_msgs/msg/KeyValue"


def _stream_of(topic: str) -> str | None:
    """``/device_0/sensor_0/Depth_0`` of a topic of librealsense."""
    found = re.match(r"(/device_\d+/sensor_\d+/[A-Za-z]+_\d+)/", topic)
    return found.group(1) if found else None


def metadata_stamps(bag: Bag, topic: str) -> dict[float, float] | None:
    """Stamps (s) of a stream's images by their arrival; None where the headers have them.

    A ``.db3`` begins at time 0 and has the camera's stamps, in milliseconds, in the metadata.
    """
    stream = _stream_of(topic)
    beside = f"{stream}/image/metadata"
    if stream is None or beside not in bag.topics([_STRING]):
        return None
    stamps = {}
    for _, arrival, message in bag.messages([beside]):
        found = re.search(r"(?:^|;)timestamp=([0-9.]+)", message.data)
        if found:
            stamps[arrival] = 1e-3 * float(found.group(1))
    return stamps


def depth_scale(bag: Bag) -> float | None:
    """Metres per unit of a RealSense's depth; None where the bag does not say."""
    for topic in bag.topics([_STRING, _FLOAT]):
        if topic.endswith("/option/Depth_Units/value"):
            for _, _, message in bag.messages([topic]):
                return float(f"{float(message.data):.7g}")
    return None


def registration(bag: Bag, colour: str, depth: str, camera: Camera, scale: float) -> Registration | None:
    """How depth comes into the colour's pixels; None where it is there already, or where the bag is no RealSense's."""
    streams = _stream_of(colour), _stream_of(depth)
    if streams[0] is None or streams[1] is None:
        return None
    own = _camera(bag, streams[1])
    to_colour, to_depth = _extrinsics(bag, streams[0]), _extrinsics(bag, streams[1])
    if own is None or to_colour is None or to_depth is None:
        return None
    T = to_colour @ inverse(to_depth)
    names = ("fx", "fy", "cx", "cy", "width", "height")
    if all(getattr(own, name) == getattr(camera, name) for name in names) and np.allclose(T, np.eye(4), atol=1e-6):
        return None
    return Registration(own, camera, T, scale)


def _camera(bag: Bag, stream: str) -> Camera | None:
    for topic in bag.topics([CAMERA_INFO]):
        if topic.startswith(f"{stream}/"):
            for _, _, info in bag.messages([topic]):
                return camera_of_info(f"{bag.path}: {topic}", info)
    return None


def _extrinsics(bag: Bag, stream: str) -> Array | None:
    """(4, 4) from the reference of the device to a stream, in the stream's ``tf``."""
    for topic in bag.topics([_STRING, _TRANSFORM]):
        if topic.startswith(f"{stream}/tf/"):
            for _, _, message in bag.messages([topic]):
                return _parse(message)
    return None


def _parse(message: Any) -> Array:
    if not hasattr(message, "data"):
        return pose_from_tum(np.array(row_of(message.translation, message.rotation)))
    parts = dict(part.split("=") for part in message.data.split(";") if "=" in part)
    T = np.eye(4)
    T[:3, :3] = np.array(parts["rotation"].split(","), float).reshape(3, 3).T  # column by column, as in librealsense
    T[:3, 3] = np.array(parts["translation"].split(","), float)
    return T
