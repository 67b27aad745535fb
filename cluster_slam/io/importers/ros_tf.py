"""The tree of transforms in a bag's ``/tf`` and ``/tf_static``, and the path of one frame in it."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, pose_from_tum, tum_from_pose
from cluster_slam.io.importers.ros_bag import Bag, seconds
from cluster_slam.sensors.interpolation import interpolate

FLANGES = ("flange", "tool0", "tool0_controller", "ee_link", "wrist_3_link")
ODOMETRY = ("odom", "odom_combined", "visual_odom")
_STATIC = "tf_static"


def row_of(translation: Any, rotation: Any) -> list[float]:
    """``tx ty tz qx qy qz qw`` of ROS vectors."""
    t, q = translation, rotation
    return [float(x) for x in (t.x, t.y, t.z, q.x, q.y, q.z, q.w)]


@dataclass(slots=True, eq=False)
class Edge:
    """The transforms of one child in its parent."""

    parent: str
    is_static: bool
    stamps: list[float] = field(default_factory=list)
    rows: list[list[float]] = field(default_factory=list)

    def arrays(self) -> tuple[Array, Array]:
        """Stamps (n,), increasing and unique, and rows (n, 7)."""
        stamps, first = np.unique(np.array(self.stamps), return_index=True)
        return stamps, np.array(self.rows)[first]


@dataclass(frozen=True, slots=True, eq=False)
class Path:
    """A frame's poses in another."""

    root: str
    frame: str
    stamps: Array  # (n,) s
    rows: Array  # (n, 7)


class Tree:
    """All transforms of a bag, by child."""

    def __init__(self, bag: Bag, topics: list[str]) -> None:
        self.edges: dict[str, Edge] = {}
        for topic, _, message in bag.messages(topics):
            for one in message.transforms:
                child, parent = one.child_frame_id.lstrip("/"), one.header.frame_id.lstrip("/")
                edge = self.edges.setdefault(child, Edge(parent, _STATIC in topic))
                if edge.parent == parent:
                    edge.stamps.append(seconds(one.header.stamp))
                    edge.rows.append(row_of(one.transform.translation, one.transform.rotation))

    def chain(self, frame: str) -> list[str]:
        """The frame, its parent, and so on to the root."""
        names = [frame]
        while names[-1] in self.edges:
            parent = self.edges[names[-1]].parent
            if parent in names:
                raise InputError(f"tf: {parent} is above itself, expected a tree")
            names.append(parent)
        return names

    def moves(self, frame: str) -> bool:
        """Whether anything above a frame moves."""
        return any(not self.edges[name].is_static for name in self.chain(frame)[:-1])

    def static(self, frame: str, above: str) -> Array | None:
        """(7,) the fixed transform of a frame in one above it; None where something between them moves."""
        T = np.eye(4)
        for name in self.chain(frame):
            if name == above:
                return tum_from_pose(T)
            edge = self.edges.get(name)
            if edge is None or not edge.is_static:
                return None
            T = pose_from_tum(np.array(edge.rows[-1])) @ T
        return None

    def path(self, root: str, frame: str) -> Path:
        """The poses of a frame in one above it, at the stamps of what moves between them.

        Raises
        ------
        InputError
            There is no such path, or nothing in it moves.
        """
        names = self.chain(frame)
        if root not in names or root == frame:
            raise InputError(f"tf: no path from {root} to {frame}; known: {', '.join(sorted(self.edges)) or 'nothing'}")
        edges = [self.edges[name] for name in names[: names.index(root)]]
        moving = [edge for edge in edges if not edge.is_static]
        if not moving:
            raise InputError(f"tf: nothing moves between {root} and {frame}, expected poses over time")
        stamps = _stamps(moving)
        if len(edges) == 1:
            return Path(root, frame, *edges[0].arrays())
        T = np.tile(np.eye(4), (len(stamps), 1, 1))
        for edge in edges:
            T = _at(edge, stamps) @ T
        return Path(root, frame, stamps, tum_from_pose(T))


def _stamps(edges: list[Edge]) -> Array:
    """All stamps at which every edge is known."""
    times = [edge.arrays()[0] for edge in edges]
    every = np.unique(np.concatenate(times))
    begin, end = max(float(t[0]) for t in times), min(float(t[-1]) for t in times)
    common: Array = every[(every >= begin) & (every <= end)]
    return common


def _at(edge: Edge, stamps: Array) -> Array:
    times, rows = edge.arrays()
    if edge.is_static:
        return np.tile(pose_from_tum(rows[-1]), (len(stamps), 1, 1))
    return interpolate(times, pose_from_tum(rows), stamps)
