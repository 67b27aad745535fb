"""The error of a frame's pose, found from what is seen in it and taken away before points are assigned again."""

from __future__ import annotations

import numpy as np

from cluster_slam.association.frames import information, point_jacobian
from cluster_slam.association.lanes import sums
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

_N_ITERATIONS = 4


def solve_pose_corrections(
    R: Array, lane: IntArray, c: Array, residual: Array, cov: Array, information_prior: Array
) -> Array:
    """Tangents z (a, 6) of poses such that ``residual`` (q, 3) = target - T c is explained, Cauchy-robust.

    Camera points c (q, 3) are seen from the pose ``lane`` (q,) with rotation R (a, 3, 3); ``cov`` (q, 3, 3) in the
    world; the prior is zero with information (6, 6) or (a, 6, 6).
    """
    J = point_jacobian(R[lane], c)
    W = information(cov)
    JW = np.swapaxes(J, -1, -2) @ W
    JWJ = (JW @ J).reshape(-1, 36)
    both = np.concatenate([JWJ, (JW @ residual[..., None])[..., 0]], axis=1)
    z: Array = np.zeros((len(R), 6))
    for _ in range(_N_ITERATIONS):
        r = residual - (J @ z[lane][..., None])[..., 0]
        weight = 1.0 / (1.0 + ((W @ r[..., None])[..., 0] * r).sum(-1) / 3.0)
        total = sums(both * weight[:, None], lane, len(R))
        H = total[:, :36].reshape(-1, 6, 6) + information_prior
        z = np.asarray(np.linalg.solve(H, total[:, 36:, None])[..., 0], dtype=np.float64)
    return z
