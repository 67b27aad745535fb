"""What the residuals say of noise and mount."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_slam.online.watch import AstrayWatch, MountWatch, NoiseWatch


@pytest.mark.parametrize("true", [1.0, 4.0])
def test_the_factor_on_variances_is_found_behind_a_gate(true: float) -> None:
    rng, watch = np.random.default_rng(3), NoiseWatch()
    for _ in range(400):
        chi2 = rng.chisquare(3, 30) * true / watch.factor
        watch.see(chi2[chi2 < 16.0])
    assert watch.factor == pytest.approx(true, rel=0.25)


def test_a_mount_that_moved_is_told_once_and_noise_never() -> None:
    rng = np.random.default_rng(4)
    sigma = np.repeat([0.002, 0.001], 3)
    watch = MountWatch(np.diag(sigma**2))
    stamps = np.arange(600) / 30.0
    assert not any(watch.see(float(t), rng.normal(size=6) * sigma) for t in stamps)
    moved = np.array([0, 0, 0, 0.006, 0, 0])
    told = [w for t in stamps if (w := watch.see(float(t) + 20.0, moved + rng.normal(size=6) * sigma))]
    assert 1 <= len(told) <= 2
    assert "6." in told[-1] or "5." in told[-1]


def test_odometry_leads_astray_until_known_flowers_come_back() -> None:
    watch, step = AstrayWatch(), np.diag([0.01, 0.01, 0.01, 0.02, 0.02, 0.02]) ** 2
    watch.see(0.0, np.zeros(0), step, 2.0)
    assert watch.most_m == 0.0  # nothing is known that could be lost
    watch.see(1.0, np.array([0.5, 0.5, 0.6]), step, 2.0)
    for k in range(25):
        watch.see(2.0 + k, np.zeros(2), step, 2.0)
    expected = np.sqrt(25 * 3 * (0.02**2 + (0.01 * 2.0) ** 2))
    assert watch.sigma_m == pytest.approx(expected)
    watch.see(30.0, np.array([28.0, 28.0, 28.0]), step, 2.0)  # new ones hold the way, and do not bring it back
    assert watch.sigma_m == pytest.approx(expected)
    watch.see(31.0, np.array([0.5, 0.5, 0.6]), step, 2.0)
    assert watch.sigma_m == 0.0
    assert watch.most_m == pytest.approx(expected)
