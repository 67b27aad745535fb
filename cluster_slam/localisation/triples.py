"""Poses from three flowers: every triple of the map whose sides agree is one hypothesis (exhaustive, no sampling)."""

from __future__ import annotations

from itertools import combinations

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

_LONELY = 0.3  # weight of a point that has no other near it: it may well be false


def choose_triples(points: Array, sigma: Array, n_triples: int, near_m: float = 0.0, max_points: int = 24) -> IntArray:
    """Well-shaped, spread triples (k, 3) of points (n, 3) with errors sigma (n,), no point in too many of them.

    The shape of a triple is its least height over its points' errors: what its pose turns by is the inverse of that.
    Points that have no other within ``near_m`` count less: flowers come in clusters.
    """
    n = len(points)
    if n < 3:
        return np.zeros((0, 3), np.int64)
    use = np.arange(n) if n <= max_points else np.linspace(0, n - 1, max_points).round().astype(np.int64)
    triples = use[np.array(list(combinations(range(len(use)), 3)))]
    a, b, c = points[triples[:, 0]], points[triples[:, 1]], points[triples[:, 2]]
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    longest = np.sqrt(np.max([((b - a) ** 2).sum(1), ((c - a) ** 2).sum(1), ((c - b) ** 2).sum(1)], axis=0))
    shape = area / np.maximum(longest, 1e-12) / np.maximum(sigma[triples].mean(1), 1e-9)
    if near_m > 0.0:
        apart = ((points[:, None] - points) ** 2).sum(-1)
        lonely = (apart < near_m**2).sum(1) < 2
        shape *= _LONELY ** lonely[triples].sum(1)
    chosen: list[int] = []
    used = np.zeros(n)
    score = shape.copy()
    for _ in range(min(n_triples, len(triples))):
        best = int(score.argmax())
        if shape[best] <= 1.0:
            break
        chosen.append(best)
        used[triples[best]] += 1.0
        score = shape / (1.0 + used[triples].sum(1)) ** 2
        score[chosen] = -1.0
    out: IntArray = triples[chosen]
    return out


def matching_triples(distances: Array, sides: Array, tolerance: Array, max_found: int) -> IntArray:
    """Ordered triples (k, 3) of landmarks whose sides ab, ac, bc are those given (3,) within the tolerance (3,).

    ``distances`` (f, f) between all landmarks. At most ``max_found``, evenly taken from all.
    """
    low = np.maximum(sides - tolerance, 0.0).astype(distances.dtype)
    high = (sides + tolerance).astype(distances.dtype)
    i, j = np.nonzero((distances > low[0]) & (distances < high[0]))
    ac, bc = (np.packbits((distances > low[k]) & (distances < high[k]), axis=1) for k in (1, 2))
    both = ac[i] & bc[j]
    some = np.flatnonzero(both.any(1))
    row, k = np.nonzero(np.unpackbits(both[some], axis=1, count=distances.shape[0]))
    found = np.stack([i[some[row]], j[some[row]], k], axis=1)
    if len(found) > max_found:
        found = found[np.linspace(0, len(found) - 1, max_found).astype(np.int64)]
    return found.astype(np.int64)


def poses_from_triples(query: Array, target: Array) -> Array:
    """Rigid motions (k, 4, 4) that take the triangle query (3, 3) onto triangles target (k, 3, 3), corners as rows.

    The triangles' planes and centroids fall together and the turn within the plane is that of least squares.
    """
    centre_q, centre_t = query.mean(0), target.mean(1)
    a, b = query - centre_q, target - centre_t[:, None]
    frame_q, frame_t = _frames(a[None])[0], _frames(b)
    flat_q = a @ frame_q  # (3, 3), third column zero
    flat_t = b @ frame_t
    cross = (flat_q[:, 0] * flat_t[..., 1] - flat_q[:, 1] * flat_t[..., 0]).sum(-1)
    dot = (flat_q[:, 0] * flat_t[..., 0] + flat_q[:, 1] * flat_t[..., 1]).sum(-1)
    size = np.hypot(cross, dot)
    c, s = dot / size, cross / size
    turn = np.zeros((len(target), 3, 3))
    turn[:, 0, 0] = turn[:, 1, 1] = c
    turn[:, 0, 1], turn[:, 1, 0], turn[:, 2, 2] = -s, s, 1.0
    T = np.zeros((len(target), 4, 4))
    T[:, :3, :3] = frame_t @ turn @ frame_q.T
    T[:, :3, 3] = centre_t - (T[:, :3, :3] @ centre_q)
    T[:, 3, 3] = 1.0
    return T


def _frames(corners: Array) -> Array:
    """Orthonormal frames (k, 3, 3), axes as columns, of triangles (k, 3, 3); the third axis is the normal."""
    x = corners[:, 1] - corners[:, 0]
    x = x / np.linalg.norm(x, axis=1, keepdims=True)
    z = np.cross(x, corners[:, 2] - corners[:, 0])
    z = z / np.maximum(np.linalg.norm(z, axis=1, keepdims=True), 1e-12)
    return np.stack([x, np.cross(z, x), z], axis=-1)
