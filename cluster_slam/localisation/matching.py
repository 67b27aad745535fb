"""Points of a frame matched with the flowers that a track expects, one to one."""

from __future__ import annotations

import numpy as np

from cluster_slam.geometry import Array, skew, transform
from cluster_slam.localisation.fit import GATE_CHI2, LOG_2PI
from cluster_slam.localisation.scene import Look
from cluster_slam.localisation.shifts import settled
from cluster_slam.localisation.state import State
from cluster_slam.records import IntArray
from tracking.assignment import assign
from tracking.gating import mahalanobis_sq


def associate(
    state: State,
    look: Look,
    sway_m: float,
    null_density: float,
    points: IntArray | None = None,
    flowers: IntArray | None = None,
) -> tuple[IntArray, IntArray]:
    """Points and flowers matched as predicted; among the given points and flowers, None: all."""
    if len(look) == 0:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    points = np.arange(len(look)) if points is None else points
    flowers = np.arange(len(state.marks)) if flowers is None else flowers
    R, marks = state.V[:3, :3], state.marks
    seen = transform(state.V, look.points[points])
    point_covs = R @ look.covs[points] @ R.T
    places = state.places(flowers)
    flowers, places = _in_reach(state, look, points, seen, point_covs, flowers, places, sway_m)
    if len(flowers) == 0:
        return flowers, flowers
    of = marks.cluster[flowers]
    covs, common, own = state.predicted_covs(flowers, places, sway_m)
    shared = np.zeros((marks.n_clusters, 3, 3))
    shared[of] = common  # of one of its flowers: they are close to each other
    lasting = np.trace(shared, axis1=1, axis2=2) - 3.0 * sway_m**2
    vague = lasting > 3.0 * sway_m**2 + float(np.trace(point_covs, axis1=1, axis2=2).mean())
    free = np.ones(len(flowers), bool)
    if vague.any():  # a cluster whose place is known less well than a point is measured
        places, found, free = settled(seen, point_covs.mean(0), places, own, of, shared, vague, null_density)
        covs = np.where(vague[of, None, None], found, covs)
    return _one_to_one(seen, point_covs, places, covs, free, null_density, points, flowers)


def _in_reach(
    state: State,
    look: Look,
    points: IntArray,
    seen: Array,
    point_covs: Array,
    flowers: IntArray,
    places: Array,
    sway_m: float,
) -> tuple[IntArray, Array]:
    """The flowers of those clusters of which one at least may be near a point, and their places."""
    R, marks = state.V[:3, :3], state.marks
    J = np.concatenate([-R @ skew(look.points[points]), np.broadcast_to(R, (len(points), 3, 3))], axis=-1)
    by_pose = float(((J @ state.P[:6, :6]) * J).sum((1, 2)).max())
    own = float(np.trace(point_covs, axis1=1, axis2=2).max())
    reach = GATE_CHI2 * (2.0 * by_pose + 2.0 * state.most_off(sway_m) + own)
    close = np.zeros(marks.n_clusters, bool)
    close[marks.cluster[flowers[(_apart_sq(seen, places) < reach).any(0)]]] = True
    kept = close[marks.cluster[flowers]]
    return flowers[kept], places[kept]


def _one_to_one(
    seen: Array,
    point_covs: Array,
    places: Array,
    covs: Array,
    free: Array,
    null_density: float,
    points: IntArray,
    flowers: IntArray,
) -> tuple[IntArray, IntArray]:
    largest = np.trace(point_covs, axis1=1, axis2=2).max() + np.trace(covs, axis1=1, axis2=2)
    i, j = np.nonzero((_apart_sq(seen, places) < GATE_CHI2 * largest) & free)
    if len(i) == 0:
        return i, j
    S = point_covs[i] + covs[j]
    d2 = mahalanobis_sq(seen[i] - places[j], S)
    log_det = np.linalg.slogdet(S)[1]
    near, column = np.unique(j, return_inverse=True)
    cost = np.full((len(points), len(near)), np.inf)
    cost[i, column] = np.where(d2 < GATE_CHI2, 0.5 * (d2 + log_det + 3.0 * LOG_2PI), np.inf)
    rows, columns = assign(cost, -float(np.log(null_density)))
    return points[rows], flowers[near[columns]]


def _apart_sq(a: Array, b: Array) -> Array:
    """Squared distances (n, k) of points a (n, 3) and b (k, 3), by one product: next to zero they are rough."""
    return np.asarray((a * a).sum(1)[:, None] + (b * b).sum(1) - 2.0 * (a @ b.T))
