"""The camera's pose in one frame from all matched flowers, and how each cluster stands, with the right covariances.

All flowers of a cluster share its displacement, and all flowers of a frame its pose error; both are eliminated in
closed form. What one cluster's displacement is measured against is the pose as all others have it: so the innovation of
a cluster is independent of its own noise.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.frames import information
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

_HUBER_CHI2 = 7.8  # 3 degrees of freedom, 95 %


@dataclass(frozen=True, slots=True, eq=False)
class PoseSolution:
    """Tangent z (6,) of the camera's pose, its covariance (6, 6), and the clusters measured against it.

    ``slots`` (s,) of the clusters that were seen, ``shift`` (s, 3) from where each was predicted, with ``shift_cov``
    (s, 3, 3); ``weight`` (q,) robust weights of the matches.
    """

    z: Array
    cov: Array
    slots: IntArray
    shift: Array
    shift_cov: Array
    weight: Array


def solve_pose(
    J: Array, residual: Array, W: Array, slot: IntArray, P: Array, prior: Array, *, n_iterations: int = 3
) -> PoseSolution:
    """Pose and displacements of one frame.

    Parameters
    ----------
    J : (q, 3, 6) how each matched point moves with the pose's tangent.
    residual : (q, 3) predicted place minus point, world.
    W : (q, 3, 3) information of each residual, without pose and displacement.
    slot : (q,) cluster of each match.
    P : (c, 3, 3) covariance of each cluster's predicted displacement.
    prior : (6, 6) information of the pose's prior, mean zero.
    """
    seen, s = np.unique(slot, return_inverse=True)
    inverse_P = information(P[seen])
    n = len(seen)
    WJ = W @ J
    Wr = (W @ residual[..., None])[..., 0]
    JWJ = np.swapaxes(J, 1, 2) @ WJ
    JWr = (np.swapaxes(J, 1, 2) @ Wr[..., None])[..., 0]
    one = np.zeros((n, len(s)))
    one[s, np.arange(len(s))] = 1.0
    weight = np.ones(len(s))
    z = np.zeros(6)
    for i in range(n_iterations):
        sums = one * weight
        A, B, b = np.tensordot(sums, W, 1), np.tensordot(sums, WJ, 1), sums @ Wr
        gain = np.swapaxes(information(A + inverse_P) @ B, 1, 2)  # (n, 6, 3)
        H_of = np.tensordot(sums, JWJ, 1) - gain @ B
        g_of = np.tensordot(sums, JWr, 1) - (gain @ b[..., None])[..., 0]
        H, g = H_of.sum(0) + prior, g_of.sum(0)
        z = np.linalg.solve(H, g)
        if i + 1 < n_iterations:
            d = (information(A + inverse_P) @ (B @ z - b)[..., None])[..., 0]
            r = residual - J @ z + d[s]
            # Huber: Gaussian errors keep their full weight, and the covariances stay true.
            weight = np.minimum(1.0, np.sqrt(_HUBER_CHI2 / np.maximum(np.einsum("qi,qij,qj->q", r, W, r), 1e-9)))
    # What a cluster's displacement is measured to be, its own flowers' and all others' word on the pose taken together.
    own = H - H_of + np.tensordot(sums, JWJ, 1)
    gain = np.swapaxes(np.linalg.solve(own, np.swapaxes(B, 1, 2)), 1, 2)
    known = A - gain @ B.swapaxes(1, 2)
    vector = (gain @ (g - g_of + sums @ JWr)[..., None])[..., 0] - b
    shift_cov = information(0.5 * (known + np.swapaxes(known, 1, 2)))
    shift = (shift_cov @ vector[..., None])[..., 0]
    return PoseSolution(z, np.asarray(np.linalg.inv(H), np.float64), seen, shift, shift_cov, weight)


def no_pose(cov: Array) -> PoseSolution:
    """What is known of the pose where no flower was seen: nothing new."""
    none: IntArray = np.zeros(0, dtype=np.int64)
    return PoseSolution(np.zeros(6), cov, none, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
