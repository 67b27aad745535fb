"""Rows of the map's tables as a :class:`PlantMap`, and back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import PlantMap, Sightings

_UPPER = np.triu_indices(3)
_FULL = [[0, 1, 2], [1, 3, 4], [2, 4, 5]]
N_CLUSTER_COLUMNS = 39
N_FLOWER_COLUMNS = 15
Row = tuple[Any, ...]


def plant_from_rows(
    plant: Row, clusters: Sequence[Row], flowers: Sequence[Row], last: float | None, sightings: Sightings | None
) -> PlantMap:
    """A plant of its row in ``plants`` and its rows in ``clusters`` and ``flowers``, in the order of the schema."""
    c = _numbers(clusters, N_CLUSTER_COLUMNS)
    f = _numbers(flowers, N_FLOWER_COLUMNS)
    viewpoint = None if plant[2] is None else np.array(plant[2:5], dtype=float)
    return PlantMap(
        name=plant[1],
        cluster_ids=c[:, 0].astype(np.int64),
        clusters=c[:, 2:5],
        cluster_covs=c[:, 5:11][:, _FULL],
        cluster_time=c[:, 11],
        velocities=c[:, 12:15],
        velocity_covs=c[:, 15:21][:, _FULL],
        position_velocity_covs=c[:, 21:27][:, _FULL],
        growth_rates=c[:, 27],
        growth_vars=c[:, 28],
        n_flowers=c[:, 29].astype(np.int64),
        descriptors=c[:, 30:32],
        descriptor_covs=c[:, 32:35][:, [[0, 1], [1, 2]]],
        cluster_first_seen=c[:, 35],
        cluster_last_seen=c[:, 36],
        cluster_last_looked_at=c[:, 37],
        cluster_presence=c[:, 38],
        flower_ids=f[:, 0].astype(np.int64),
        flower_cluster_ids=f[:, 1].astype(np.int64),
        flowers=f[:, 2:5],
        flower_covs=f[:, 5:11][:, _FULL],
        flower_first_seen=f[:, 11],
        flower_last_seen=f[:, 12],
        flower_last_looked_at=f[:, 13],
        flower_presence=f[:, 14],
        viewpoint=viewpoint,
        last_session=float("nan") if last is None else last,
        drift_rate=plant[5],
        walk_rate=plant[6],
        sightings=sightings,
    )


def sightings_from_rows(sessions: Sequence[Row], seen: Sequence[Row]) -> Sightings:
    """Sightings of ``id, time`` of a plant's sessions and ``flower, session`` of each, both in the order of time."""
    ids = np.array([row[0] for row in sessions], dtype=np.int64)
    pairs = np.array(seen, dtype=np.int64).reshape(-1, 2)
    times = np.array([row[1] for row in sessions], dtype=float)
    return Sightings(pairs[:, 0], np.searchsorted(ids, pairs[:, 1]).astype(np.int64), times)


def cluster_rows(plant: PlantMap, plant_id: int) -> list[Row]:
    """Rows of ``clusters``."""
    upper = _upper
    values = np.column_stack(
        [
            *(plant.clusters, upper(plant.cluster_covs), plant.cluster_time, plant.velocities),
            *(upper(plant.velocity_covs), upper(plant.position_velocity_covs), plant.growth_rates, plant.growth_vars),
            *(plant.n_flowers, plant.descriptors, plant.descriptor_covs[:, [0, 0, 1], [0, 1, 1]]),
            *(plant.cluster_first_seen, plant.cluster_last_seen, plant.cluster_last_looked_at, plant.cluster_presence),
        ]
    )
    return [(i, plant_id, *_plain(row)) for i, row in zip(plant.cluster_ids.tolist(), values.tolist(), strict=True)]


def flower_rows(plant: PlantMap) -> list[Row]:
    """Rows of ``flowers``."""
    seen = (plant.flower_first_seen, plant.flower_last_seen, plant.flower_last_looked_at, plant.flower_presence)
    values = np.column_stack([plant.flowers, _upper(plant.flower_covs), *seen])
    ids = zip(plant.flower_ids.tolist(), plant.flower_cluster_ids.tolist(), strict=True)
    return [(*pair, *_plain(row)) for pair, row in zip(ids, values.tolist(), strict=True)]


def _numbers(rows: Sequence[Row], width: int) -> Array:
    """Rows as numbers (n, width), NULL as NaN."""
    return np.array(rows, dtype=float).reshape(-1, width)  # None becomes NaN


def _plain(row: list[float]) -> list[float | None]:
    return [None if v != v else v for v in row]


def _upper(covs: Array) -> Array:
    return covs[:, _UPPER[0], _UPPER[1]]
