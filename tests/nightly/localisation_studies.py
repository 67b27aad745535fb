"""Kidnapped frames and windows by the thousand: what comes of each, as rows of figures."""

from __future__ import annotations

import numpy as np
from localisation_trials import Kidnapped, Trial, kidnapped, map_of, plant_of
from localisation_windows import window

from cluster_slam.evaluation.localised import is_near
from cluster_slam.geometry import Array, inverse, se3_log
from cluster_slam.localisation import Landmarks, Localisation, Localiser
from cluster_slam.localisation.fit import solve
from cluster_slam.localisation.scene import ErrorScale, make_look
from cluster_slam.pipeline.localise import localise
from cluster_slam.records import CLUTTER

LOCATED, RIGHT, NEES, NEAR, CLUSTERS, BOUND = range(6)
_FRAMES_OF_A_PLANT = 20
_DRAWS = 100


def frames(n: int, clusters: tuple[int, ...], *, first_seed: int = 0, other_map: bool = False) -> Array:
    """Rows (n, 6): located, share of right identities, NEES (where located), within 1 cm and 1 degree, clusters in
    view, and the share of draws from the Cramer-Rao bound (true association) that lie within 1 cm and 1 degree."""
    rows = []
    for seed in range(first_seed, first_seed + n):
        if seed % _FRAMES_OF_A_PLANT == 0 or not rows:
            plant = plant_of(seed)
            marks = map_of(plant_of(seed + 10**6) if other_map else plant)
            localiser = Localiser(marks, point_sigma_m=0.002)
        trial = Trial(clusters[seed % len(clusters)])
        frame = kidnapped(plant, trial, rng=np.random.default_rng([seed, 99]))
        scale = ErrorScale(sway_m=trial.sway_m / np.sqrt(3.0))
        found = localiser.locate_points(frame.points, frame.covs, scale=scale)
        bound = np.nan if other_map else _bound(frame, marks, scale, seed)
        rows.append((*_figures(found, frame), trial.n_clusters, bound))
    return np.array(rows, dtype=float)


def _figures(found: Localisation, frame: Kidnapped) -> tuple[float, float, float, float]:
    if not found.hypotheses:
        return 0.0, 0.0, np.nan, 0.0
    known = found.flower_ids != CLUTTER
    right = float(np.mean(found.flower_ids[known] == frame.flowers[known])) if known.any() else 0.0
    xi = se3_log(inverse(found.T_map_camera) @ frame.T_map_camera)
    nees = float(xi @ np.linalg.solve(found.cov, xi)) if found.is_located else np.nan
    near = bool(is_near(found.T_map_camera[None], frame.T_map_camera[None])[0])
    return float(found.is_located), right, nees, float(near)


def _bound(frame: Kidnapped, marks: Landmarks, scale: ErrorScale, seed: int) -> float:
    """How often an estimator that knows who is who would be near, were its errors of the Cramer-Rao covariance."""
    rows = np.flatnonzero(frame.flowers >= 0)
    look = make_look(frame.points, frame.covs, scale)
    fit = solve(look, marks, frame.T_map_camera, rows, frame.flowers[rows], scale, 1)
    if not np.isfinite(fit.cov).all():
        return 0.0
    xi = np.random.default_rng([seed, 5]).multivariate_normal(np.zeros(6), fit.cov, _DRAWS)
    near = (np.linalg.norm(xi[:, 3:], axis=1) < 0.01) & (np.linalg.norm(xi[:, :3], axis=1) < np.pi / 180.0)
    return float(near.mean())


def windows(n: int, clusters: tuple[int, ...], *, first_seed: int = 0) -> Array:
    """Rows (n, 5): is the last frame of a window located, share of right identities, NEES, near, clusters in view.

    Each window is a session of its own, through the whole of ``localise``.
    """
    rows = []
    for seed in range(first_seed, first_seed + n):
        if seed % _FRAMES_OF_A_PLANT == 0 or not rows:
            plant = plant_of(seed)
            marks = map_of(plant)
        trial = Trial(clusters[seed % len(clusters)])
        made = window(plant, trial, rng=np.random.default_rng([seed, 98]))
        found = localise(made.session, [marks])
        known = found.flower_ids != CLUTTER
        right = float(np.mean(found.flower_ids[known] == made.flowers[known])) if known.any() else 0.0
        if not found.is_located[-1]:
            rows.append((0.0, right, np.nan, 0.0, trial.n_clusters))
            continue
        xi = se3_log(inverse(found.T_map_camera[-1]) @ made.T_map_camera[-1])
        nees = float(xi @ np.linalg.solve(found.covs[-1], xi))
        near = float(is_near(found.T_map_camera[-1:], made.T_map_camera[-1:])[0])
        rows.append((1.0, right, nees, near, trial.n_clusters))
    return np.array(rows, dtype=float)
