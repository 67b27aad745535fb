"""Where a plant's clusters and flowers are at another time, and how sure that is."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_slam.config import GrowthConfig
from cluster_slam.geometry import Array
from cluster_slam.records import PlantMap

DAY_S = 86400.0
UNSTEADY = (0.01, 10.0)  # variance of a plant's walk, and how soon its drift turns, over what was expected: limits


def at(plant: PlantMap, time: float, config: GrowthConfig | None = None) -> PlantMap:
    """The plant as it should be at another time: drifted, grown, with covariances that have grown too.

    The gap is counted for each cluster by itself, since the time that its state is of. Where either time is unknown
    (NaN) no time has passed.

    Parameters
    ----------
    plant
        As the map holds it.
    time
        s; before the state's time too (the drift is undone, the uncertainty grows all the same).

    Returns
    -------
    PlantMap
        With ``cluster_time`` at ``time``. ``cluster_covs`` are (P + (C + C') dt + V dt^2 + walk^2 |dt| + setting^2),
        of what all flowers of a cluster share; ``flower_covs`` of each flower's place in its cluster.
    """
    config = config or GrowthConfig()
    dt = gaps(plant, time)
    days = np.abs(dt) / DAY_S
    passed = dt != 0.0
    memory = memory_days(plant, config) * DAY_S
    kept = np.exp(-np.abs(dt) / memory)  # of the velocity
    path = np.sign(dt) * memory * (1.0 - kept)  # s: how far today's velocity leads
    prior = (plant.drift_rate / DAY_S) ** 2 / 3.0
    spread = prior * _wander(np.abs(dt), memory)
    cross = plant.position_velocity_covs + np.swapaxes(plant.position_velocity_covs, 1, 2)
    walk_sq = plant.walk_rate**2 * days + config.setting_m**2 * passed
    covs = plant.cluster_covs + cross * path[:, None, None] + plant.velocity_covs * (path**2)[:, None, None]
    covs = covs + (walk_sq + spread)[:, None, None] * np.eye(3)
    clusters = plant.clusters + plant.velocities * path[:, None]
    row = plant.flower_rows
    size = np.exp(plant.growth_rates * dt)[row]
    offsets = plant.flowers - plant.clusters[row]
    flower_walk = config.flower_walk_m_per_sqrt_day**2 * days[row] + config.flower_setting_m**2 * passed[row]
    radial = offsets[:, :, None] * offsets[:, None, :] * (plant.growth_vars * dt**2)[row][:, None, None]
    return replace(
        plant,
        clusters=clusters,
        cluster_covs=0.5 * (covs + np.swapaxes(covs, 1, 2)),
        cluster_time=np.where(np.isnan(time), plant.cluster_time, np.full(len(dt), time)),
        velocities=plant.velocities * kept[:, None],
        velocity_covs=plant.velocity_covs * (kept**2)[:, None, None]
        + (prior * (1.0 - kept**2))[:, None, None] * np.eye(3),
        position_velocity_covs=kept[:, None, None]
        * (plant.position_velocity_covs + plant.velocity_covs * path[:, None, None])
        + (prior * np.sign(dt) * memory * (1.0 - kept) ** 2)[:, None, None] * np.eye(3),
        flowers=clusters[row] + size[:, None] * offsets,
        flower_covs=plant.flower_covs + flower_walk[:, None, None] * np.eye(3) + radial,
    )


def memory_days(plant: PlantMap, config: GrowthConfig) -> float:
    """After how long a plant's clusters drift in another direction: shorter on a plant that walks more than expected.

    A walk and a drift that turns are two names for what steady drift does not explain; a few gaps of days do not tell
    them apart. What is learned of one is taken for both.
    """
    walk = max(plant.walk_rate, 1e-12) / max(config.walk_m_per_sqrt_day, 1e-12)
    return config.memory_days / float(np.clip(walk**2, *UNSTEADY))


def unsteady(plant: PlantMap, dt: Array, config: GrowthConfig) -> Array:
    """Variance (c,) along each axis that a time (s) adds to places beside steady drift, on a plant as expected, m^2."""
    dt = np.abs(dt)
    prior = (plant.drift_rate / DAY_S) ** 2 / 3.0
    walked: Array = config.walk_m_per_sqrt_day**2 * dt / DAY_S
    return walked + prior * _wander(dt, config.memory_days * DAY_S)


def _wander(dt: Array, memory: float) -> Array:
    """Variance of the position after a time dt of an Ornstein-Uhlenbeck velocity of unit variance that began at zero.

    2 T dt - 3 T^2 + 4 T^2 e - T^2 e^2 with e = exp(-dt / T) (Gillespie 1996, eq. 2.14).
    """
    e = np.exp(-dt / memory)
    var: Array = memory * (2.0 * dt - memory * (3.0 - 4.0 * e + e * e))
    return np.maximum(var, 0.0)


def gaps(plant: PlantMap, time: float) -> Array:
    """Seconds (c,) from each cluster's state to ``time``; 0 where one of the two is unknown."""
    gap: Array = np.nan_to_num(time - plant.cluster_time, nan=0.0)
    return gap


def drifted(plant: PlantMap, seconds: float, memory_days: float) -> float:
    """Variance along each axis of a cluster's drift over a time (0 where it is not known)."""
    days = abs(float(np.nan_to_num(seconds))) / DAY_S
    steady = 2.0 * memory_days * (days + memory_days * np.expm1(-days / memory_days))  # of a velocity of variance 1
    return float(plant.drift_rate**2 / 3.0 * steady + plant.walk_rate**2 * days)
