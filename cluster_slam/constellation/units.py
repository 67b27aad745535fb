"""What is matched with what: clusters of flowers, or flowers one by one, as padded arrays in two or three dimensions.

Flowers come as clusters, but how a session grouped them need not be how the map did. So matching is done twice, with
clusters and with single flowers as units, under one common background, and the likelier explanation is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.config import MatchConfig
from cluster_slam.geometry import Array
from cluster_slam.records import Constellation, IntArray, PlantMap
from tracking.reid import Background, Groups

MATCH_FLOOR_M = 0.0015  # no two sessions agree on a flower's place better than this: it opens, it turns


@dataclass(frozen=True, slots=True, eq=False)
class Units:
    """Groups of flowers, each with a common offset that is unknown."""

    groups: Groups  # points (u, k, d)
    centres: Array  # (u, d)
    var_offset: Array  # (u,) of the offset that its flowers share, along each axis
    seen: Array  # (u, k) probability that the flower is there and would be seen
    flower: IntArray  # (u, k) row of each member in the flowers' table, -1 padding
    cluster: IntArray  # (u,) row of the unit's cluster

    def __len__(self) -> int:
        return len(self.centres)


def units_of(
    points: Array, variances: Array, cluster_row: IntArray, var_offset: Array, seen: Array, *, single: bool
) -> Units:
    """Units of flowers (f, d): their clusters, or each flower by itself."""
    owner = np.arange(len(points)) if single else cluster_row
    names, unit = np.unique(owner, return_inverse=True)
    counts = np.bincount(unit, minlength=len(names))
    order = np.argsort(unit, kind="stable")
    place = np.arange(len(points)) - np.repeat(np.cumsum(counts) - counts, counts)
    table = np.full((len(names), max(int(counts.max(initial=1)), 1)), -1, dtype=np.int64)
    table[unit[order], place] = order
    mask = table >= 0
    padded = np.where(mask[..., None], points[table], 0.0) if len(points) else np.zeros((0, 1, points.shape[1]))
    centres = padded.sum(axis=1) / np.maximum(mask.sum(axis=1), 1)[:, None]
    cluster = cluster_row[table[:, 0]]
    return Units(
        Groups(padded, np.where(mask, variances[table], 1.0), mask),
        centres,
        var_offset[cluster],
        np.where(mask, seen[table], 0.5),
        table,
        cluster,
    )


def session_units(session: Constellation, points: Array, *, single: bool) -> Units:
    """Units of a session whose flowers are at ``points`` (f, d)."""
    row = np.searchsorted(session.cluster_ids, session.flower_cluster_ids).astype(np.int64)
    variances = np.trace(session.flower_covs, axis1=1, axis2=2) / 3.0
    none = np.zeros(len(session.cluster_ids))
    return units_of(points, variances, row, none, np.ones(len(points)), single=single)


def plant_units(plant: PlantMap, points: Array, config: MatchConfig, *, single: bool) -> Units:
    """Units of a plant, moved to the session's time, whose flowers are at ``points`` (f, d)."""
    variances = np.trace(plant.flower_covs, axis1=1, axis2=2) / 3.0 + MATCH_FLOOR_M**2
    var_offset = np.trace(plant.cluster_covs, axis1=1, axis2=2) / 3.0 + MATCH_FLOOR_M**2
    seen = config.seen_share * plant.flower_presence
    return units_of(points, variances, plant.flower_rows, var_offset, seen, single=single)


def background_of(first: Units, second: Units, config: MatchConfig, n_new: float) -> Background:
    """Densities of clusters in the plant and of flowers in a cluster, from both sides together.

    Volumes are those of uniform ellipsoids with the measured second moments.
    """
    d = first.centres.shape[1]
    group = np.mean([np.log(max(len(u), 1)) - log_volume(u.centres) for u in (first, second)])
    within = [_within(u) for u in (first, second)]
    squares, n = sum(w[0] for w in within), sum(w[1] for w in within)
    # without clusters of two or more there is no inside: a flower more is as likely as anywhere
    log_inside = -log_ball(d) - 0.5 * d * np.log((d + 2) * squares / (n * d)) if n > 0 else group
    return Background(float(log_inside), float(group), n_new)


def spread_of(background: Background, d: int) -> float:
    """Variance along each axis of a flower in its cluster, from the density of an ellipsoid of that variance."""
    return float(np.exp(-2.0 / d * (background.log_density + log_ball(d))) / (d + 2))


def log_volume(points: Array) -> float:
    """Log volume of the uniform ellipsoid (ellipse) with the second moments of points (n, d)."""
    d = points.shape[1]
    centred = points - points.mean(axis=0)
    moments = centred.T @ centred / max(len(points) - 1, 1)
    values = np.linalg.eigvalsh(moments)
    floor = max(values[-1] * 1e-2, 1e-4)
    return float(log_ball(d) + 0.5 * np.log((d + 2) * np.maximum(values, floor)).sum())


def log_ball(d: int) -> float:
    """Log volume of the unit ball in two or three dimensions."""
    return float(np.log(np.pi if d == 2 else 4.0 * np.pi / 3.0))


def _within(units: Units) -> tuple[float, int]:
    """Sum of squared distances from the centres, and degrees of freedom, of units of two or more."""
    mask = units.groups.mask
    many = mask.sum(axis=1) >= 2
    offsets = (units.groups.points - units.centres[:, None])[many][mask[many]]
    d = units.centres.shape[1]
    dof = int(mask[many].sum() - many.sum()) * d
    return float((offsets**2).sum()), dof // d if dof else 0
