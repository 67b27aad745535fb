"""Sway as stretches of displacements that err alike."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_slam.geometry import Array
from cluster_slam.smoothing.stretches import quarter_period, rest_sigma, stretches

STAMPS = np.arange(900) / 30.0
NOISE_M = 0.001


def measured(values: Array, *, rng: np.random.Generator) -> tuple[Array, Array, Array, Array]:
    """Displacements of clusters (n, c, 3) with noise, as (p, 3), their covariances, frames and clusters."""
    n, c = values.shape[:2]
    frame, cluster = np.repeat(np.arange(n), c), np.tile(np.arange(c), n)
    d = values.reshape(-1, 3) + NOISE_M * rng.standard_normal((n * c, 3))
    return d, np.tile(NOISE_M**2 * np.eye(3), (n * c, 1, 1)), frame, cluster


def slow_noise(sigma: float, keep: float, n_clusters: int, *, rng: np.random.Generator) -> Array:
    """A first-order Markov process of that sigma along every axis (n, c, 3)."""
    x = np.zeros((len(STAMPS), n_clusters, 3))
    x[0] = sigma * rng.standard_normal((n_clusters, 3))
    for i in range(1, len(x)):
        x[i] = keep * x[i - 1] + sigma * np.sqrt(1 - keep**2) * rng.standard_normal((n_clusters, 3))
    return x


def test_motion_at_rest_is_found_below_the_noise() -> None:
    rng = np.random.default_rng(1)
    d, cov, frame, cluster = measured(slow_noise(0.0004, 0.98, 12, rng=rng), rng=rng)
    found = rest_sigma(d, cov, np.zeros(len(d)), frame, cluster, STAMPS)
    assert found == pytest.approx(0.0004, rel=0.15)


def test_what_all_clusters_do_is_the_cameras_error() -> None:
    rng = np.random.default_rng(5)
    common = slow_noise(0.002, 0.98, 1, rng=rng)
    d, cov, frame, cluster = measured(common + slow_noise(0.0004, 0.98, 12, rng=rng), rng=rng)
    assert rest_sigma(d, cov, np.zeros(len(d)), frame, cluster, STAMPS) == pytest.approx(0.0004, rel=0.2)


def test_what_stands_still_is_all_but_still() -> None:
    rng = np.random.default_rng(2)
    d, cov, frame, cluster = measured(np.zeros((len(STAMPS), 12, 3)), rng=rng)
    assert rest_sigma(d, cov, np.zeros(len(d)), frame, cluster, STAMPS) < 0.15 * NOISE_M


@pytest.mark.parametrize("hz", [0.5, 1.0, 3.0])
def test_quarter_period_of_a_sine(hz: float) -> None:
    rng = np.random.default_rng(3)
    sine = 0.02 * np.sin(2 * np.pi * hz * STAMPS[:, None, None] + rng.uniform(0, 6, (1, 5, 3)))
    d, _, frame, cluster = measured(np.broadcast_to(sine, (len(STAMPS), 5, 3)), rng=rng)
    found = quarter_period(d, np.full(len(d), 0.02), frame, cluster, STAMPS)
    assert found == pytest.approx(0.25 / hz, abs=0.04, rel=0.3)


def test_a_glimpse_of_a_swing_knows_how_wide_it_is() -> None:
    """Fifteen frames of a swing of 3 cm at 1 Hz, seen about their own mean: the speed gives the width away."""
    rng = np.random.default_rng(4)
    sine = np.zeros((15, 1, 3))
    sine[:, 0, 0] = 0.03 * np.sin(2 * np.pi * (STAMPS[:15] + 0.6))
    d, cov, frame, cluster = measured(sine - sine.mean(axis=0), rng=rng)
    sigma = np.full(len(d), float(np.sqrt((d**2).sum(axis=1).mean() / 3)))
    stretch, stretch_sigma, within = stretches(d, cov, sigma, frame, cluster, STAMPS[:15], 0.25)
    np.testing.assert_array_equal(stretch, [0] * 8 + [1] * 7)
    # Along any axis the rms of the whole swing is 30 mm / sqrt(3) at its turning point, a sine's mean square is half.
    assert max(0.006, 0.9 * sigma[0]) <= stretch_sigma.min() <= stretch_sigma.max() < 0.025
    np.testing.assert_allclose(within, 0.5 * stretch_sigma[stretch])


def test_stretches_never_join_clusters() -> None:
    frame, cluster = np.repeat(np.arange(60), 2), np.tile([0, 1], 60)
    d, cov = np.zeros((120, 3)), np.tile(np.eye(3), (120, 1, 1))
    stretch, stretch_sigma, _ = stretches(d, cov, np.ones(120), frame, cluster, STAMPS[:60], 0.5)
    assert len(stretch_sigma) == 8
    assert all(len(np.unique(cluster[stretch == s])) == 1 for s in range(8))
