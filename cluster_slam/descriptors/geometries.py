"""The full-geometry test for many pairs of clusters at once, members with equal isotropic errors."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.descriptors.alignment import align_isotropic
from cluster_slam.descriptors.geometry import WIDER, first_limit
from cluster_slam.descriptors.members import checked_points, checked_sigma
from cluster_slam.descriptors.search import search_maps
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

PAIRS_AT_ONCE = 1000


@dataclass(frozen=True, slots=True, eq=False)
class GeometryMatches:
    """As `GeometryMatch` for p pairs of clusters of n and m members, k = min(n, m)."""

    distance_sq: Array  # (p,) inf where no map is within the limit
    dof: Array  # (p,) NaN where there is no match
    log_likelihood: Array  # (p,)
    runner_up_sq: Array  # (p,)
    reference: IntArray  # (p, k) matched members of the reference, 0 where there is no match
    observed: IntArray  # (p, k) their partners


def match_geometries(
    reference: Array, observed: Array, sigma: Array | float, limit: Array | float | None = None
) -> GeometryMatches:
    """Match pairs of clusters; of each pair the smaller is matched whole.

    Parameters
    ----------
    reference, observed
        (p, n, 3) and (p, m, 3), n, m >= 2, m.
    sigma
        (p,) or one number: standard deviation of a residual along each axis, hypot of both sides' sigmas, m.
    limit
        (p,) or one number: squared distances above it count as no match, which is much faster. None: the best map is
        found however bad.

    Raises
    ------
    InputError
        Fewer than two flowers, a position that is not finite, or a sigma that is not positive.
    """
    a, b = checked_points(reference), checked_points(observed)
    is_turned = a.shape[1] > b.shape[1]
    if is_turned:
        a, b = b, a
    var = np.broadcast_to(checked_sigma(sigma) ** 2, len(a))
    few, many = np.zeros((2, len(a), a.shape[1]), dtype=np.int64)
    distance_sq, dof, log_likelihood, runner_up_sq = (np.full(len(a), v) for v in (np.inf, np.nan, -np.inf, np.inf))
    sides = (many, few) if is_turned else (few, many)
    out = GeometryMatches(distance_sq, dof, log_likelihood, runner_up_sq, *sides)
    if limit is not None:
        _fill(out, many, a, b, var, np.arange(len(a)), np.broadcast_to(np.asarray(limit, float), len(a)))
        few[np.isfinite(out.distance_sq)] = np.arange(a.shape[1])
        return out
    current = first_limit(a.shape[1], b.shape[1])
    while len(left := np.flatnonzero(np.isinf(out.distance_sq))):
        _fill(out, many, a, b, var, left, np.full(len(a), current))
        current *= WIDER
    few[:] = np.arange(a.shape[1])
    return out


def _fill(
    out: GeometryMatches, partner: IntArray, a: Array, b: Array, var: Array, pairs: IntArray, limit: Array
) -> None:
    for start in range(0, len(pairs), PAIRS_AT_ONCE):
        some = pairs[start : start + PAIRS_AT_ONCE]
        maps = search_maps(a[some], b[some], var[some], limit[some])
        found, first = np.unique(maps.pair, return_index=True)
        pair = some[found]
        partner[pair] = maps.partner[first]
        matched = np.take_along_axis(b[pair], partner[pair, :, None], axis=1)
        aligned = align_isotropic(a[pair], matched, var[pair])
        out.distance_sq[pair], out.dof[pair] = aligned.distance_sq, aligned.dof
        out.log_likelihood[pair] = aligned.log_likelihood
        second = first + 1 < np.append(first[1:], len(maps.pair))  # a pair with another map
        out.runner_up_sq[pair[second]] = maps.bound[first[second] + 1]
