"""Where a plant's clusters will be on a date, with ellipsoids that hold the truth as often as they claim."""

from __future__ import annotations

import numpy as np

from cluster_slam.config import MapConfig
from cluster_slam.constellation.growth import DAY_S, at, gaps
from cluster_slam.geometry import Array
from cluster_slam.io.map.export import cluster_position_covs
from cluster_slam.records import PlantMap


def predict_plant(plant: PlantMap, time: float, config: MapConfig) -> tuple[PlantMap, Array]:
    """The plant at a time, and the covariances (c, 3, 3) of the centroids of the flowers that will be there.

    A centroid also moves because flowers are lost and new ones open: with the share u of its flowers that change, each
    at the spread of the cluster, it moves by sqrt(u / n) of that spread.
    """
    moved = at(plant, time, config.growth)
    covs = cluster_position_covs(moved)
    row = moved.flower_rows
    days = np.abs(gaps(plant, time)) / DAY_S
    changing = np.minimum((config.growth.lost_per_day + config.growth.new_per_day) * days, 1.0)
    for c in range(len(covs)):
        members = np.flatnonzero((row == c) & (plant.flower_presence > 0.5))
        if len(members) < 2:
            continue
        offsets = moved.flowers[members] - moved.flowers[members].mean(axis=0)
        spread = float((offsets**2).sum() / (3 * (len(members) - 1)))
        covs[c] = covs[c] + changing[c] * spread / len(members) * np.eye(3)
    return moved, covs
