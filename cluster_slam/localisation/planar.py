"""A vehicle on a floor among landmarks on that floor: the planes of both, and poses in space from places in them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, inverse, se3_log
from cluster_slam.graph.noise import planar_axis
from cluster_slam.localisation.landmarks import Landmarks
from cluster_slam.localisation.motion import Motion
from cluster_slam.records import Session

_FLAT = 0.01  # of the map's extent: landmarks that lie so close to a plane lie in it


@dataclass(frozen=True, slots=True, eq=False)
class Flat:
    """Bases of the two planes: columns in-plane, in-plane, normal; and the heights of camera and map along normals."""

    camera: Array  # (3, 3)
    map: Array  # (3, 3)
    origin: Array  # (3,) of the map's plane
    height: float  # of the points over the camera, along the camera's normal

    def pose(self, place: Array, side: float, cov: Array) -> tuple[Array, Array]:
        """``T_map_camera`` (4, 4) and its covariance (6, 6) from x, y, heading (3,), which side is up, cov (3, 3).

        Out of the plane all is known but for a rest.
        """
        B = self.map @ np.diag([1.0, side, side])
        c, s = np.cos(place[2]), np.sin(place[2])
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        T = np.eye(4)
        T[:3, :3] = B @ turn @ self.camera.T
        T[:3, 3] = self.origin + B @ np.array([place[0], place[1], 0.0]) - T[:3, :3] @ self.camera[:, 2] * self.height
        J = np.zeros((6, 3))
        J[3:, :2] = self.camera[:, :2] @ turn[:2, :2].T
        J[:3, 2] = self.camera[:, 2]
        return T, J @ cov @ J.T + 1e-10 * np.eye(6)


def flat_world(session: Session, motion: Motion, marks: Landmarks) -> Flat | None:
    """The planes of motion and map, where both are flat and poses come from odometry; else None."""
    if not motion.is_odometry or motion.X0 is not None or len(session.observations) == 0 or len(marks) < 2:
        return None
    axis = planar_axis(se3_log(inverse(session.poses[:-1]) @ session.poses[1:]))
    points = session.observations.points
    if axis is None or np.ptp(points @ axis) > _FLAT * np.ptp(points, axis=0).max():
        return None
    origin = marks.positions.mean(0)
    _, extent, normals = np.linalg.svd(marks.positions - origin, full_matrices=False)
    if len(marks) > 2 and extent[-1] > _FLAT * extent[0]:
        return None
    return Flat(_basis(axis), _basis(normals[-1]), origin, float((points @ axis).mean()))


def _basis(normal: Array) -> Array:
    first = np.linalg.svd(normal[None])[2][1]
    return np.column_stack([first, np.cross(normal, first), normal])
