"""Landmarks from pieces: pieces of one flower lie in one place, and never two of them in one frame.

The radius in which pieces are one flower is not given: it follows from the distances between flowers that were seen
at the same time, which are certainly different flowers.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

_MEDIAN_CHI2_3 = 2.366  # median of chi-square with three degrees of freedom


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """Robust means of groups of points: one row a group."""

    mean: Array  # (g, 3)
    chi2: Array  # (g,) median of the points' squared normalised distances over that of pure noise
    count: IntArray  # (g,)


def group_means(points: Array, var: Array, labels: IntArray, n_groups: int, n_iterations: int = 6) -> Groups:
    """Cauchy means (Huber 1981) of points (m, 3) with scalar variances (m,), by group; label -1 belongs to none."""
    used = labels >= 0
    p, v, g = points[used], var[used], labels[used]
    count = np.bincount(g, minlength=n_groups)
    mean = _group_median(p, g, n_groups)
    r2 = np.zeros(len(p))
    for _ in range(n_iterations):
        r2 = ((p - mean[g]) ** 2).sum(-1) / v
        weight = 1.0 / (v * (1.0 + r2 / 3.0))
        total = np.maximum(np.bincount(g, weight, n_groups), 1e-300)
        mean = np.stack([np.bincount(g, weight * p[:, a], n_groups) for a in range(3)], axis=-1) / total[:, None]
    return Groups(mean, _group_median(r2[:, None], g, n_groups)[:, 0] / _MEDIAN_CHI2_3, count)


def _group_median(values: Array, labels: IntArray, n_groups: int) -> Array:
    """Medians (n_groups, d) by group; zero where a group is empty."""
    out = np.zeros((n_groups, values.shape[1]))
    count = np.bincount(labels, minlength=n_groups)
    start = np.concatenate([[0], np.cumsum(count)[:-1]])
    has = count > 0
    for a in range(values.shape[1]):
        order = np.lexsort((values[:, a], labels))
        ordered = values[order, a]
        low = ordered[(start + (count - 1) // 2)[has]]
        high = ordered[(start + count // 2)[has]]
        out[has, a] = 0.5 * (low + high)
    return out


def flower_spacing(mean: Array, presence: csr_matrix, weight: Array, quantile: float = 0.05) -> float:
    """Small quantile of the distance to the nearest piece that was seen in the same frames; inf where there is none.

    Places (g, 3) of the pieces, ``presence`` (g, n) the frames that saw each, ``weight`` (g,) how much each counts.
    Pieces that share most of the shorter one's frames are certainly different flowers.
    """
    if len(mean) < 2:
        return np.inf
    k = min(24, len(mean))
    distance, neighbour = cKDTree(mean).query(mean, k=k)
    row = np.repeat(np.arange(len(mean)), k)
    shared = np.asarray(presence[row].multiply(presence[neighbour.ravel()]).sum(axis=1)).reshape(-1, k)
    count = np.asarray(presence.sum(axis=1)).ravel()
    distinct = (neighbour != np.arange(len(mean))[:, None]) & (
        shared > 0.5 * np.minimum(count[:, None], count[neighbour])
    )
    nearest = np.where(distinct, distance, np.inf).min(axis=1)
    finite = np.isfinite(nearest)
    if not finite.any():
        return np.inf
    order = np.argsort(nearest[finite])
    share = np.cumsum(weight[finite][order]) / weight[finite].sum()
    return float(nearest[finite][order][np.searchsorted(share, quantile)])


def merge_pieces(
    points: Array,
    var: Array,
    labels: IntArray,
    frame: IntArray,
    n_frames: int,
    radius: float,
    min_count: int,
    shared_frames: float = 0.02,
) -> tuple[IntArray, Array]:
    """Landmark of each observation (m,) and the landmarks' places (l, 3), from pieces of at least ``min_count`` points.

    The purest and longest pieces come first: each joins the nearest landmark within ``radius`` that was not seen in
    the same frames (a few shared frames are allowed: pieces are not perfectly pure), or else founds one.
    """
    count = np.bincount(labels[labels >= 0], minlength=int(labels.max(initial=-1)) + 1)
    kept = np.flatnonzero(count >= min_count)
    if len(kept) == 0:
        return np.full(len(labels), -1, dtype=np.int64), np.empty((0, 3))
    piece_of = np.full(len(count) + 1, -1, dtype=np.int64)
    piece_of[kept] = np.arange(len(kept))
    piece = piece_of[labels]
    groups = group_means(points, var, piece, len(kept))
    quality = groups.count / np.maximum(groups.chi2, 0.5)
    used = piece >= 0
    presence = np.zeros((len(kept), n_frames), dtype=bool)
    presence[piece[used], frame[used]] = True
    landmark_of_piece = _found_landmarks(groups.mean, quality, presence, radius, shared_frames)
    landmark = np.where(used, landmark_of_piece[piece], -1)
    n = int(landmark_of_piece.max(initial=-1)) + 1
    return landmark, group_means(points, var, landmark, n).mean


def _found_landmarks(mean: Array, quality: Array, presence: Array, radius: float, shared: float) -> IntArray:
    """Leader clustering of the pieces, best first, with soft cannot-links by shared frames."""
    out = np.full(len(mean), -1, dtype=np.int64)
    place, weight = np.empty((len(mean), 3)), np.zeros(len(mean))
    seen = np.zeros_like(presence)
    n = 0
    for i in np.argsort(-quality, kind="stable"):
        distance = np.linalg.norm(place[:n] - mean[i], axis=1)
        near = np.flatnonzero(distance < radius)
        near = near[np.argsort(distance[near], kind="stable")]
        both = (seen[near] & presence[i]).sum(axis=1)
        fewer = np.minimum(seen[near].sum(axis=1), presence[i].sum())
        allowed = both <= np.maximum(np.minimum(2, 0.1 * fewer), shared * fewer)
        if allowed.any():
            j = near[allowed][0]
        else:
            j, n = n, n + 1
            place[j] = mean[i]
        place[j] += (mean[i] - place[j]) * quality[i] / (weight[j] + quality[i])
        weight[j] += quality[i]
        seen[j] |= presence[i]
        out[i] = j
    return out
