"""Where a plant's clusters will be on a date, with ellipsoids that hold the truth as often as they claim."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_slam.config import MapConfig
from cluster_slam.constellation.growth import DAY_S, at
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray, PlantMap
from cluster_slam.remember.hold import Seen, holding
from cluster_slam.remember.seen import habits_of, is_real, scattered, unknown_flowers
from tracking.presence import persisted

PRIOR_SPREAD = 2.0  # the plant's mean spread of flowers counts as so many flowers of each cluster
N_NODES = 24


def predict_plant(plant: PlantMap, time: float, config: MapConfig) -> tuple[PlantMap, Array]:
    """The plant at a time, and covariances (c, 3, 3): 95 % ellipsoids hold the centroid of what will be seen in 95 %.

    A cluster's centroid moves with the cluster, and because other flowers make it up: some are lost, some are hidden
    that day, some open, some were there all the time and nobody saw them.
    """
    moved = at(plant, time, config.growth)
    row, n = moved.flower_rows, len(moved.cluster_ids)
    habits = habits_of(plant, config)
    since = np.maximum(np.nan_to_num(time - plant.flower_last_looked_at) / DAY_S, 0.0)
    share = habits.share * persisted(moved.flower_presence, config.growth.lost_per_day, since)
    share = share * is_real(plant, habits.at_once * config.match.ghosts)
    weight = np.maximum(np.bincount(row, share, n), 1e-12)
    centres = np.stack([np.bincount(row, share * x, n) for x in moved.flowers.T], axis=1) / weight[:, None]
    offsets = moved.flowers - centres[row]
    unknown, spread = unknown_flowers(plant, weight, habits, time, config), _spread(offsets, row, n)
    spread = spread * scattered(plant, spread)
    smooth: Array = moved.cluster_covs + _sum(row, n, (share / weight[row]) ** 2, moved.flower_covs)
    middle = spread / np.maximum(np.bincount(row, minlength=n), 1)  # of a cluster, about the few flowers that are known
    covs = smooth + membership_cov(offsets, share, row, unknown, spread + middle)
    seen = Seen(offsets, share, row, unknown, spread, middle)
    return replace(moved, clusters=centres), holding(covs, smooth, seen, habits)


def _spread(offsets: Array, row: IntArray, n: int) -> Array:
    """Variance (c,) along each axis of a flower's place in its cluster; what few flowers tell leans on the plant's."""
    squares = np.bincount(row, (offsets**2).sum(axis=1), n) / 3.0
    dof = np.maximum(np.bincount(row, minlength=n) - 1.0, 0.0)
    common = float(squares[dof > 0].sum() / max(dof.sum(), 1.0))
    spread: Array = (PRIOR_SPREAD * common + squares) / (PRIOR_SPREAD + dof)
    return spread


def membership_cov(offsets: Array, share: Array, row: IntArray, unknown: Array, spread: Array) -> Array:
    """Covariances (c, 3, 3) of the centroids of random subsets of flowers, given that any flower is seen.

    Flower i is seen with probability q_i = ``share``, and a Poisson number of others, of variance ``spread`` an axis,
    joins them. With N flowers seen, and q-weighted offsets that sum to zero:

        E[1/(1+N')^2] sum q o o' + E[1/(1+N)^2] unknown spread I - E[1/(2+N'')^2] sum q^2 o o'

    where N' and N'' count all but one and all but two, and E[1/(k+N)^2] is the integral over u from 0 to 1 of
    -ln(u) u^(k-1) E[u^N].
    """
    n = len(unknown)
    q = np.clip(share, 1e-6, 1.0 - 1e-9)
    nodes, weights = np.polynomial.legendre.leggauss(N_NODES)
    v = 0.5 * (nodes + 1.0)
    u, du = v**3, 0.5 * weights * 3.0 * v**2  # where the logarithm grows, more nodes
    factors = np.log1p(-q[:, None] * (1.0 - u))
    members = np.maximum(np.bincount(row, minlength=n), 1)
    total = np.stack([np.bincount(row, x, n) for x in factors.T], axis=1) - unknown[:, None] * (1.0 - u)
    mean = (total + unknown[:, None] * (1.0 - u)) / members[:, None]
    any_seen = -np.expm1(np.bincount(row, np.log1p(-q), n) - unknown)
    none = (np.exp(total) * -np.log(u) * du).sum(axis=1) / any_seen
    one = (np.exp(total - mean) * -np.log(u) * du).sum(axis=1) / any_seen
    two = (np.exp(total - 2.0 * mean) * -np.log(u) * u * du).sum(axis=1) / any_seen
    outer = offsets[:, :, None] * offsets[:, None, :]
    known = one[:, None, None] * _sum(row, n, q, outer) - two[:, None, None] * _sum(row, n, q * q, outer)
    covs: Array = known + (none * unknown * spread)[:, None, None] * np.eye(3)
    return covs


def _sum(row: IntArray, n: int, weight: Array, matrices: Array) -> Array:
    """Weighted sums (n, 3, 3) of matrices (f, 3, 3) by row."""
    out = np.zeros((n, 3, 3))
    np.add.at(out, row, weight[:, None, None] * matrices)
    return out
