"""Sway as stretches of displacements that err alike."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cluster_slam.geometry import Array
from cluster_slam.smoothing.displaced import Displaced
from cluster_slam.smoothing.stretches import at_rest, quarter_period, stretches

STAMPS = np.arange(900) / 30.0
NOISE_M = 0.001


def measured(values: Array, scale: float = 0.0, *, rng: np.random.Generator | None = None) -> Displaced:
    """Displacements of clusters (n, c, 3), with noise, that are known to swing by ``scale``."""
    n, c = values.shape[:2]
    d = values.reshape(-1, 3) + (0.0 if rng is None else NOISE_M * rng.standard_normal((n * c, 3)))
    cov = np.tile(NOISE_M**2 * np.eye(3), (n * c, 1, 1))
    frame, cluster = np.repeat(np.arange(n), c), np.tile(np.arange(c), n)
    return Displaced(d, cov, np.ones(n * c), np.full(n * c, scale), frame, cluster, STAMPS[:n])


def slow_noise(sigma: float, keep: float, n_clusters: int, *, rng: np.random.Generator) -> Array:
    """A first-order Markov process of that sigma along every axis (n, c, 3)."""
    x = np.zeros((len(STAMPS), n_clusters, 3))
    x[0] = sigma * rng.standard_normal((n_clusters, 3))
    for i in range(1, len(x)):
        x[i] = keep * x[i - 1] + sigma * np.sqrt(1 - keep**2) * rng.standard_normal((n_clusters, 3))
    return x


def test_motion_at_rest_is_found_below_the_noise() -> None:
    rng = np.random.default_rng(1)
    sigma, lasting_s = at_rest(measured(slow_noise(0.0004, 0.9, 12, rng=rng), rng=rng))
    assert sigma == pytest.approx(0.0004, rel=0.15)
    assert lasting_s == pytest.approx((1.0 + 0.9) / (1.0 - 0.9) / 30.0, rel=0.3)  # (1 + keep) / (1 - keep) steps


def test_what_a_pose_took_is_given_back() -> None:
    """Half of the square went into the poses: what is left tells the whole."""
    rng = np.random.default_rng(6)
    moved = measured(np.sqrt(0.5) * slow_noise(0.0004, 0.9, 12, rng=rng), rng=rng)
    assert at_rest(replace(moved, share=0.5 * moved.share))[0] == pytest.approx(0.0004, rel=0.2)


def test_what_all_clusters_do_is_the_cameras_error() -> None:
    rng = np.random.default_rng(5)
    common = slow_noise(0.002, 0.9, 1, rng=rng)
    moved = measured(common + slow_noise(0.0004, 0.9, 12, rng=rng), rng=rng)
    assert at_rest(moved)[0] == pytest.approx(0.0004, rel=0.2)


def test_what_stands_still_is_all_but_still() -> None:
    rng = np.random.default_rng(2)
    assert at_rest(measured(np.zeros((len(STAMPS), 12, 3)), rng=rng))[0] < 0.15 * NOISE_M


@pytest.mark.parametrize("hz", [0.5, 1.0, 3.0])
def test_quarter_period_of_a_sine(hz: float) -> None:
    rng = np.random.default_rng(3)
    sine = 0.02 * np.sin(2 * np.pi * hz * STAMPS[:, None, None] + rng.uniform(0, 6, (1, 5, 3)))
    found = quarter_period(measured(sine, 0.02, rng=rng))
    assert found == pytest.approx(0.25 / hz, abs=0.04, rel=0.3)


def test_a_glimpse_of_a_swing_knows_how_wide_it_is() -> None:
    """Fifteen frames of a swing of 3 cm at 1 Hz, seen about their own mean: the speed gives the width away."""
    rng = np.random.default_rng(4)
    sine = np.zeros((15, 1, 3))
    sine[:, 0, 0] = 0.03 * np.sin(2 * np.pi * (STAMPS[:15] + 0.6))
    sine -= sine.mean(axis=0)
    seen = float(np.sqrt((sine**2).sum(axis=-1).mean() / 3))
    of, sigma, within = stretches(measured(sine, seen, rng=rng), 0.0, 0.5)
    # Along any axis the rms of the whole swing is 30 mm / sqrt(3) at its turning point, a sine's mean square is half.
    assert max(0.006, 0.9 * seen) <= sigma.max() < 0.03
    assert (within >= 0.8 * seen * (1 - 1e-9)).all()
    assert (within <= 0.8 * np.maximum(seen, sigma[of]) * (1 + 1e-9)).all()


def test_stretches_join_neither_clusters_nor_motion_and_rest() -> None:
    moved = measured(np.zeros((60, 2, 3)))
    moved = replace(moved, scale=np.where((moved.cluster == 0) & (moved.frame >= 30), 0.01, 0.0))
    of, sigma, _ = stretches(moved, 0.001, 0.5)
    assert len(sigma) == len(np.unique(of)) == 2 + 2 + 4
    for s in range(len(sigma)):
        assert len(np.unique(moved.cluster[of == s])) == 1
        assert len(np.unique(moved.scale[of == s])) == 1
    assert sigma[of[moved.cluster == 1]] == pytest.approx(0.001, rel=1e-3)
    assert (sigma[of[moved.scale > 0.0]] >= 0.01).all()
