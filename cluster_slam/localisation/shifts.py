"""Where each cluster of an old map stands by now: found from all of its flowers together, before they are matched.

A cluster that may have drifted by as much as its flowers lie apart cannot be matched flower by flower: each alone
would take the nearest. Its flowers moved together, so every pair of a point and a flower proposes a displacement, and
what the others say of it decides. Where two displacements explain the frame about as well, or flowers that the map does
not have explain it about as well as any, the cluster is left alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

_GATE_CHI2 = 16.3  # 3 degrees of freedom: 99.9 % of true displacements
_SURE = 0.95  # share of the weight that the best displacement must have
_LOG_2PI = float(np.log(2.0 * np.pi))


@dataclass(frozen=True, slots=True, eq=False)
class Shift:
    """Displacement of one cluster as a frame has it."""

    mean: Array  # (3,) m, map
    cov: Array  # (3, 3)
    is_sure: bool


def shift_of(
    points: Array, point_cov: Array, places: Array, own_cov: Array, shared: Array, null_density: float
) -> Shift:
    """How far the flowers of one cluster stand from their places, all by the same.

    Parameters
    ----------
    points : (n, 3) m, map, as the predicted pose has them.
    point_cov : (3, 3) of a point alone, about the usual.
    places : (k, 3) m, map, of the cluster's flowers.
    own_cov : (3, 3) of a flower's place in its cluster, about the usual.
    shared : (3, 3) of the displacement before the frame, with what the pose may be wrong by there.
    null_density : 1/m^3, of points that are of no flower of the map.
    """
    V = point_cov + own_cov
    off = points[:, None] - places  # (n, k, 3)
    prior_d2 = _squares(off, shared + V)
    i, j = np.nonzero(prior_d2 < _GATE_CHI2)
    if len(i) == 0:
        return Shift(np.zeros(3), shared, is_sure=True)
    near = (prior_d2 < 4.0 * _GATE_CHI2).any(1)
    seeds = off[i, j]
    L: Array = np.asarray(np.linalg.cholesky(V), dtype=np.float64)
    white: Array = np.asarray(np.linalg.solve(L, off[near].reshape(-1, 3).T).T, dtype=np.float64)
    white_seeds: Array = np.asarray(np.linalg.solve(L, seeds.T).T, dtype=np.float64)
    gains = _gains(white.reshape(-1, len(places), 3), white_seeds, L, null_density)
    room = (
        np.linalg.slogdet(2.0 * V)[1] - np.linalg.slogdet(shared + V)[1]
    )  # a displacement may be any, a point just so
    scores = gains.sum(1) - 0.5 * (prior_d2[i, j] - room)
    best = int(scores.argmax())
    alike = ((white_seeds - white_seeds[best]) ** 2).sum(1) < 2.0 * _GATE_CHI2
    other = scores[~alike].max() if (~alike).any() else -np.inf
    odds = np.exp(
        np.minimum([other - scores[best], -scores[best]], 50.0)
    )  # another displacement; or none of its flowers
    is_sure = bool(1.0 / (1.0 + odds.sum()) >= _SURE)
    return _settled(off[near], seeds[best], V, shared, is_sure)


def _gains(white: Array, seeds: Array, L: Array, null_density: float) -> Array:
    """Log odds that each flower (s, k) gains under each seed by the nearest whitened point; 0 where none is near."""
    d2 = ((white[None] - seeds[:, None, None]) ** 2).sum(-1)  # (s, n, k)
    log_det = 2.0 * float(np.log(np.diag(L)).sum()) + 3.0 * float(np.log(2.0))  # the seed errs as much as the point
    gain = -0.25 * d2.min(axis=1) - 0.5 * (log_det + 3.0 * _LOG_2PI) - np.log(null_density)
    return np.asarray(np.maximum(gain, 0.0), dtype=np.float64)


def _settled(off: Array, shift: Array, V: Array, shared: Array, is_sure: bool, n_rounds: int = 2) -> Shift:
    """The displacement of least squares from the flowers that lie near it, with the prior."""
    cov = shared
    for _ in range(n_rounds):
        d2 = _squares(off - shift, 2.0 * V)
        row = d2.argmin(0)
        matched = d2[row, np.arange(d2.shape[1])] < _GATE_CHI2
        each = off[row[matched], np.flatnonzero(matched)]
        m = len(each)
        if m == 0:
            return Shift(np.zeros(3), shared, is_sure)
        gain = np.linalg.solve(shared + V / m, shared).T
        shift, cov = gain @ each.mean(0), shared - gain @ shared
    return Shift(shift, 0.5 * (cov + cov.T), is_sure)


def _squares(off: Array, cov: Array) -> Array:
    white = np.linalg.solve(np.linalg.cholesky(cov), off.reshape(-1, 3).T)
    return np.asarray((white**2).sum(0).reshape(off.shape[:-1]), dtype=np.float64)


def settled(
    points: Array,
    point_cov: Array,
    places: Array,
    own_covs: Array,
    cluster: IntArray,
    shared: Array,
    drifted: BoolArray,
    null_density: float,
) -> tuple[Array, Array, BoolArray]:
    """Places (f, 3) and covariances (f, 3, 3) of flowers after their clusters were settled, and which may be matched.

    Of the clusters (c,) only ``drifted`` are settled; ``shared`` (c, 3, 3) is of their displacements, with what the
    pose may be wrong by there. Others stay as they are, with the shared covariance added to their own; so do those
    that no point can be of.
    """
    places, covs, free = places.copy(), own_covs + shared[cluster], np.ones(len(places), bool)
    reach = _GATE_CHI2 * (np.trace(covs, axis1=1, axis2=2) + float(np.trace(point_cov)))
    near = (((points[:, None] - places) ** 2).sum(-1) < reach).any(0)
    for c in np.flatnonzero(np.bincount(cluster[near], minlength=len(shared)).astype(bool) & drifted).tolist():
        of = np.flatnonzero(cluster == c)
        close = (((points[:, None] - places[of]) ** 2).sum(-1) < 4.0 * reach[of]).any(1)
        found = shift_of(points[close], point_cov, places[of], own_covs[of].mean(0), shared[c], null_density)
        places[of] += found.mean
        covs[of] = own_covs[of] + found.cov
        free[of] = found.is_sure
    return places, covs, free
