"""The error of a frame's pose, found from what is seen in it and taken away before points are assigned again."""

from __future__ import annotations

import numpy as np

from cluster_slam.association.frames import information, point_jacobian
from cluster_slam.association.lanes import run_starts
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

_N_ITERATIONS = 4


def solve_pose_corrections(
    R: Array, lane: IntArray, c: Array, residual: Array, cov: Array, information_prior: Array
) -> Array:
    """Tangents z (a, 6) of poses such that ``residual`` (q, 3) = target - T c is explained, Cauchy-robust.

    Camera points c (q, 3) are seen from the pose ``lane`` (q,), sorted, with rotation R (a, 3, 3); ``cov`` (q, 3, 3) in
    the world; the prior is zero with information (6, 6) or (a, 6, 6).
    """
    z: Array = np.zeros((len(R), 6))
    if len(lane) == 0:
        return z
    starts = run_starts(lane)
    seen = lane[starts]
    prior = np.broadcast_to(information_prior, (len(R), 6, 6))[seen]
    J = point_jacobian(R[lane], c)
    W = information(cov)
    JW = np.swapaxes(J, -1, -2) @ W
    both = np.concatenate([(JW @ J).reshape(-1, 36), (JW @ residual[..., None])[..., 0]], axis=1)
    r = residual
    for _ in range(_N_ITERATIONS):
        weight = 1.0 / (1.0 + ((W @ r[..., None])[..., 0] * r).sum(-1) / 3.0)
        total = np.add.reduceat(both * weight[:, None], starts, axis=0)
        z[seen] = np.linalg.solve(total[:, :36].reshape(-1, 6, 6) + prior, total[:, 36:, None])[..., 0]
        r = residual - (J @ z[lane][..., None])[..., 0]
    return z
