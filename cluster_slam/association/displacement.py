"""Where clusters were, frame by frame, when it is known which observation is which flower."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.sparse import csr_matrix

from cluster_slam.association.frames import Frames, information
from cluster_slam.geometry import Array, rotate_cov, transform
from cluster_slam.records import IntArray

_WINDOWS_S = (0.4, 1.2)  # over which displacements are averaged
_SURE_SIGMAS = 3.0  # by which they must exceed their noise before motion is believed: who takes chance for it, errs


def presence_of(frame: IntArray, label: IntArray, n_labels: int, n_frames: int) -> csr_matrix:
    """Which frames (n) saw which label (l): a sparse (l, n) matrix of ones."""
    used = label >= 0
    matrix = csr_matrix((np.ones(used.sum()), (label[used], frame[used])), shape=(n_labels, n_frames))
    matrix.data[:] = 1.0
    return matrix


def cluster_pairs(frames: Frames, landmark: IntArray, cluster: IntArray) -> tuple[IntArray, IntArray, IntArray]:
    """Pair of each observation (m,) (-1 none), and frame (p,) and cluster (p,) of each cluster-in-frame pair."""
    n_clusters = int(cluster.max(initial=-1)) + 1
    used = landmark >= 0
    of = np.full(len(frames), -1, dtype=np.int64)
    key, inverse = np.unique(frames.frame[used] * n_clusters + cluster[landmark[used]], return_inverse=True)
    of[used] = inverse
    return of, key // max(n_clusters, 1), key % max(n_clusters, 1)


def measured_displacements(
    frames: Frames, T: Array, landmark: IntArray, places: Array, pair: IntArray, n_pairs: int
) -> tuple[Array, Array]:
    """Displacement (p, 3) and covariance (p, 3, 3) of each pair from its own frame, poses taken as true."""
    used = landmark >= 0
    R = T[frames.frame[used], :3, :3]
    W = information(rotate_cov(R, frames.covs[used]))
    u = transform(T[frames.frame[used]], frames.points[used]) - places[landmark[used]]
    total = np.zeros((n_pairs, 3, 3))
    moment = np.zeros((n_pairs, 3))
    np.add.at(total, pair[used], W)
    np.add.at(moment, pair[used], (W @ u[..., None])[..., 0])
    cov = information(total)
    return (cov @ moment[..., None])[..., 0], cov


def motion_scale(d: Array, cov: Array, frame: IntArray, cluster: IntArray, stamps: Array) -> Array:
    """How far each pair's cluster stood from rest around that time, m, one sigma along any axis.

    The mean square of the measured displacements (p, 3) over a window, less what their noise (p, 3, 3) explains; then
    the largest such value of the window, so that the beginning of a shake is covered. A short window shows a shake
    when it happens, a long one what is left of it.
    """
    n_clusters = int(cluster.max(initial=-1)) + 1
    n = len(stamps)
    dt = float(np.median(np.diff(stamps))) if n > 1 else 1.0
    power, count, noise_sq = np.zeros((3, n, n_clusters))
    power[frame, cluster] = (d * d).sum(1) - np.trace(cov, axis1=1, axis2=2)
    noise_sq[frame, cluster] = np.einsum("pij,pij->p", cov, cov)
    count[frame, cluster] = 1.0
    largest = np.zeros((n, n_clusters))
    for window_s in _WINDOWS_S:
        half = max(1, round(0.5 * window_s / dt))
        total, seen, spread = (_window_sum(x, half) for x in (power, count, noise_sq))
        # Var(|d|^2) of pure noise is 2 tr(C^2).
        moved = total > _SURE_SIGMAS * np.sqrt(2.0 * spread)
        local = np.where(moved, total / np.maximum(seen, 1.0), 0.0)
        largest = np.maximum(largest, maximum_filter1d(local, 2 * half + 1, axis=0))
    return np.asarray(np.sqrt(largest[frame, cluster] / 3.0))


def _window_sum(x: Array, half: int) -> Array:
    """Sums over 2 half + 1 frames (n, c)."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    n = len(x)
    i = np.arange(n)
    summed: Array = total[np.minimum(i + half + 1, n)] - total[np.maximum(i - half, 0)]
    return summed
