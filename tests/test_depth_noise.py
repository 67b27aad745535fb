"""Noise that a camera states at the measured depth, and what it does to a mean."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cluster_slam.association.depth_noise import DepthSums, at_expected_depth, powers_of_depth
from cluster_slam.association.frames import Frames, sort_by_frame
from cluster_slam.geometry import Array
from cluster_slam.records import Observations


def _seen(depth: Array, power: float, seed: int = 0) -> tuple[Frames, Array]:
    """Points at depths (m,) on the axis, measured with sigma 0.05 z**power; and the depths measured without bias."""
    rng = np.random.default_rng(seed)
    z = depth + 0.05 * depth**power * rng.standard_normal(len(depth))
    points = np.column_stack([0.0 * z, 0.0 * z, z])
    covs = np.zeros((len(z), 3, 3))
    covs[:, 0, 0] = covs[:, 1, 1] = (0.002 * z) ** 2
    covs[:, 2, 2] = (0.05 * z**power) ** 2
    observations = Observations(np.zeros(len(z), dtype=np.int64), points, covs, np.full(len(z), np.nan))
    return sort_by_frame(observations, np.zeros(1)), z


@pytest.mark.parametrize("power", [1.0, 2.0])
def test_powers_are_found(power: float) -> None:
    frames, _ = _seen(np.linspace(0.5, 2.0, 200), power)
    assert powers_of_depth(frames) == pytest.approx((power, 1.0), abs=1e-6)


def test_constant_noise_stays() -> None:
    frames, _ = _seen(np.linspace(0.5, 2.0, 200), 2.0)
    same = replace(frames, covs=np.broadcast_to(np.eye(3), frames.covs.shape))
    assert powers_of_depth(same) == (0.0, 0.0)
    assert at_expected_depth(same, np.ones(200)) is same


def test_weighted_mean_at_the_measured_depth_is_too_near_and_at_the_expected_one_is_not() -> None:
    depth = np.full(40_000, 1.5)
    frames, z = _seen(depth, 2.0)
    sigma = 0.05 * 1.5**2

    def mean(f: Frames) -> float:
        weight = 1.0 / f.covs[:, 2, 2]
        return float(weight @ z / weight.sum())

    bias = -4.0 * sigma**2 / 1.5  # first order
    assert mean(frames) - 1.5 == pytest.approx(bias, rel=0.2)
    assert abs(mean(at_expected_depth(frames, depth)) - 1.5) < 5.0 * sigma / np.sqrt(len(z))


def test_what_is_not_known_stays_as_it_is() -> None:
    frames, _ = _seen(np.linspace(0.8, 1.5, 200), 2.0)
    depth = np.where(np.arange(200) < 100, np.nan, 1.0)
    found = at_expected_depth(frames, depth)
    np.testing.assert_array_equal(found.covs[:100], frames.covs[:100])
    np.testing.assert_allclose(found.covs[100:, 2, 2], 0.05**2, rtol=1e-9)
    np.testing.assert_allclose(found.covs[100:, 0, 0], 0.002**2, rtol=1e-9)


def test_powers_of_frames_one_by_one_are_those_of_all() -> None:
    frames, _ = _seen(np.linspace(0.5, 2.0, 200), 2.0)
    sums = DepthSums()
    for k in range(0, 200, 7):
        sums.add(frames.points[k : k + 7], frames.covs[k : k + 7])
    assert sums.powers() == pytest.approx(powers_of_depth(frames), abs=1e-9)
