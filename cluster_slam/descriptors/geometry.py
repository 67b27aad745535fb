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
    var, alone = _largest_var(cov_a) + _largest_var(cov_b), (len(a) + len(b)) * missed_cost
    current = min(alone, first_limit(len(a), len(b), missed_cost) if limit is None else limit)
    while True:
        maps = search_maps(a[None], b[None], np.array([var]), np.array([current]), missed_cost)
        best = _best(maps, a, cov_a, b, cov_b, missed_cost, current)
        if limit is not None or np.isfinite(best.distance_sq) or current >= alone or not np.isfinite(current):
            return best
        current = min(alone, current * WIDER)


def _best(
    maps: Maps, a: Array, cov_a: Array, b: Array, cov_b: Array, missed_cost: float, limit: float
) -> GeometryMatch:
    """Align the maps by increasing bound until no bound is left below the best cost."""
    var = _common_var(cov_a, cov_b)
    price = missed_cost if np.isfinite(missed_cost) else 0.0
    best, best_cost, next_cost = None, np.inf, np.inf
    for row, bound in zip(maps.partner, maps.bound, strict=True):
        if bound > best_cost:
            next_cost = min(next_cost, float(bound))
            break
        i = np.flatnonzero(row != MISSED)
        if len(i) < 2:
            continue
        aligned = _aligned(a, cov_a, b, cov_b, i, row[i], var)
        cost = float(aligned.distance_sq) + price * (len(a) + len(b) - 2 * len(i))
        if cost < best_cost:
            best, best_cost, next_cost = (aligned, i, row[i]), cost, best_cost
        else:
            next_cost = min(next_cost, cost)
    if best is None or best_cost > limit:
        return NO_MATCH
    aligned, i, j = best
    log_likelihood, dof = float(aligned.log_likelihood), int(aligned.dof)
    return GeometryMatch(float(aligned.distance_sq), dof, log_likelihood, i, j, aligned.T, next_cost)


def _aligned(a: Array, cov_a: Array, b: Array, cov_b: Array, i: IntArray, j: IntArray, var: float | None) -> Aligned:
    if var is not None:
        return align_isotropic(a[i], b[j], np.asarray(var))
    return align(a[i], _of_members(cov_a, i), b[j], _of_members(cov_b, j))


def _of_members(cov: Array, members: IntArray) -> Array:
    index = (3 * members[:, None] + np.arange(3)).ravel()
    out: Array = cov[np.ix_(index, index)]
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
