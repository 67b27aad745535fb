"""Guesses of the pose from nothing: triples (in the plane: pairs) of landmarks whose distances agree.

All agreeing triples of the map are found for each of some spread triples of the session; nothing is drawn at random,
so a pose that is there is found. Then a quick score, and the best poses that differ.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.spatial import cKDTree

from cluster_slam.constellation.similarity import Similarities, align
from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

TOLERANCE = 2.2  # sigmas of a side's difference
_HEADS = 400_000  # pairs that are joined at once at most
_BEGINNINGS = 60  # landmarks of the session that are combined to triples at most


@dataclass(frozen=True, slots=True, eq=False)
class Places:
    """Landmarks by their centres."""

    centres: Array  # (n, d)
    sigma: Array  # (n,) of a centre along each axis, m


def guess_poses(
    query: Places, known: Places, scale_range: tuple[float, float], n_seeds: int, max_poses: int
) -> Similarities:
    """Poses query -> known (h) from agreeing triples, or pairs where d = 2; at most ``max_poses``, evenly taken."""
    d = query.centres.shape[1]
    sides = _sides(known)
    first, second = [np.zeros((0, d), dtype=np.int64)], [np.zeros((0, d), dtype=np.int64)]
    for corner in _corners(query.centres, n_seeds, d):
        found = _agreeing(query, sides, corner, scale_range)
        first.append(np.broadcast_to(corner, found.shape))
        second.append(found)
    a, b = np.concatenate(first), np.concatenate(second)
    if len(a) > max_poses:
        rows = np.linspace(0, len(a) - 1, max_poses).astype(np.int64)
        a, b = a[rows], b[rows]
    return align(query.centres[a], known.centres[b], scale_range)


def _corners(centres: Array, n_seeds: int, d: int) -> IntArray:
    """Well-shaped triples (pairs) of rows (s, d): large area over longest side, each row used evenly."""
    return _corners_of(np.ascontiguousarray(centres).tobytes(), n_seeds, d)


@lru_cache(maxsize=8)  # a session is compared with many plants
def _corners_of(content: bytes, n_seeds: int, d: int) -> IntArray:
    centres = np.frombuffer(content).reshape(-1, d)
    n = len(centres)
    chosen = np.unique(np.linspace(0, n - 1, min(n, _BEGINNINGS)).round().astype(np.int64))
    D = np.linalg.norm(centres[:, None] - centres, axis=2)
    i, j = np.triu_indices(len(chosen), 1)
    if d == 2:
        corners, worth = chosen[np.stack([i, j], axis=1)], D[chosen[i], chosen[j]]
    else:
        a, b, c = (chosen[x] for x in _triples(len(chosen)))
        longest = np.maximum(np.maximum(D[a, b], D[b, c]), D[a, c])
        area = np.linalg.norm(np.cross(centres[b] - centres[a], centres[c] - centres[a]), axis=1)
        corners, worth = np.stack([a, b, c], axis=1), area / np.maximum(longest, 1e-9)
    reach = np.median(D[D > 0]) if (D > 0).any() else 1.0
    worth = np.minimum(worth, 0.8 * reach)  # sides that reach across are good enough; farther ones drift apart more
    return _evenly(corners, worth, n, n_seeds)


def _triples(n: int) -> tuple[IntArray, IntArray, IntArray]:
    i, j, k = np.meshgrid(*[np.arange(n)] * 3, indexing="ij")
    keep = (i < j) & (j < k)
    return i[keep], j[keep], k[keep]


def _evenly(corners: IntArray, worth: Array, n: int, n_seeds: int) -> IntArray:
    """The worthiest corners, such that no row is used much more often than the others."""
    order = np.argsort(-worth, kind="stable")
    limit = int(np.ceil(1.5 * corners.shape[1] * n_seeds / max(n, 1))) + 1
    used, kept = [0] * n, []
    for k, corner in zip(order[: 60 * n_seeds].tolist(), corners[order[: 60 * n_seeds]].tolist(), strict=True):
        if max(used[row] for row in corner) < limit:
            for row in corner:
                used[row] += 1
            kept.append(k)
            if len(kept) == n_seeds:
                break
    return corners[kept]


@dataclass(frozen=True, slots=True, eq=False)
class _Sides:
    """Pairs of known landmarks by their distance."""

    known: Places
    first: IntArray  # (p,) rows of each pair, shortest first
    second: IntArray  # (p,)
    lengths: Array  # (p,)


def _sides(known: Places) -> _Sides:
    i, j = np.triu_indices(len(known.centres), 1)
    apart = known.centres[i] - known.centres[j]
    lengths = np.sqrt(np.einsum("pd,pd->p", apart, apart))
    order = np.argsort(lengths)
    return _Sides(known, i[order].astype(np.int64), j[order].astype(np.int64), lengths[order])


def _agreeing(query: Places, sides: _Sides, corner: IntArray, scale_range: tuple[float, float]) -> IntArray:
    """Ordered triples (pairs) of known rows (k, d) whose sides agree with the corner's."""
    i, j = _side(query, sides, corner[0], corner[1], scale_range)
    if len(corner) == 2:
        return np.stack([i, j], axis=1)
    i, j = i[:_HEADS], j[:_HEADS]
    j2, k2 = _side(query, sides, corner[1], corner[2], scale_range)
    begin, end = np.searchsorted(j2, j), np.searchsorted(j2, j, side="right")
    row = np.repeat(np.arange(len(i)), end - begin)
    step = np.arange(len(row)) - np.repeat(np.cumsum(end - begin) - (end - begin), end - begin)
    i, j, k = i[row], j[row], k2[begin[row] + step]
    lengths = np.linalg.norm(sides.known.centres[i] - sides.known.centres[k], axis=1)
    good = (i != k) & _is_as_long(query, sides.known, lengths, i, k, corner[0], corner[2], scale_range)
    agreeing: IntArray = np.stack([i, j, k], axis=1)[good]
    return agreeing


