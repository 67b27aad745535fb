"""Which clusters swing, against Bayes' rule by hand."""

from __future__ import annotations

import numpy as np
import pytest

from cluster_slam.localisation import sway
from cluster_slam.localisation.scene import ErrorScale

SCALE = ErrorScale(touched_share=0.06, touched_m=0.018)
SIZES = np.array([0.0, 0.002, 0.006, 0.018])


def by_hand(displacements: np.ndarray, sigma: float, touched: float) -> np.ndarray:
    var = sigma**2 + SIZES**2
    square = (displacements**2).sum(axis=1)[:, None]
    density = np.exp(-0.5 * square / var) / var**1.5 * np.array([1.0 - touched, *[touched / 3.0] * 3])
    return density / density.sum(axis=1, keepdims=True)


def test_probabilities_are_those_of_the_mixture() -> None:
    displacements = np.array([[0.0, 0.001, 0.0], [0.003, -0.002, 0.004], [0.0, 0.02, 0.01]])
    p, prior = sway.shares(displacements, np.tile(0.001**2 * np.eye(3), (3, 1, 1)), SCALE)
    np.testing.assert_allclose(p, by_hand(displacements, 0.001, 1.0 - prior[0]), rtol=1e-9)
    assert p.argmax(axis=1).tolist() == [0, 1, 3]
    assert sway.surprise(prior[None], prior) == pytest.approx(0.0, abs=1e-12)
    assert sway.surprise(p, prior) > 0


def test_a_touch_makes_it_likelier_that_neighbours_swing() -> None:
    doubtful, still = np.array([0.0, 0.004, 0.0]), np.zeros(3)
    covs = np.tile(0.0012**2 * np.eye(3), (6, 1, 1))
    calm, _ = sway.shares(np.array([doubtful, *[still] * 5]), covs, SCALE)
    shaken, _ = sway.shares(np.array([doubtful, *[[0.01, 0.01, 0.0]] * 5]), covs, SCALE)
    assert shaken[0, 0] < 0.5 * calm[0, 0]


def test_what_a_frame_cannot_see_of_touches_is_the_mean_square_of_their_displacements() -> None:
    rng = np.random.default_rng(0)
    touched = rng.random(200_000) < SCALE.touched_share
    size = SIZES[rng.integers(1, 4, 200_000)]
    displacement = np.where(touched, size * rng.normal(size=200_000), 0.0)
    assert sway.unseen_variance(SCALE) == pytest.approx(displacement.var(), rel=0.03)
