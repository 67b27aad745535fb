"""The tables of a plant: empty, with what a session brought, and summarised by cluster."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from cluster_slam.config import GrowthConfig
from cluster_slam.constellation.growth import DAY_S
from cluster_slam.constellation.identify import Identities
from cluster_slam.geometry import Array, rotate_cov, transform
from cluster_slam.records import Constellation, IntArray, PlantMap
from tracking.presence import any_present

CLUSTER = (
    *("cluster_ids", "clusters", "cluster_covs", "cluster_time", "velocities", "velocity_covs"),
    *("position_velocity_covs", "growth_rates", "growth_vars", "n_flowers", "descriptors", "descriptor_covs"),
    *("cluster_first_seen", "cluster_last_seen", "cluster_last_looked_at", "cluster_presence"),
)
FLOWER = (
    *("flower_ids", "flower_cluster_ids", "flowers", "flower_covs", "flower_first_seen", "flower_last_seen"),
    *("flower_last_looked_at", "flower_presence"),
)


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """A session's flowers in the map, and the transform that took them there."""

    T_map_world: Array  # (4, 4)
    scale: float
    flowers: Array  # (f, 3) map
    covs: Array  # (f, 3, 3)


def aligned(session: Constellation, T_map_world: Array, scale: float) -> Aligned:
    """The session's flowers moved into the map."""
    R = T_map_world[:3, :3]
    covs = scale**2 * rotate_cov(R, session.flower_covs)
    return Aligned(T_map_world, scale, transform(T_map_world, scale * session.flowers), covs)


def empty_plant(name: str, config: GrowthConfig) -> PlantMap:
    """A plant that nobody has seen yet."""
    none = {n: np.zeros((0, 3)) for n in ("clusters", "velocities", "flowers")}
    none |= {n: np.zeros((0, 3, 3)) for n in CLUSTER + FLOWER if n.endswith("_covs")}
    none |= {"descriptors": np.zeros((0, 2)), "descriptor_covs": np.zeros((0, 2, 2))}
    ids = {n: np.zeros(0, dtype=np.int64) for n in (*CLUSTER, *FLOWER) if n.endswith("_ids") or n == "n_flowers"}
    rest = {n: np.zeros(0) for n in (*CLUSTER, *FLOWER) if n not in none and n not in ids}
    values: dict[str, Any] = {**none, **ids, **rest}
    return PlantMap(name=name, drift_rate=config.drift_m_per_day, walk_rate=config.walk_m_per_sqrt_day, **values)


def with_new(
    plant: PlantMap,
    session: Constellation,
    where: Aligned,
    who: Identities,
    growth: GrowthConfig,
    now: float,
    next_cluster: int,
    next_flower: int,
) -> tuple[PlantMap, IntArray, IntArray]:
    """The plant with clusters and flowers that it did not have, and the map's ids of the session's."""
    row = np.searchsorted(session.cluster_ids, session.flower_cluster_ids)
    fresh = np.flatnonzero(who.cluster < 0)
    cluster_ids = np.where(who.cluster >= 0, 0, -1).astype(np.int64)
    cluster_ids[who.cluster >= 0] = plant.cluster_ids[who.cluster[who.cluster >= 0]]
    cluster_ids[fresh] = next_cluster + np.arange(len(fresh))
    new = np.flatnonzero(who.flower < 0)
    flower_ids = np.full(len(who.flower), -1, dtype=np.int64)
    flower_ids[who.flower >= 0] = plant.flower_ids[who.flower[who.flower >= 0]]
    flower_ids[new] = next_flower + np.arange(len(new))
    n, k, eye = len(fresh), len(new), np.eye(3)
    rate_var = (plant.drift_rate / DAY_S) ** 2 / 3.0
    total = np.zeros((len(cluster_ids), 3))
    np.add.at(total, row, where.flowers)
    centroids = total / np.maximum(np.bincount(row, minlength=len(total)), 1)[:, None]
    more = {
        "cluster_ids": cluster_ids[fresh],
        "clusters": centroids[fresh],
        "cluster_covs": np.tile(1e-8 * eye, (n, 1, 1)),
        "velocities": np.zeros((n, 3)),
        "velocity_covs": np.tile(rate_var * eye, (n, 1, 1)),
        "position_velocity_covs": np.zeros((n, 3, 3)),
        "growth_rates": np.full(n, growth.size_per_day / DAY_S),
        "growth_vars": np.full(n, (growth.size_sigma_per_day / DAY_S) ** 2),
        "n_flowers": np.ones(n, dtype=np.int64),
        "descriptors": session.descriptors[fresh],
        "descriptor_covs": session.descriptor_covs[fresh],
        "flower_ids": flower_ids[new],
        "flower_cluster_ids": cluster_ids[row[new]],
        "flowers": where.flowers[new],
        "flower_covs": where.covs[new],
    }
    for name in (*CLUSTER, *FLOWER):
        if name not in more:
            size = n if name.startswith("cluster") else k
            more[name] = np.ones(size) if name.endswith("presence") else np.full(size, now)
    joined: dict[str, Any] = {name: np.concatenate([getattr(plant, name), more[name]]) for name in (*CLUSTER, *FLOWER)}
    return replace(plant, last_session=np.fmax(plant.last_session, session.end), **joined), cluster_ids, flower_ids


def summarised(plant: PlantMap) -> PlantMap:
    """The plant with each cluster's centroid, count, descriptor and presence from its flowers."""
    from cluster_slam.descriptors import inertia_and_mean_distance

    clusters, counts, presence = plant.clusters.copy(), plant.n_flowers.copy(), plant.cluster_presence.copy()
    descriptors = plant.descriptors.copy()
    row = plant.flower_rows
    for c in range(len(clusters)):
        members = np.flatnonzero(row == c)
        alive = members[plant.flower_presence[members] > 0.5]
        counts[c] = len(alive)
        presence[c] = any_present(plant.flower_presence[members]) if len(members) else 0.0
        used = alive if len(alive) else members
        if len(used):
            clusters[c] = plant.flowers[used].mean(axis=0)
        if len(alive) >= 2:
            descriptors[c] = inertia_and_mean_distance(plant.flowers[alive])
    return replace(plant, clusters=clusters, n_flowers=counts, cluster_presence=presence, descriptors=descriptors)
