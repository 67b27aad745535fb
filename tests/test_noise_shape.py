"""The noise of a session that states one sigma and no covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cluster_slam import evaluate, smooth
from cluster_slam.association.depth_noise import NoiseShape
from cluster_slam.records import Result
from cluster_slam.simulate import PRESETS, simulate_session
from cluster_slam.simulate.session import Simulated

SHAPE = NoiseShape(depth=0.006, lateral=0.002, power_depth=2.0, power_lateral=1.0)


def test_covariances_of_a_shape() -> None:
    covs = SHAPE.covs(np.array([[0.0, 0.0, 2.0], [2.0, 0.0, 2.0]]), np.array([2.0, 2.0]))
    assert covs[0] == pytest.approx(np.diag([0.004, 0.004, 0.024]) ** 2)
    ray = np.array([1.0, 0.0, 1.0])
    assert covs[1] == pytest.approx(0.024**2 * np.outer(ray, ray) + np.diag([0.004, 0.004, 0.0]) ** 2)


CONFIG = replace(PRESETS["moderate"], with_covariances=False, duration_s=12.0)


@pytest.fixture(scope="module")
def made() -> Simulated:
    return simulate_session(CONFIG, seed=77)


@pytest.fixture(scope="module")
def result(made: Simulated) -> Result:
    return smooth(made.session)


def test_residuals_show_the_shape(result: Result) -> None:
    noise = result.diagnostics.estimated_noise
    for z in (0.6, 0.9):
        assert noise["flower_lateral"] * z ** noise["flower_power_lateral"] == pytest.approx(
            z / CONFIG.focal_px, rel=0.1
        )
        depth = CONFIG.depth_sigma * z**2
        assert noise["flower_depth"] * z ** noise["flower_power_depth"] == pytest.approx(depth, rel=0.15)


def test_identities_are_as_with_covariances(made: Simulated, result: Result) -> None:
    metrics = evaluate(result, made.session, made.truth)
    assert metrics.cluster_idf1 is not None
    assert metrics.flower_idf1 is not None
    assert min(metrics.cluster_idf1, metrics.flower_idf1) > 0.99
