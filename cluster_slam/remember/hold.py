"""Ellipsoids that hold what they claim: a centroid jumps when another flower is seen, which no Gaussian does."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray
from cluster_slam.remember.seen import Habits

N_DRAWS = 600  # of which flowers are seen, for each cluster
BLOCK = 4_000_000  # flowers times draws at once
HELD, CHI2_HELD = 0.95, 7.814728  # share of the draws within the ellipsoid, of a chi-square with 3 degrees of freedom


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Which flowers make up the centroids that will be seen."""

    offsets: Array  # (f, 3) of the flowers from their cluster's expected centroid
    share: Array  # (f,) probability of being seen
    row: IntArray  # (f,) cluster
    unknown: Array  # (c,) mean number of others
    spread: Array  # (c,) their variance along each axis about the cluster's middle ...
    middle: Array  # (c,) ... and its own about the expected centroid


def holding(covs: Array, smooth: Array, seen: Seen, habits: Habits) -> Array:
    """Covariances (c, 3, 3) scaled so that their 95 % ellipsoids hold 95 % of what may be seen.

    Parameters
    ----------
    covs
        (c, 3, 3) of the centroids of the flowers that will be seen.
    smooth
        (c, 3, 3) the part of it that is Gaussian: drift and the flowers' own errors.
    habits
        Shares that are only known from a few flowers are drawn, too.

    Notes
    -----
    The draws are the same ones each time. Clusters of which nothing is seen do not count.
    """
    n, rng = len(covs), np.random.default_rng(0)
    order = np.argsort(seen.row, kind="stable")
    first = np.searchsorted(seen.row[order], np.arange(n + 1))
    scale = np.ones(n)
    step = max(1, int(BLOCK // (N_DRAWS * max(1.0, len(order) / max(n, 1)))))
    for begin in range(0, n, step):
        block = slice(begin, min(begin + step, n))
        mine = order[first[begin] : first[block.stop]]
        part = Seen(
            *(seen.offsets[mine], seen.share[mine], seen.row[mine] - begin),
            *(seen.unknown[block], seen.spread[block], seen.middle[block]),
        )
        jumps, is_seen = _jumps(rng, part, habits)
        noise = np.einsum("cij,cbj->cbi", np.linalg.cholesky(_positive(smooth[block])), rng.normal(size=jumps.shape))
        errors = jumps + noise
        squared = np.einsum("cbi,cib->cb", errors, np.linalg.solve(_positive(covs[block]), np.swapaxes(errors, 1, 2)))
        some = is_seen.sum(axis=1) > N_DRAWS // 20
        squared = np.where(is_seen, squared, np.nan)[some]
        scale[block][some] = np.nanquantile(squared, HELD, axis=1) / CHI2_HELD
    scaled: Array = covs * scale[:, None, None]
    return scaled


def _jumps(rng: np.random.Generator, seen: Seen, habits: Habits) -> tuple[Array, BoolArray]:
    """Centroids (c, b, 3) of flowers that are seen by chance, and whether (c, b) any is."""
    n = len(seen.unknown)
    share = rng.beta(habits.share * habits.looks, (1.0 - habits.share) * habits.looks, N_DRAWS)
    more_or_less = rng.gamma(habits.surprises, 1.0 / habits.surprises, N_DRAWS)
    is_seen = rng.random((len(seen.row), N_DRAWS)) < seen.share[:, None] * share / habits.share
    total, count = np.zeros((n, N_DRAWS, 3)), np.zeros((n, N_DRAWS))
    np.add.at(total, seen.row, is_seen[:, :, None] * seen.offsets[:, None])
    np.add.at(count, seen.row, is_seen)
    others = rng.poisson(seen.unknown[:, None] * more_or_less)
    sigma = np.sqrt(others * seen.spread[:, None] + others**2 * seen.middle[:, None])
    total += sigma[:, :, None] * rng.normal(size=total.shape)
    count += others
    return total / np.maximum(count, 1.0)[:, :, None], count > 0


def _positive(covs: Array) -> Array:
    """With a floor of 0.01 mm, for what nobody doubts."""
    floored: Array = covs + 1e-10 * np.eye(3)
    return floored
