"""Rough poses of one frame in one plant, with no prior: from triples of flowers, scored by all points."""

from __future__ import annotations

import numpy as np

from cluster_slam.config import LocaliseConfig
from cluster_slam.geometry import Array
from cluster_slam.localisation.field import NearestField
from cluster_slam.localisation.landmarks import Landmarks
from cluster_slam.localisation.scene import ErrorScale, Look
from cluster_slam.localisation.triples import choose_triples, matching_triples, poses_from_triples

_SIDE_SIGMAS = 2.6  # a side may differ by so many standard deviations
_FIT_SIGMAS = 3.0  # so may a point from its flower
_MAX_FOUND = 3000  # poses that one triple may have
_SAME_SIGMAS = 2.0  # poses that move the points by less are one


class PlantIndex:
    """One plant made ready for the search: distances between all flowers, and the nearest flower of any place."""

    def __init__(self, marks: Landmarks, reach_m: float) -> None:
        self.marks = marks
        p = marks.positions.astype(np.float32)
        square = (p**2).sum(1)
        self.distances = np.sqrt(np.maximum(square[:, None] + square - 2.0 * (p @ p.T), 0.0))
        np.fill_diagonal(self.distances, -1.0)
        self.reach_m = reach_m
        self.field = NearestField(marks.positions, reach_m)
        own = np.trace(marks.covs, axis1=1, axis2=2) + np.trace(marks.shared_covs, axis1=1, axis2=2)[marks.cluster]
        self.var = float(np.median(own)) / 3.0  # of a flower an axis


def rough_poses(
    look: Look, index: PlantIndex, scale: ErrorScale, config: LocaliseConfig, *, thorough: bool = False
) -> tuple[Array, Array]:
    """Distinct poses (h, 4, 4) and their scores (h,), best first; ``thorough``: all triples, and more of each."""
    var = look.sigma**2 + index.var + scale.sway_m**2
    triples = choose_triples(look.points, np.sqrt(var), config.n_triples, 4.0 * index.marks.spread)
    poses, scores = [np.zeros((0, 4, 4))], [np.zeros(0)]
    best = 0.0
    sure = config.sure_share * len(look) * 0.6 * _FIT_SIGMAS**2 / 2.0
    for k, triple in enumerate(triples):
        if k >= config.n_triples_sure and best >= sure and not thorough:
            break
        T = _poses_of(look, index, triple, var)
        if len(T) == 0:
            continue
        score = _score(T, look, index, triple, var)
        order = np.argsort(-score, kind="stable")[: 4 * config.n_guesses if thorough else config.n_guesses]
        poses.append(T[order])
        scores.append(score[order])
        best = max(best, float(score[order[0]]))
    n_max = config.n_refined * (20 if thorough else 5)
    return distinct(np.concatenate(poses), np.concatenate(scores), look, float(np.sqrt(var.mean())), n_max)


def _poses_of(look: Look, index: PlantIndex, triple: Array, var: Array) -> Array:
    a, b, c = look.points[triple]
    corners = ((a, b), (a, c), (b, c))
    sides = np.array([np.linalg.norm(q - p) for p, q in corners])
    va, vb, vc = var[triple]
    tolerance = _SIDE_SIGMAS * np.sqrt(np.array([va + vb, va + vc, vb + vc]))
    order = np.argsort(sides)  # the shortest side has the fewest pairs
    roles = {0: (0, 1, 2), 1: (0, 2, 1), 2: (1, 2, 0)}[int(order[0])]
    pairs = {(0, 1): 0, (0, 2): 1, (1, 2): 2}
    which = [pairs[tuple(sorted((roles[x], roles[y])))] for x, y in ((0, 1), (0, 2), (1, 2))]  # type: ignore[index]
    found = matching_triples(index.distances, sides[which], tolerance[which], _MAX_FOUND)
    return poses_from_triples(look.points[triple[list(roles)]], index.marks.positions[found])


