"""The full-geometry test: are two clusters one shape, wherever and however they stand, whichever member is which?

The best one-to-one map of the members and the best rigid motion leave a residual that is chi-square with 3 k - 6
degrees of freedom, k the number of matched members. Members may be missing on either side.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.descriptors.alignment import Aligned, align, align_isotropic
from cluster_slam.descriptors.members import centred_cov, checked_points
from cluster_slam.descriptors.search import MISSED, Maps, search_maps
from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, inverse
from cluster_slam.records import IntArray
from tracking.gating import chi2_threshold
from tracking.gaussian import ensure_positive_definite

FIRST_LIMIT = 0.999  # the search begins within this gate and widens while it finds nothing
WIDER = 4.0
ALIGNED_AT_ONCE = 16


@dataclass(frozen=True, slots=True, eq=False)
class GeometryMatch:
    """The best map of one cluster's members onto another's."""

    distance_sq: float  # squared Mahalanobis distance of the residuals; inf where none is within the limit
    dof: int  # 3 k - 6; more where the shape leaves a rotation undetermined; 0 where there is no match
    log_likelihood: float  # of the matched members, integrated over the pose (`Aligned`)
    reference: IntArray  # (k,) matched members of the reference, increasing
    observed: IntArray  # (k,) their partners
    T_observed_reference: Array  # (4, 4) takes reference points onto observed ones
    runner_up_sq: float  # no other map found within the limit costs less; inf where there is no other


NOT_ALIGNED = Aligned(np.eye(4), np.array(np.inf), np.array(0.0), np.array(-np.inf))
NO_MATCH = GeometryMatch(np.inf, 0, -np.inf, np.zeros(0, np.int64), np.zeros(0, np.int64), np.eye(4), np.inf)


def match_geometry(
    reference: Array,
    reference_cov: Array,
    observed: Array,
    observed_cov: Array,
    *,
    missed_cost: float = np.inf,
    limit: float | None = None,
) -> GeometryMatch:
    """Match members (n, 3) with members (m, 3), each with a joint covariance.

    Parameters
    ----------
    reference, observed
        (n, 3) and (m, 3), n, m >= 2, each in its own frame, m.
    reference_cov, observed_cov
        Joint covariances (3 n, 3 n) and (3 m, 3 m) in the same frames, m^2.
    missed_cost
        Price of each member that stays alone, in units of the squared distance. Infinite: the smaller cluster is
        matched whole.
    limit
        Costs above it count as no match, which is much faster. None: the best map is found however bad.

    Raises
    ------
    InputError
        Fewer than two flowers, a position that is not finite, or covariances of the wrong shape.
    CovarianceError
        The covariance of the residuals is not positive definite.
    """
    a, b = checked_points(reference), checked_points(observed)
    cov_a, cov_b = _checked_cov(reference_cov, len(a)), _checked_cov(observed_cov, len(b))
    if not missed_cost > 0:
        raise InputError(f"missed_cost must be > 0, got {missed_cost}")
    if len(a) > len(b) and not np.isfinite(missed_cost):
        return _turned(match_geometry(b, cov_b, a, cov_a, missed_cost=missed_cost, limit=limit))
    pair = _Pair(a, cov_a, b, cov_b, missed_cost if np.isfinite(missed_cost) else 0.0)
    var, alone = _largest_var(cov_a) + _largest_var(cov_b), (len(a) + len(b)) * missed_cost
    current = min(alone, first_limit(len(a), len(b), missed_cost) if limit is None else limit)
    while True:
        maps = search_maps(a[None], b[None], np.array([var]), np.array([current]), missed_cost)
        best = _best(maps, pair, current)
        if limit is not None or np.isfinite(best.distance_sq) or current >= alone or not np.isfinite(current):
            return best
        current = min(alone, current * WIDER)


@dataclass(frozen=True, slots=True, eq=False)
class _Pair:
    """Two clusters and what a member without partner costs."""

    a: Array
    cov_a: Array
    b: Array
    cov_b: Array
    price: float  # 0 where the smaller cluster is matched whole

    def align(self, partner: IntArray) -> tuple[Array, list[Aligned]]:
        """Costs (s,) and alignments of maps (s, n)."""
        counts = (partner != MISSED).sum(1)
        costs, found = np.full(len(partner), np.inf), [NOT_ALIGNED] * len(partner)
        for k in np.unique(counts[counts >= 2]).tolist():
            rows = np.flatnonzero(counts == k)
            i = np.nonzero(partner[rows] != MISSED)[1].reshape(len(rows), k)
            j = np.take_along_axis(partner[rows], i, axis=1)
            aligned = self._align(i, j)
            costs[rows] = aligned.distance_sq + self.price * (len(self.a) + len(self.b) - 2 * k)
            for at, row in enumerate(rows.tolist()):
                found[row] = aligned.of(at)
        return costs, found

    def _align(self, i: IntArray, j: IntArray) -> Aligned:
        var = _common_var(self.cov_a, self.cov_b)
        if var is not None:
            return align_isotropic(self.a[i], self.b[j], np.full(len(i), var))
        return align(self.a[i], _of_members(self.cov_a, i), self.b[j], _of_members(self.cov_b, j))


def _best(maps: Maps, pair: _Pair, limit: float) -> GeometryMatch:
    """Align the maps by increasing bound until no bound is left below the best cost."""
    best, best_at, best_cost, next_cost = NOT_ALIGNED, -1, np.inf, np.inf
    start, step = 0, 1
    while start < len(maps.bound) and maps.bound[start] <= best_cost:
        costs, found = pair.align(maps.partner[start : start + step])
        for at, cost in enumerate(costs.tolist()):
            if cost < best_cost:
                best, best_at, best_cost, next_cost = found[at], start + at, cost, best_cost
            else:
                next_cost = min(next_cost, cost)
        start, step = start + step, ALIGNED_AT_ONCE
    if start < len(maps.bound):
        next_cost = min(next_cost, float(maps.bound[start]))
    if best_cost > limit or best_at < 0:
        return NO_MATCH
    row = maps.partner[best_at]
    i = np.flatnonzero(row != MISSED)
    values = float(best.distance_sq), int(best.dof), float(best.log_likelihood)
    return GeometryMatch(*values, i, row[i], best.T, next_cost)


def _of_members(cov: Array, members: IntArray) -> Array:
    """Joint covariances (s, 3 k, 3 k) of some choices (s, k) of members."""
    index = (3 * members[..., None] + np.arange(3)).reshape(len(members), -1)
    out: Array = cov[index[:, :, None], index[:, None, :]]
    return out


def _common_var(cov_a: Array, cov_b: Array) -> float | None:
    """The variance of every residual where all are equal, isotropic and independent; else None."""
    total = 0.0
    for cov in (cov_a, cov_b):
        var = float(cov[0, 0])
        if np.abs(cov - var * np.eye(len(cov))).max() > 1e-12 * abs(var):
            return None
        total += var
    return total


def _largest_var(cov: Array) -> float:
    """Largest variance of the members relative to their centroid: an error that all share moves no shape."""
    return float(np.linalg.eigvalsh(centred_cov(cov))[-1])


def first_limit(n: int, m: int, missed_cost: float = np.inf) -> float:
    """Where the search for the best map begins."""
    forced = abs(n - m) * missed_cost if np.isfinite(missed_cost) else 0.0
    return chi2_threshold(max(3 * min(n, m) - 6, 1), FIRST_LIMIT) + forced


def _checked_cov(cov: Array, n: int) -> Array:
    cov = np.asarray(cov, float)
    if cov.shape != (3 * n, 3 * n):
        raise InputError(f"{n} flowers want a joint covariance ({3 * n}, {3 * n}), got {cov.shape}")
    return ensure_positive_definite(cov, "covariance of the members")


def _turned(match: GeometryMatch) -> GeometryMatch:
    order = np.argsort(match.observed)
    T = inverse(match.T_observed_reference)
    return replace(match, reference=match.observed[order], observed=match.reference[order], T_observed_reference=T)