def _side(query: Places, sides: _Sides, a: int, b: int, scale_range: tuple[float, float]) -> tuple[IntArray, IntArray]:
    """Ordered pairs of known landmarks, by their rows, that are as far apart as two of the session."""
    length = float(np.linalg.norm(query.centres[a] - query.centres[b]))
    widest = TOLERANCE * float(np.sqrt(2.0 * sides.known.sigma.max() ** 2 + query.sigma[a] ** 2 + query.sigma[b] ** 2))
    begin, end = np.searchsorted(sides.lengths, [scale_range[0] * length - widest, scale_range[1] * length + widest])
    i, j = sides.first[begin:end], sides.second[begin:end]
    good = _is_as_long(query, sides.known, sides.lengths[begin:end], i, j, a, b, scale_range)
    rows, columns = np.concatenate([i[good], j[good]]), np.concatenate([j[good], i[good]])
    order = np.lexsort((columns, rows))
    return rows[order], columns[order]


def _is_as_long(
    query: Places,
    known: Places,
    lengths: Array,
    i: IntArray,
    j: IntArray,
    a: int,
    b: int,
    scale_range: tuple[float, float],
) -> BoolArray:
    """Whether known pairs (p,) of these lengths are as long as a pair of the session, within their sigmas."""
    length = float(np.linalg.norm(query.centres[a] - query.centres[b]))
    slack = TOLERANCE * np.sqrt(known.sigma[i] ** 2 + known.sigma[j] ** 2 + query.sigma[a] ** 2 + query.sigma[b] ** 2)
    agrees = (scale_range[0] * length - slack <= lengths) & (scale_range[1] * length + slack >= lengths)
    return np.asarray(agrees, dtype=bool)


def quick_scores(poses: Similarities, query: Places, known: Places, log_density: float) -> tuple[Array, Array]:
    """How well the centres alone agree (h,): log likelihood of nearest, one-to-one, over the background's density.

    Also the number of the session's landmarks (h,) that find one of the map.
    """
    h, n, d = len(poses), len(query.centres), query.centres.shape[1]
    moved = poses.apply(query.centres)
    tree = cKDTree(known.centres)
    found = tree.query(moved.reshape(-1, d))
    distance, nearest = np.asarray(found[0]).reshape(h, n), np.asarray(found[1]).reshape(h, n)
    var = (1.4**2) * (known.sigma[nearest] ** 2 + query.sigma**2)
    gain = -0.5 * distance**2 / var - 0.5 * d * np.log(2 * np.pi * var) - log_density
    gain = np.maximum(gain, 0.0)
    best = np.zeros((h, len(known.centres)))
    np.maximum.at(best, (np.arange(h)[:, None], nearest), gain)
    return best.sum(axis=1), (best > 0).sum(axis=1).astype(float)


def best_distinct(poses: Similarities, scores: Array, centres: Array, apart: float, n: int) -> IntArray:
    """The n best poses (rows, best first) that move the centres by more than ``apart`` (RMS) from each better one."""
    left = np.argsort(-scores, kind="stable")[: 50 * n]
    moved = poses.take(left).apply(centres)
    kept: list[int] = []
    alive = np.ones(len(left), dtype=bool)
    for k in range(len(left)):
        if not alive[k]:
            continue
        kept.append(int(left[k]))
        if len(kept) == n:
            break
        near = np.sqrt(((moved[k:] - moved[k]) ** 2).sum(-1).mean(-1)) < apart
        alive[k:] &= ~near
    return np.array(kept, dtype=np.int64)
