"""How well one pose explains a session by a plant: every unit against every near one, one to one, and the sum."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from cluster_slam.config import MatchConfig
from cluster_slam.constellation.fit import Pairs, fit
from cluster_slam.constellation.similarity import Similarities
from cluster_slam.constellation.units import Units
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray
from tracking.assignment import assign
from tracking.reid import Background, Groups, GroupScores, same_group

REACH_SIGMAS = 3.5  # centres farther apart are not compared
JUMP_M = 0.006  # a centroid's jump when flowers are lost or unseen, one sigma an axis


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """Both sides in one space, and what is expected of strangers."""

    query: Units
    known: Units
    background: Background
    bonus: Array  # (q,) log density of each query unit under its own background minus that of ``background``
    config: MatchConfig
    scale_range: tuple[float, float]


@dataclass(frozen=True, slots=True, eq=False)
class Explained:
    """One pose and what it explains."""

    pose: Similarities  # a stack of one
    log_ratio: float
    query: IntArray  # (p,) matched units of the session
    known: IntArray  # (p,) their partners
    log_ratios: Array  # (p,)
    partner: IntArray  # (p, n) member of the known unit for each member of the query unit, -1 none
    offset: Array  # (p, d) posterior mean of the common offset
    table: Array  # (q, u) log likelihood ratios of all pairs, -inf where they were not compared

    def __len__(self) -> int:
        return len(self.query)


def n_flowers(found: Explained) -> int:
    """How many flowers an explanation has a partner for."""
    return int((found.partner >= 0).sum())


def explain(scene: Scene, poses: Similarities) -> list[Explained]:
    """Explanations by each pose of a stack."""
    moved = poses.apply(scene.query.centres)
    reach = REACH_SIGMAS * np.sqrt(1.6**2 * scene.known.var_offset + JUMP_M**2)
    tree = cKDTree(scene.known.centres)
    out: list[Explained] = []
    for k, centres in enumerate(moved):
        near = cKDTree(centres).query_ball_tree(tree, float(reach.max()))
        q = np.repeat(np.arange(len(near)), [len(n) for n in near])
        u = np.array([i for n in near for i in n], dtype=np.int64)
        close = np.linalg.norm(centres[q] - scene.known.centres[u], axis=1) < reach[u]
        out.append(_explain(scene, poses.take(np.array([k])), q[close], u[close]))
    return out


def _explain(scene: Scene, pose: Similarities, q: IntArray, u: IntArray) -> Explained:
    scores = score_pairs(scene, pose, q, u)
    table = np.full((len(scene.query), len(scene.known)), -np.inf)
    table[q, u] = scores.log_ratio
    rows, cols = assign(-table, 0.0)
    index = np.zeros(table.shape, dtype=np.int64)
    index[q, u] = np.arange(len(q))
    chosen = index[rows, cols]
    gains = scores.log_ratio[chosen]
    return Explained(pose, float(gains.sum()), rows, cols, gains, scores.partner[chosen], scores.offset[chosen], table)


def score_pairs(scene: Scene, pose: Similarities, q: IntArray, u: IntArray) -> GroupScores:
    """Scores of unit pairs under one pose; the drift may be as expected or so many times wider."""
    groups = scene.query.groups
    points = pose.scale[0] * groups.points @ pose.R[0].T + pose.t[0]
    first = Groups(points, groups.variances * pose.scale[0] ** 2, groups.mask).take(q)
    second, seen = scene.known.groups.take(u), scene.known.seen[u]
    var = scene.known.var_offset[u]
    narrow = same_group(first, second, var, seen, scene.background)
    wide = same_group(first, second, scene.config.wide**2 * var, seen, scene.background)
    share = scene.config.wide_share
    log_ratio = np.logaddexp(np.log1p(-share) + narrow.log_ratio, np.log(share) + wide.log_ratio)
    is_wide = wide.log_ratio > narrow.log_ratio
    return GroupScores(
        log_ratio - scene.bonus[q],
        np.where(is_wide[:, None], wide.partner, narrow.partner),
        np.where(is_wide[:, None], wide.offset, narrow.offset),
    )


def matched_pairs(scene: Scene, found: Explained) -> Pairs:
    """The matched flowers behind an explanation, in the space's coordinates."""
    row, member = np.nonzero(found.partner >= 0)
    q, u, other = found.query[row], found.known[row], found.partner[row, member]
    a, b = scene.query.groups, scene.known.groups
    names, unit = np.unique(row, return_inverse=True)
    scale_sq = float(found.pose.scale[0]) ** 2
    return Pairs(
        a=a.points[q, member],
        b=b.points[u, other],
        variance=scale_sq * a.variances[q, member] + b.variances[u, other],
        unit=unit.astype(np.int64),
        var_offset=scene.known.var_offset[found.known[names]],
    )


def refine(scene: Scene, found: Explained, n_rounds: int = 4) -> Explained:
    """Fit and explain in turns, as long as the explanation gets likelier."""
    best = found
    for _ in range(n_rounds):
        if n_flowers(best) < scene.query.centres.shape[1]:
            break
        pose = fit(robust(matched_pairs(scene, best), best.pose), scene.scale_range)
        again = explain(scene, pose)[0]
        if again.log_ratio <= best.log_ratio + 1e-6:
            if again.log_ratio > best.log_ratio:
                best = again
            break
        best = again
    return best


def robust(pairs: Pairs, pose: Similarities) -> Pairs:
    """Units that moved much farther than expected count less: their own drift was larger (Student's t, 4 dof)."""
    if pairs.n_units < 4:
        return pairs
    weight = 1.0 / pairs.variance
    total = np.bincount(pairs.unit, weight, pairs.n_units)
    residual = pairs.b - pose.apply(pairs.a)[0]
    offset = np.stack([np.bincount(pairs.unit, weight * x, pairs.n_units) / total for x in residual.T], axis=1)
    d = offset.shape[1]
    squared = (offset**2).sum(1) / (pairs.var_offset + 1.0 / total)
    return replace(pairs, var_offset=pairs.var_offset * np.maximum(1.0, (4.0 + squared) / (4.0 + d)))
