"""Arms whose errors change slowly: how sure the hand-eye transform is said to be."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
from oracle import smooth_with_truth

from cluster_slam.evaluation.trajectory import hand_eye_truth
from cluster_slam.geometry import Array, inverse, se3_exp, se3_log
from cluster_slam.simulate import PRESETS, Simulated, simulate_session


@cache
def made() -> Simulated:
    return simulate_session(replace(PRESETS["sample"], duration_s=20.0), seed=8)


def hand_eye(keep: float, seed: int) -> tuple[float, float]:
    """NEES over its dimension, and mean variance, where errors of poses are a first-order Markov process."""
    session, truth = made().session, made().truth
    true = hand_eye_truth(session, truth)
    assert true is not None
    assert truth.T_world_camera is not None
    rng, n = np.random.default_rng(seed), len(session.stamps)
    xi: Array = rng.normal(size=(n, 6))
    for i in range(1, n):
        xi[i] = keep * xi[i - 1] + np.sqrt(1.0 - keep**2) * xi[i]
    xi *= np.repeat([session.noise.pose_rotation, session.noise.pose_translation], 3)
    poses = truth.T_world_camera @ inverse(true.T_flange_camera) @ se3_exp(xi)
    found = smooth_with_truth(replace(session, poses=poses), truth).calibration
    assert found is not None
    error = se3_log(inverse(true.T_flange_camera) @ found.T_flange_camera)
    return float(error @ np.linalg.solve(found.cov, error)) / 6.0, float(np.trace(found.cov))


def test_covariances_hold_where_an_arm_errs_slowly() -> None:
    white = np.array([hand_eye(0.0, seed) for seed in range(6)])
    slow = np.array([hand_eye(0.9, seed) for seed in range(6)])
    assert 0.4 < white[:, 0].mean() < 1.6
    assert 0.4 < slow[:, 0].mean() < 1.6
    assert slow[:, 1].mean() > 2.0 * white[:, 1].mean()
