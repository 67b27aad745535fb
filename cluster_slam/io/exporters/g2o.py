"""A session or a result as a g2o graph: camera poses, flowers at rest, and what was seen of them.

Vertices ``VERTEX_SE3:QUAT`` (frames, ids from 0) and ``VERTEX_TRACKXYZ`` (flowers, ids after them); edges
``EDGE_SE3_TRACKXYZ`` (a flower in the camera's frame), ``EDGE_SE3_PRIOR`` (a measured pose) or ``EDGE_SE3:QUAT`` (a
step of odometry), each with the upper triangle of its information. The order of the errors in g2o is translation,
rotation (as the vector part of a quaternion, half an angle).
"""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from cluster_slam.geometry import Array, inverse, tum_from_pose
from cluster_slam.io.importers.session_files import number
from cluster_slam.records import Result, Session

_UPPER_3, _UPPER_6 = np.triu_indices(3), np.triu_indices(6)
_OFFSET = "PARAMS_SE3OFFSET 0 0 0 0 0 0 0 1"


def session_graph(session: Session) -> str:
    """Poses as they were measured, with what holds them."""
    return _text([_OFFSET, *_poses(session.T_world_camera), *_measured(session, session.T_world_camera)])


def result_graph(result: Result) -> str:
    """Poses and flowers as estimated, with what was measured: poses, and observations that were not taken for false."""
    session, n = result.session, result.session.n_frames
    seen = session.observations
    index = {flower: n + k for k, flower in enumerate(result.flowers.ids.tolist())}
    flowers = [
        f"VERTEX_TRACKXYZ {index[i]} {_numbers(p)}"
        for i, p in zip(result.flowers.ids.tolist(), result.flowers.positions, strict=True)
    ]
    information = np.linalg.solve(seen.covs, np.broadcast_to(np.eye(3), seen.covs.shape))[:, _UPPER_3[0], _UPPER_3[1]]
    edges = [
        f"EDGE_SE3_TRACKXYZ {seen.frame[k]} {index[flower]} 0 {_numbers(seen.points[k])} {_numbers(information[k])}"
        for k, flower in enumerate(result.flower_ids.tolist())
        if flower in index
    ]
    return _text([_OFFSET, *_poses(result.T_world_camera), *flowers, *_measured(session, _given(result)), *edges])


def _given(result: Result) -> Array:
    """Measured poses of the camera (n, 4, 4), by the mount as it was estimated."""
    session = result.session
    if session.T_flange_camera is None or result.calibration is None:
        return session.T_world_camera
    return session.poses @ result.calibration.T_flange_camera


def _poses(T: Array) -> list[str]:
    return [f"VERTEX_SE3:QUAT {k} {_numbers(row)}" for k, row in enumerate(tum_from_pose(T))]


def _measured(session: Session, T: Array) -> list[str]:
    """Priors on poses that err each for itself; steps between poses whose errors add up."""
    noise = session.noise
    if session.pose_error == "absolute":
        information = _numbers(_information(noise.pose_translation, noise.pose_rotation))
        return [f"EDGE_SE3_PRIOR {k} 0 {_numbers(row)} {information}" for k, row in enumerate(tum_from_pose(T))]
    steps = inverse(T[:-1]) @ T[1:]
    length = np.linalg.norm(steps[:, :3, 3], axis=1)
    angle = np.arccos(np.clip((np.trace(steps[:, :3, :3], axis1=1, axis2=2) - 1) / 2, -1, 1))
    lines = ["FIX 0"]
    for k, row in enumerate(tum_from_pose(steps)):
        sigma = np.hypot(noise.pose_translation, noise.odometry_translation * length[k])
        turn = np.hypot(noise.pose_rotation, noise.odometry_rotation * angle[k])
        lines.append(f"EDGE_SE3:QUAT {k} {k + 1} {_numbers(row)} {_numbers(_information(sigma, turn))}")
    return lines


def _information(sigma_translation: float, sigma_rotation: float) -> Array:
    """(21,) upper triangle; the vector part of a quaternion is half an angle, so its information is four times."""
    return np.diag([sigma_translation**-2] * 3 + [4.0 * sigma_rotation**-2] * 3)[_UPPER_6]


def _numbers(values: Array) -> str:
    return " ".join(map(number, values))


def _text(lines: Iterable[str]) -> str:
    return "\n".join([*lines, ""])
