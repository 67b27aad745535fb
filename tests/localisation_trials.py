"""Kidnapped frames with everything that makes them hard, and their truth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, inverse, se3_exp, transform
from cluster_slam.localisation.landmarks import Landmarks, landmarks
from cluster_slam.records import IntArray
from cluster_slam.simulate import SimulateConfig
from cluster_slam.simulate.plant import Plant, grow_plant

FOCAL_PX, HALF_WIDTH_PX, HALF_HEIGHT_PX = 430.0, 424.0, 240.0


@dataclass(frozen=True, slots=True)
class Trial:
    """Which frames are drawn."""

    n_clusters: int  # in view
    side_by_side: bool | None = None  # None: either
    sigma_m: float | None = None  # of a point an axis; None: 1 to 3 mm
    sway_m: float = 0.002  # norm, root mean square
    miss_rate: float = 0.2
    clutter: float = 1.0  # a frame, mean
    stated: float = 1.0  # stated sigma over the true one


@dataclass(frozen=True, slots=True, eq=False)
class Kidnapped:
    """One frame, and where it was taken."""

    points: Array
    covs: Array
    flowers: IntArray  # of each point, -1 clutter
    T_map_camera: Array


def plant_of(seed: int, n_clusters: int = 20) -> Plant:
    """A plant, wide enough for its clusters."""
    config = SimulateConfig(n_clusters=n_clusters, plant_width_m=1.5 * max(1.0, n_clusters / 30))
    return grow_plant(config, rng=np.random.default_rng([seed, 1]))


def map_of(plant: Plant, name: str = "plant") -> Landmarks:
    """The plant as a perfect map has it."""
    return landmarks(plant.flowers, plant.flower_cluster, plant=name)


def kidnapped(plant: Plant, trial: Trial, *, rng: np.random.Generator) -> Kidnapped:
    """A frame that sees just so many clusters of the plant (of two flowers or more) from somewhere."""
    while True:
        T = _somewhere(plant, rng)
        sway = rng.normal(0.0, trial.sway_m / np.sqrt(3.0), plant.centroids.shape)
        points = transform(inverse(T), plant.flowers + sway[plant.flower_cluster])
        chosen = _chosen(plant, points, trial, rng)
        if chosen is None:
            continue
        seen = np.flatnonzero(chosen & (rng.random(len(points)) >= trial.miss_rate))
        if len(np.unique(plant.flower_cluster[seen])) == trial.n_clusters:
            return _measured(points, seen, T, trial, rng)


def _somewhere(plant: Plant, rng: np.random.Generator) -> Array:
    target = plant.centroids[rng.integers(len(plant.centroids))] + rng.normal(0.0, 0.05, 3)
    turn = rng.uniform([-0.5, -0.6, -0.6], [0.5, 0.6, 0.6])  # about x, y, z of a camera that looks along y
    looking = np.eye(4)
    looking[:3, :3] = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    T = looking @ se3_exp(np.concatenate([turn, np.zeros(3)]))
    T[:3, 3] = target - T[:3, 2] * rng.uniform(0.4, 0.7)
    return T


def _in_view(points: Array) -> Array:
    z = np.maximum(points[:, 2], 1e-6)
    inside = (np.abs(points[:, 0]) < HALF_WIDTH_PX / FOCAL_PX * z) & (
        np.abs(points[:, 1]) < HALF_HEIGHT_PX / FOCAL_PX * z
    )
    return inside & (points[:, 2] > 0.1) & (points[:, 2] < 1.0)


def _chosen(plant: Plant, points: Array, trial: Trial, rng: np.random.Generator) -> Array | None:
    visible = _in_view(points)
    clusters = np.unique(plant.flower_cluster[visible])
    clusters = clusters[np.bincount(plant.flower_cluster)[clusters] > 1]
    if len(clusters) < trial.n_clusters:
        return None
    side = rng.random() < 0.5 if trial.side_by_side is None else trial.side_by_side
    if side:
        centres = plant.centroids[clusters]
        away = np.linalg.norm(centres - centres[rng.integers(len(clusters))], axis=1)
        clusters = clusters[np.argsort(away)[: trial.n_clusters]]
    else:
        clusters = rng.choice(clusters, trial.n_clusters, replace=False)
    return visible & np.isin(plant.flower_cluster, clusters)


def _measured(points: Array, seen: IntArray, T: Array, trial: Trial, rng: np.random.Generator) -> Kidnapped:
    sigma = rng.uniform(0.001, 0.003) if trial.sigma_m is None else trial.sigma_m
    n = rng.poisson(trial.clutter)
    depth = rng.uniform(0.3, 0.9, n)
    false = np.column_stack([rng.uniform(-0.9, 0.9, n) * depth, rng.uniform(-0.5, 0.5, n) * depth, depth])
    near = rng.random(n) < 0.5
    false[near] = points[rng.choice(seen, near.sum())] + rng.normal(0.0, 0.04, (near.sum(), 3))
    all_points = np.vstack([points[seen] + rng.normal(0.0, sigma, (len(seen), 3)), false])
    order = rng.permutation(len(all_points))
    covs = np.tile((trial.stated * sigma) ** 2 * np.eye(3), (len(all_points), 1, 1))
    return Kidnapped(all_points[order], covs, np.concatenate([seen, np.full(n, -1)])[order], T)
