"""A few frames in a row from a moving camera on an arm, with everything that makes them hard, and their truth."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from localisation_trials import FOCAL_PX, HALF_HEIGHT_PX, HALF_WIDTH_PX, Trial, _in_view, _somewhere

from cluster_slam.geometry import Array, inverse, se3_exp, transform
from cluster_slam.records import IntArray, Observations, Session, StatedNoise
from cluster_slam.simulate.plant import Plant

N_FRAMES, SECONDS, SWAY_TIME_S = 10, 2.0, 0.3
POSE_SIGMA = np.repeat([0.002, 0.001], 3)


@dataclass(frozen=True, slots=True, eq=False)
class Window:
    """A short session, and where its camera truly was in the map."""

    session: Session
    T_map_camera: Array  # (10, 4, 4)
    flowers: IntArray  # of each observation, -1 clutter


def window(plant: Plant, trial: Trial, *, rng: np.random.Generator, n_least: bool = False) -> Window:
    """Ten frames over two seconds in which the camera moves 10 to 20 cm.

    Just so many clusters are in view in the middle frame; with ``n_least`` so many or more, as the view has them.
    """
    while True:
        middle = _somewhere(plant, rng)
        chosen = _clusters(plant, middle, trial.n_clusters, n_least, rng)
        if chosen is not None:
            return _recorded(plant, chosen, _path(middle, rng), trial, rng)


def _path(middle: Array, rng: np.random.Generator) -> Array:
    direction = rng.normal(size=3) * [1.0, 1.0, 0.4]
    direction *= rng.uniform(0.1, 0.2) / np.linalg.norm(direction)
    ahead = rng.uniform(0.4, 0.7)  # the camera goes on looking at one place
    turn = np.array([direction[1], -direction[0], rng.normal(0.0, 0.1) * ahead]) / ahead
    along = np.linspace(-0.5, 0.5, N_FRAMES)[:, None]
    return np.asarray(middle @ se3_exp(along * np.concatenate([turn, direction])))


def _clusters(plant: Plant, T: Array, n: int, n_least: bool, rng: np.random.Generator) -> IntArray | None:
    visible = _in_view(transform(inverse(T), plant.flowers))
    count = np.bincount(plant.flower_cluster[visible], minlength=len(plant.centroids))
    clusters = np.flatnonzero(count > 1)
    if len(clusters) < n:
        return None
    return np.unique(plant.flower_cluster[visible]) if n_least else rng.choice(clusters, n, replace=False)


def _recorded(plant: Plant, clusters: IntArray, T: Array, trial: Trial, rng: np.random.Generator) -> Window:
    sigma = rng.uniform(0.001, 0.003) if trial.sigma_m is None else trial.sigma_m
    keep = np.exp(-SECONDS / (N_FRAMES - 1) / SWAY_TIME_S)
    usual = trial.sway_m / np.sqrt(3.0)
    sway = rng.normal(0.0, usual, plant.centroids.shape)
    there = np.isin(plant.flower_cluster, clusters)
    frame, points, flowers = [], [], []
    for k in range(N_FRAMES):
        seen = transform(inverse(T[k]), plant.flowers + sway[plant.flower_cluster])
        rows = np.flatnonzero(there & _in_view(seen) & (rng.random(len(seen)) >= trial.miss_rate))
        false = _clutter(rng.poisson(trial.clutter), rng)
        points += [seen[rows] + rng.normal(0.0, sigma, (len(rows), 3)), false]
        flowers += [rows, np.full(len(false), -1)]
        frame += [k] * (len(rows) + len(false))
        sway = keep * sway + np.sqrt(1.0 - keep**2) * rng.normal(0.0, usual, sway.shape)
    m = len(frame)
    covs = np.tile((trial.stated * sigma) ** 2 * np.eye(3), (m, 1, 1))
    seen_all = Observations(np.array(frame), np.concatenate(points), covs, np.full(m, np.nan))
    elsewhere = se3_exp(rng.normal(size=6))
    given = elsewhere @ T @ se3_exp(rng.normal(size=(N_FRAMES, 6)) * POSE_SIGMA)
    stamps = 1000.0 + np.linspace(0.0, SECONDS, N_FRAMES)
    noise = replace(StatedNoise(), pose_translation=0.001, pose_rotation=0.002)
    session = Session("window", stamps, given, "T_world_camera", "absolute", None, noise, seen_all)
    return Window(session, T, np.concatenate(flowers))


def _clutter(n: int, rng: np.random.Generator) -> Array:
    depth = rng.uniform(0.3, 0.9, n)
    width, height = 0.9 * HALF_WIDTH_PX / FOCAL_PX, 0.9 * HALF_HEIGHT_PX / FOCAL_PX
    return np.column_stack([rng.uniform(-width, width, n) * depth, rng.uniform(-height, height, n) * depth, depth])
