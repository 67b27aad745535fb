"""Poses between poses: straight in position, at a constant turn in rotation."""

from __future__ import annotations

import numpy as np

from cluster_slam.geometry import Array, inverse, so3_exp, so3_log


def pose_from_rotation_vector(rows: Array) -> Array:
    """Rigid motions (..., 4, 4) of rows ``x y z rx ry rz`` (..., 6), as Universal Robots' controllers have them."""
    T = np.zeros((*rows.shape[:-1], 4, 4))
    T[..., :3, :3] = so3_exp(rows[..., 3:])
    T[..., :3, 3] = rows[..., :3]
    T[..., 3, 3] = 1.0
    return T


def rotation_vector_from_pose(T: Array) -> Array:
    """Rows ``x y z rx ry rz`` (..., 6) of rigid motions (..., 4, 4)."""
    return np.concatenate([T[..., :3, 3], so3_log(T[..., :3, :3])], axis=-1)


def interpolate(stamps: Array, poses: Array, at: Array) -> Array:
    """Poses (m, 4, 4) at chosen times, those at the ends beyond them.

    Parameters
    ----------
    stamps
        (n,) s, strictly increasing, n > 0.
    poses
        (n, 4, 4)
    at
        (m,) s
    """
    if len(stamps) == 1:
        return np.repeat(poses, len(at), axis=0)
    i = np.clip(np.searchsorted(stamps, at, side="right") - 1, 0, len(stamps) - 2)
    before, after = poses[i], poses[i + 1]
    share = np.clip((at - stamps[i]) / (stamps[i + 1] - stamps[i]), 0.0, 1.0)[:, None]
    out = before.copy()
    turn = so3_log((inverse(before) @ after)[:, :3, :3])
    out[:, :3, :3] = before[:, :3, :3] @ so3_exp(share * turn)
    out[:, :3, 3] = (1.0 - share) * before[:, :3, 3] + share * after[:, :3, 3]
    return out