def _score(T: Array, look: Look, index: PlantIndex, triple: Array, var: Array) -> Array:
    """Sum over the points of what they gain by the flower nearest to them, errors of the triple's pose allowed for."""
    corners = look.points[triple]
    edge = corners[1:] - corners[0]
    longest = max(float(np.linalg.norm(e)) for e in (*edge, edge[1] - edge[0]))
    height = max(float(np.linalg.norm(np.cross(edge[0], edge[1]))) / longest, 1e-6)
    away = ((look.points - corners.mean(0)) ** 2).sum(1)
    spread = var + float(var[triple].mean()) * (1.0 / 3.0 + away / (1.5 * height**2))
    return _gain(T, look, index, np.minimum(spread, (index.reach_m / _FIT_SIGMAS) ** 2))


def _gain(T: Array, look: Look, index: PlantIndex, var: Array) -> Array:
    seen = look.points @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
    _, d2 = index.field.distance_sq(seen)
    return np.asarray(np.maximum(_FIT_SIGMAS**2 - d2 / var, 0.0).sum(1) / 2.0)


def distinct(poses: Array, scores: Array, look: Look, sigma: float, n_max: int) -> tuple[Array, Array]:
    """Poses without those that put the points where a better one puts them, best first, at most ``n_max``."""
    order = np.argsort(-scores, kind="stable")
    centre = look.points.mean(0)
    arms = np.sqrt(((look.points - centre) ** 2).mean(0).sum())
    probes = centre + np.vstack([np.zeros(3), arms * np.eye(3)])
    places = (probes @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]).reshape(len(poses), 3 * len(probes))
    kept: list[int] = []
    for i in order.tolist():
        if kept:
            apart = ((places[kept] - places[i]) ** 2).sum(1) / len(probes)
            if apart.min() < (2.0 * _SAME_SIGMAS * sigma) ** 2:
                continue
        kept.append(i)
        if len(kept) == n_max:
            break
    return poses[kept], scores[kept]


def sharpened(poses: Array, look: Look, index: PlantIndex, var: Array, n_rounds: int = 2) -> tuple[Array, Array]:
    """The poses (h, 4, 4) moved onto their nearest flowers (weighted Kabsch, in one batch), and their scores (h,)."""
    T = poses
    reach = min(3.0 * float(np.sqrt(var.mean())) * 2.0, index.reach_m)
    for _ in range(n_rounds):
        seen = look.points @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
        nearest, d2 = index.field.distance_sq(seen)
        weight = np.where(d2 < reach**2, 1.0 / (var * (1.0 + d2 / (4.0 * var))), 0.0)
        T = _kabsch(look.points, index.field.positions[nearest], weight, T)
        reach = max(0.7 * reach, 3.0 * float(np.sqrt(var.mean())))
    return T, _gain(T, look, index, 2.0 * var)


def _kabsch(points: Array, targets: Array, weight: Array, fallback: Array) -> Array:
    """Rigid motions (h, 4, 4) of least squares from points (n, 3) onto targets (h, n, 3), weights (h, n)."""
    total = weight.sum(1)
    enough = (weight > 0).sum(1) >= 3
    w = weight / np.where(total > 0, total, 1.0)[:, None]
    a = w @ points
    b = np.einsum("hn,hni->hi", w, targets)
    near = np.where((weight > 0)[..., None], targets, 0.0)
    cross = np.einsum("hn,ni,hnj->hij", w, points, near) - a[:, :, None] * np.einsum("hn,hnj->hj", w, near)[:, None]
    U, _, Vt = np.linalg.svd(cross)
    sign = np.sign(np.linalg.det(U @ Vt))
    Vt[:, 2] *= sign[:, None]
    R = np.swapaxes(U @ Vt, 1, 2)
    b = np.einsum("hn,hni->hi", w, near)
    T = fallback.copy()
    T[enough, :3, :3] = R[enough]
    T[enough, :3, 3] = (b - np.einsum("hij,hj->hi", R, a))[enough]
    return T
