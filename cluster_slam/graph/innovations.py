"""What each observation would have surprised the others with: squared innovations, chi-square where all is true.

A residual is smaller than the error that made it, as pose, displacement and place follow the observation. With K the
share of an observation that they take up (its block of the influence matrix), residuals of true errors have the
covariance I - K in units of the stated one, and r' (I - K)^-1 r is the squared innovation against all the others.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.frames import information
from cluster_slam.association.lanes import sums
from cluster_slam.geometry import Array
from cluster_slam.graph.batch import BatchSmoother, Estimate
from cluster_slam.records import BoolArray

_LEAST_FREE = 0.05  # of an observation that all else must leave to it, else its residual tells nothing


@dataclass(frozen=True, slots=True, eq=False)
class FramePosterior:
    """Covariances of poses (n, 6, 6), of displacements (p, 3, 3), and between both (p, 3, 6), the places held."""

    pose: Array
    displacement: Array
    between: Array


def frame_posterior(smoother: BatchSmoother, A_z: Array, A_d: Array, used: BoolArray, prior: Array) -> FramePosterior:
    """Each frame by itself, from whitened Jacobians (q, 3, 6) and (q, 3, 3) and information (n, 6, 6) of its pose.

    Displacements are eliminated from each frame's pose (Schur complement).
    """
    A_z, A_d, frame, pair = A_z[used], A_d[used], smoother.frame[used], smoother.pair[used]
    n, of_pair = len(prior), smoother.pairs.frame
    d_prior = smoother.pairs.total_sigma**-2
    transposed = np.swapaxes(A_d, 1, 2)
    cov_d = information(sums(transposed @ A_d, pair, len(of_pair)) + d_prior[:, None, None] * np.eye(3))
    coupling = sums(transposed @ A_z, pair, len(of_pair))
    by_pose = cov_d @ coupling
    total = prior + sums(np.swapaxes(A_z, 1, 2) @ A_z, frame, n)
    cov_z: Array = np.asarray(
        np.linalg.inv(total - sums(np.swapaxes(coupling, 1, 2) @ by_pose, of_pair, n)), np.float64
    )
    between = -by_pose @ cov_z[of_pair]
    return FramePosterior(cov_z, cov_d - between @ np.swapaxes(by_pose, 1, 2), np.asarray(between, np.float64))


def influence(smoother: BatchSmoother, estimate: Estimate) -> tuple[Array, BoolArray]:
    """Blocks (q, 3, 3) of the influence matrix, whitened, and which of the assigned observations (q,) had weight."""
    A_z, A_d, _ = smoother.whitened(estimate)
    used = estimate.weight[smoother.rows] > 0.5
    root = np.sqrt(smoother.correlation)
    A_z, A_d = A_z / root, A_d / root
    posterior = frame_posterior(smoother, A_z, A_d, used, smoother.pose_information(estimate))
    cross = A_d @ posterior.between[smoother.pair] @ np.swapaxes(A_z, 1, 2)
    K = A_z @ posterior.pose[smoother.frame] @ np.swapaxes(A_z, 1, 2) + cross + np.swapaxes(cross, 1, 2)
    K += A_d @ posterior.displacement[smoother.pair] @ np.swapaxes(A_d, 1, 2)
    count = np.bincount(smoother.landmark[used], minlength=smoother.n_places)
    K += np.eye(3) / (smoother.correlation * np.maximum(count, 1))[smoother.landmark, None, None]
    return K, used


def squared_innovations(smoother: BatchSmoother, estimate: Estimate) -> Array:
    """Squared normalised innovation (m,) of each sorted observation, three degrees of freedom; NaN where unassigned."""
    out = np.full(smoother.m, np.nan)
    r, _ = smoother.residuals(estimate)
    if len(r) == 0:
        return out
    K, used = influence(smoother, estimate)
    # What had no weight has taken nothing up: its innovation is its residual, and errs as both do.
    size, axes = np.linalg.eigh(np.eye(3) - np.where(used, 1.0, -1.0)[:, None, None] * K)
    along = (np.swapaxes(axes, 1, 2) @ r[..., None])[..., 0]
    out[smoother.rows] = (along**2 / np.maximum(size, _LEAST_FREE)).sum(axis=1)
    return out
