"""The flowers of one plant as a map predicts them for one instant."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from cluster_slam.config import GrowthConfig
from cluster_slam.constellation import growth
from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, adjoint, inverse, skew
from cluster_slam.records import BoolArray, IntArray, PlantMap

_GONE_BELOW = 0.1  # presence
LEAST_SIGMA_M = 1e-5  # a place that is stated exact still has an invertible covariance


@dataclass(frozen=True, eq=False)
class Landmarks:
    """Flowers of one plant in the plant's own frame of the map.

    ``covs`` is of each flower about its cluster, ``shared_covs`` of the error that all flowers of a cluster share: how
    well its place is known now, with what it may have drifted since it was last seen. ``frame_cov`` is of what no
    session could see: what all of them drifted in common since the map's first.
    """

    plant: str
    flower_ids: IntArray  # (f,)
    cluster_ids: IntArray  # (f,) cluster of each flower
    positions: Array  # (f, 3) map, m
    covs: Array  # (f, 3, 3) m^2
    shared_covs: Array  # (c, 3, 3) m^2, in the order of the increasing cluster ids
    frame_cov: Array = field(default_factory=lambda: np.zeros((6, 6)))  # of all landmarks as one, tangent on the left

    def __len__(self) -> int:
        return len(self.flower_ids)

    @cached_property
    def cluster(self) -> IntArray:
        """Index of each flower's cluster (f,), 0 to n_clusters - 1."""
        return np.unique(self.cluster_ids, return_inverse=True)[1].astype(np.int64)

    @cached_property
    def centres(self) -> Array:
        """Mean of each cluster's flowers (c, 3), map, m."""
        count = np.bincount(self.cluster, minlength=self.n_clusters)
        sums = np.stack([np.bincount(self.cluster, x, self.n_clusters) for x in self.positions.T], axis=1)
        return np.asarray(sums / count[:, None])

    def in_first_frame(self, cov: Array, T_map_camera: Array) -> Array:
        """A pose's covariance (6, 6) in this map as it is in the frame of the map's first session."""
        J = adjoint(inverse(T_map_camera))
        return np.asarray(cov + J @ self.frame_cov @ J.T)

    @property
    def n_clusters(self) -> int:
        return len(self.shared_covs)

    def drifted(self, sway_m: float) -> BoolArray:
        """Which clusters (c,) may stand off their places by more than they sway."""
        return np.asarray(np.trace(self.shared_covs, axis1=1, axis2=2) > 3.0 * sway_m**2)

    @cached_property
    def spread(self) -> float:
        """Standard deviation an axis of a flower about its cluster's centroid, m; 0 where all clusters are single."""
        count = np.bincount(self.cluster, minlength=self.n_clusters)
        off = self.positions - self.centres[self.cluster]
        free = 3.0 * float((count - 1).sum())
        return float(np.sqrt((off**2).sum() / free)) if free else 0.0


def landmarks(
    positions: Array,
    cluster_ids: IntArray,
    *,
    flower_ids: IntArray | None = None,
    covs: Array | None = None,
    shared_covs: Array | None = None,
    plant: str = "plant",
) -> Landmarks:
    """Landmarks from positions (f, 3) and what else is known, checked.

    Raises
    ------
    InputError
        No landmark, a value that is not finite, or an id given twice.
    """
    positions = np.asarray(positions, dtype=np.float64).reshape(-1, 3)
    n = len(positions)
    if n == 0:
        raise InputError(f"the map of plant {plant!r} is empty, expected flowers to localise by")
    ids = np.arange(n, dtype=np.int64) if flower_ids is None else np.asarray(flower_ids, dtype=np.int64)
    cluster_ids = np.asarray(cluster_ids, dtype=np.int64)
    n_clusters = len(np.unique(cluster_ids))
    if not np.isfinite(positions).all():
        raise InputError(f"the map of plant {plant!r} holds a position that is not finite")
    if len(np.unique(ids)) != n:
        raise InputError(f"the map of plant {plant!r} holds a flower id twice")
    floor = LEAST_SIGMA_M**2 * np.eye(3)
    own = np.zeros((n, 3, 3)) if covs is None else np.asarray(covs, dtype=np.float64)
    shared = np.zeros((n_clusters, 3, 3)) if shared_covs is None else np.asarray(shared_covs, dtype=np.float64)
    return Landmarks(plant, ids, cluster_ids, positions, own + floor, shared + floor)


def landmarks_at(plant: PlantMap, time: float) -> Landmarks:
    """The flowers of a plant of the map as they should stand at a time (s; NaN: as the map holds them).

    Flowers that are gone for sure are left out.

    Raises
    ------
    InputError
        The plant has no flowers.
    """
    then = growth.at(plant, time)
    there = then.flower_presence >= _GONE_BELOW
    if not there.any():
        raise InputError(f"the map of plant {plant.name!r} is empty, expected flowers to localise by")
    clusters = np.unique(then.flower_cluster_ids[there])
    marks = landmarks(
        then.flowers[there],
        then.flower_cluster_ids[there],
        flower_ids=then.flower_ids[there],
        covs=then.flower_covs[there],
        shared_covs=then.cluster_covs[np.searchsorted(then.cluster_ids, clusters)],
        plant=plant.name,
    )
    return replace(marks, frame_cov=_common_drift(marks, then, time))


def _common_drift(marks: Landmarks, plant: PlantMap, time: float) -> Array:
    """Covariance (6, 6) of how far all clusters have drifted as one since the map's first session.

    Later sessions were aligned with where clusters were expected, so what these drifted in common stayed unseen, and
    their learned velocities lack it. It is that of the layout, were each cluster free to drift so far by itself.
    """
    seconds = time - np.nanmin(plant.cluster_first_seen) if np.isfinite(plant.cluster_first_seen).any() else 0.0
    var = growth.drifted(plant, seconds, GrowthConfig().memory_days)
    unseen = var - float(np.median(np.trace(marks.shared_covs, axis1=1, axis2=2))) / 3.0
    if unseen <= 0.0 or marks.n_clusters < 3:
        return np.zeros((6, 6))
    J = np.concatenate([-skew(marks.centres), np.broadcast_to(np.eye(3), (marks.n_clusters, 3, 3))], axis=-1)
    information = np.einsum("cia,cib->ab", J, J) / unseen
    least = 1e-6 * float(np.trace(information)) * np.eye(6)  # clusters in a line do not turn about it
    return np.asarray(np.linalg.solve(information + least, np.eye(6)))
