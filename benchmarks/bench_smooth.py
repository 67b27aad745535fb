"""Estimation alone (no import, reading, report) against GTSAM that was told the true association.

The reference builds the graph of the same session in GTSAM's own factors and solves it: camera poses with their priors,
flowers, one factor a detection. It is spared the hand-eye transform, the sway and every decision.
"""

from __future__ import annotations

from time import process_time

import gtsam
import numpy as np
from figure import Figure
from numpy.typing import NDArray

from cluster_slam import smooth
from cluster_slam.geometry import transform
from cluster_slam.simulate import PRESETS, Simulated, simulate_session

GOAL_S = {"moderate": 15.0, "hard": 120.0}
GOAL_RATIO = 20.0
SEED = 1
FOCAL, BASELINE = 400.0, 0.05  # px, m: of the virtual stereo camera; they cancel


def measure(quick: bool) -> list[Figure]:
    """Seconds of both and their ratio; ``quick``: the moderate session alone."""
    figures: list[Figure] = []
    for preset in ("moderate",) if quick else ("moderate", "hard"):
        made = simulate_session(PRESETS[preset], seed=SEED)
        told = min(_seconds_of_gtsam(made) for _ in range(3))
        begin = process_time()
        smooth(made.session)
        found = process_time() - begin
        figures += [
            Figure(f"{preset}, {len(made.session.observations)} detections: estimation", found, "s", GOAL_S[preset]),
            Figure(f"{preset}: GTSAM, told the association", told, "s"),
            Figure(f"{preset}: ratio", found / told, "times", GOAL_RATIO),
        ]
    return figures


def _seconds_of_gtsam(made: Simulated) -> float:
    begin = process_time()
    graph, values = build(made)
    solved = gtsam.GaussNewtonOptimizer(graph, values).optimize()
    seconds = process_time() - begin
    if not np.isfinite(graph.error(solved)):
        raise RuntimeError("the reference did not converge")
    return seconds


def build(made: Simulated) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """The graph with the true association, and where to start: poses as given with the true hand-eye transform."""
    session, noise, ids = made.session, made.session.noise, made.truth.flower_ids
    assert ids is not None
    T = session.poses @ made.hand_eye.true
    observations = session.observations
    used = np.flatnonzero(ids >= 0)
    frame, flower = observations.frame[used], ids[used]
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    sigmas = np.repeat([noise.pose_rotation, noise.pose_translation], 3)
    prior = gtsam.noiseModel.Diagonal.Sigmas(sigmas)
    for k, pose in enumerate(map(gtsam.Pose3, T)):
        graph.add(gtsam.PriorFactorPose3(k, pose, prior))
        values.insert(k, pose)
    world = transform(T[frame], observations.points[used])
    for j in np.unique(flower):
        values.insert(len(T) + int(j), world[flower == j].mean(axis=0))
    _add_detections(graph, observations.points[used], observations.covs[used], frame, len(T) + flower)
    return graph, values


def _add_detections(
    graph: gtsam.NonlinearFactorGraph,
    points: NDArray[np.float64],
    covs: NDArray[np.float64],
    pose_keys: NDArray[np.int64],
    point_keys: NDArray[np.int64],
) -> None:
    """A point (x, y, z) as a stereo camera would see it, with the covariance J S J' to first order."""
    x, y, z = points.T
    fb = FOCAL * BASELINE
    J = np.zeros((len(points), 3, 3))
    J[:, 0, 0] = J[:, 1, 0] = J[:, 2, 1] = FOCAL / z
    J[:, 0, 2], J[:, 1, 2], J[:, 2, 2] = -FOCAL * x / z**2, (fb - FOCAL * x) / z**2, -FOCAL * y / z**2
    S = J @ covs @ np.swapaxes(J, 1, 2)
    left, right, row = FOCAL * x / z, (FOCAL * x - fb) / z, FOCAL * y / z
    K = gtsam.Cal3_S2Stereo(FOCAL, FOCAL, 0.0, 0.0, 0.0, BASELINE)
    factor, stereo, gaussian = gtsam.GenericStereoFactor3D, gtsam.StereoPoint2, gtsam.noiseModel.Gaussian.Covariance
    seen = zip(left.tolist(), right.tolist(), row.tolist(), S, pose_keys.tolist(), point_keys.tolist(), strict=True)
    for u, v, w, cov, pose, point in seen:
        graph.add(factor(stereo(u, v, w), gaussian(cov), pose, point, K))
