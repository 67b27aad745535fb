"""Bags of ROS 1 and ROS 2 (sqlite3, mcap) by ``rosbags``, without ROS: opening, topics, headers, messages."""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.io.importers.recording import Stream

SUFFIXES = (".bag", ".db3", ".mcap")
IMAGES = ("sensor_msgs/msg/Image", "sensor_msgs/msg/CompressedImage")
CAMERA_INFO = "sensor_msgs/msg/CameraInfo"
TF = "tf2_msgs/msg/TFMessage"
POSES = (
    "geometry_msgs/msg/PoseStamped",
    "geometry_msgs/msg/PoseWithCovarianceStamped",
    "geometry_msgs/msg/TransformStamped",
    "nav_msgs/msg/Odometry",
)
POINTS = "sensor_msgs/msg/PointCloud2"
_NANO = 10**9  # nanoseconds in a second; whole numbers, so that a quotient is rounded once


def is_bag(path: Path) -> bool:
    """Whether a path is a bag by its name, or a folder with a ROS 2 bag."""
    if path.is_dir():
        return (path / "metadata.yaml").exists() and any(path.glob("*.db3*")) | any(path.glob("*.mcap*"))
    return path.suffix in SUFFIXES


def seconds(stamp: Any) -> float:
    """A ROS time as seconds."""
    return (int(stamp.sec) * _NANO + int(stamp.nanosec)) / _NANO


class Bag:
    """An open bag. Use it as a context manager."""

    def __init__(self, path: Path) -> None:
        """
        Raises
        ------
        InputError
            ``rosbags`` is not installed, or the file is no bag, empty or cut off.
        """
        self.path = path
        try:
            from rosbags.highlevel import AnyReader
            from rosbags.typesys import Stores, get_typestore
        except ImportError:
            raise InputError(f"{path}: rosbags is missing (pip install 'cluster-slam[bags]')") from None
        if not path.exists():
            raise InputError(f"{path}: missing, expected a bag")
        try:
            self._reader = AnyReader([path], default_typestore=get_typestore(Stores.ROS2_HUMBLE))
            self._reader.open()
        except Exception as error:  # rosbags raises errors of sqlite, struct and its own
            raise _broken(path, error) from None
        if not self._reader.connections:
            self._reader.close()
            raise InputError(f"{path}: no topic in it, expected a bag with messages")

    def __enter__(self) -> Bag:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._reader.close()

    def topics(self, kinds: Sequence[str]) -> list[str]:
        """Names of the topics of some types, sorted, those without a message left out."""
        found = {c.topic for c in self._reader.connections if c.msgtype in kinds and c.msgcount}
        return sorted(found)

    def kind(self, topic: str) -> str:
        """The type of a topic's messages."""
        return str(next(c.msgtype for c in self._reader.connections if c.topic == topic))

    def streams(self) -> list[Stream]:
        """All topics with what they hold; times are those of the bag."""
        begin, end = self._reader.start_time / _NANO, self._reader.end_time / _NANO
        return [
            Stream(name, next(c.msgtype for c in self._reader.connections if c.topic == name), n, begin, end)
            for name, n in sorted(self._counts().items())
        ]

    def _counts(self) -> dict[str, int]:
        counts: dict[str, int] = {}
        for c in self._reader.connections:
            counts[c.topic] = counts.get(c.topic, 0) + int(c.msgcount)
        return counts

    def messages(self, topics: Sequence[str]) -> Iterator[tuple[str, float, Any]]:
        """Topic, time of arrival (s) and message, in the order of arrival.

        Raises
        ------
        InputError
            The bag is cut off, or a message cannot be read.
        """
        for topic, time, raw, kind in self._raw(topics):
            try:
                message = self._reader.deserialize(raw, kind)
            except Exception as error:
                raise _broken(self.path, error, topic) from None
            yield topic, time, message

    def stamps(self, topic: str) -> tuple[Array, Array, str]:
        """Stamps in the headers (n,) and times of arrival (n,), s, of a topic, and the frame of its first message."""
        pairs, frame = [], ""
        for _, time, raw, _ in self._raw([topic]):
            stamp, name = self._header(raw)
            pairs.append((stamp, time))
            frame = frame or name
        both = np.array(pairs).reshape(-1, 2)
        return both[:, 0], both[:, 1], frame

    def _raw(self, topics: Sequence[str]) -> Iterator[tuple[str, float, bytes, str]]:
        connections = [c for c in self._reader.connections if c.topic in topics]
        if not connections:
            return
        try:
            for connection, time, raw in self._reader.messages(connections):
                yield connection.topic, time / _NANO, raw, connection.msgtype
        except InputError:
            raise
        except Exception as error:
            raise _broken(self.path, error) from None

    def _header(self, raw: bytes) -> tuple[float, str]:
        """Stamp and frame of a message that begins with a header, without reading the rest."""
        order, at = ("<" if raw[1] & 1 else ">", 4) if self._reader.is2 else ("<", 4)  # encapsulation; sequence number
        sec, nano, n = struct.unpack_from(f"{order}iII", raw, at)
        name = bytes(raw[at + 12 : at + 12 + n]).rstrip(b"\0").decode("utf-8", "replace")
        return (sec * _NANO + nano) / _NANO, name


def _broken(path: Path, error: Exception, topic: str = "") -> InputError:
    what = " ".join(str(error).split()) or type(error).__name__
    where = f"topic {topic}: " if topic else ""
    return InputError(f"{path}: {where}cannot be read as a bag ({what[:200]}); is it cut off or not closed?")
