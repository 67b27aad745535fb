"""Where clusters were, frame by frame, when it is known which observation is which flower."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter1d
from scipy.sparse import csr_matrix

from cluster_slam.association.frames import Frames, information
from cluster_slam.geometry import Array, rotate_cov, transform
from cluster_slam.records import IntArray


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


def motion_scale(
    d: Array, cov: Array, frame: IntArray, cluster: IntArray, stamps: Array, window_s: float = 0.5
) -> Array:
    """How far each pair's cluster moves around that time, m (0 = at rest): the largest significant local mean."""
    n_clusters = int(cluster.max(initial=-1)) + 1
    n = len(stamps)
    moved = np.zeros((n, n_clusters))
    chi2 = np.einsum("pi,pij,pj->p", d, information(cov), d)
    excess = np.sqrt(np.maximum((d * d).sum(1) - np.trace(cov, axis1=1, axis2=2), 0.0))
    moved[frame, cluster] = np.where(chi2 > 16.0, excess, 0.0)  # 99.9 % of what stands still is below
    neighbours = np.zeros((n, n_clusters))
    neighbours[frame, cluster] = chi2 > 9.0
    count = neighbours.copy()
    count[1:] += neighbours[:-1]
    count[:-1] += neighbours[1:]
    moved[count < 2] = 0.0  # one frame alone is noise
    dt = float(np.median(np.diff(stamps))) if n > 1 else 1.0
    size = 2 * max(1, round(window_s / dt)) + 1
    return np.asarray(maximum_filter1d(moved, size, axis=0)[frame, cluster])
