"""Frames without a point are taken out where poses drift, and their poses put back."""

from __future__ import annotations

import numpy as np

from cluster_slam.association.frames import Frames, sort_by_frame
from cluster_slam.association.seen_frames import filled, only_seen, seen_frames, step_of_each, summed_steps
from cluster_slam.geometry import Array, inverse, se3_exp, se3_log
from cluster_slam.records import Observations


def _session() -> tuple[Frames, Array]:
    """Nine frames, of which 2, 5 and 6 hold points; poses (9, 4, 4)."""
    frame = np.array([5, 2, 6, 5])
    points = np.arange(12.0).reshape(4, 3)
    observations = Observations(frame, points, np.tile(np.eye(3), (4, 1, 1)), np.full(4, np.nan))
    T = se3_exp(np.cumsum(np.tile([0.02, 0.1, 0.0, 0.1, 0.0, 0.4], (9, 1)), axis=0))
    return sort_by_frame(observations, np.arange(9.0)), T


def test_the_session_of_the_frames_with_points() -> None:
    frames, _ = _session()
    kept = seen_frames(frames)
    np.testing.assert_array_equal(kept, [2, 5, 6])
    seen = only_seen(frames, kept)
    np.testing.assert_array_equal(seen.starts, [0, 1, 3, 4])
    np.testing.assert_array_equal(seen.frame, [0, 1, 1, 2])
    np.testing.assert_array_equal(seen.stamps, [2.0, 5.0, 6.0])
    np.testing.assert_array_equal(seen.points, frames.points)


def test_covariances_of_summed_steps_are_those_of_drawn_ones() -> None:
    _, T = _session()
    sigma = 1e-3 * np.array([1.0, 2.0, 1.0, 3.0, 1.0, 2.0])
    rng = np.random.default_rng(0)
    cov = summed_steps(T, np.tile(np.diag(sigma**2), (8, 1, 1)), np.array([2, 5, 6]))
    drawn = np.tile(np.eye(4), (40_000, 1, 1))
    for k in range(2, 5):
        drawn = drawn @ (inverse(T[k]) @ T[k + 1]) @ se3_exp(sigma * rng.standard_normal((len(drawn), 6)))
    error = se3_log(inverse(inverse(T[2]) @ T[5]) @ drawn)
    np.testing.assert_allclose(cov[0], np.cov(error.T), atol=0.03 * cov[0].max())
    np.testing.assert_allclose(cov[1], np.diag(sigma**2), atol=1e-15)


def test_poses_between_share_what_odometry_errs() -> None:
    _, T = _session()
    kept = np.array([2, 5, 6])
    np.testing.assert_allclose(filled(T[kept], kept, T), T, atol=1e-12)
    moved = T[kept].copy()
    moved[1] = moved[1] @ se3_exp(np.array([0, 0.03, 0, 0.3, 0, 0]))
    moved[2] = moved[1] @ inverse(T[5]) @ T[6]
    out = filled(moved, kept, T)
    np.testing.assert_allclose(out[kept], moved, atol=1e-12)
    np.testing.assert_allclose(out[:2], T[:2], atol=1e-12)
    np.testing.assert_allclose(inverse(out[6]) @ out[8], inverse(T[6]) @ T[8], atol=1e-12)
    error = se3_log(inverse(T) @ out)
    np.testing.assert_allclose(error[3], [0, 0.01, 0, 0.1, 0, 0], atol=1e-12)


def test_values_of_summed_steps_hold_for_each_step_in_them() -> None:
    np.testing.assert_array_equal(step_of_each(np.array([3.0, 4.0]), np.array([2, 5, 6]), 8), [1, 1, 3, 3, 3, 4, 1, 1])
