"""Landmarks of two maps that bend, matched jointly."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from cluster_slam.association.compatibility import Matches, Side, decided_otherwise, match_jointly
from cluster_slam.geometry import Array, se3_exp, skew

_BASIS = np.eye(6)[:, [1, 3, 5]]
_NEAR = np.array([[1.0, 0, 2], [-1.0, 0, 2], [0.0, 0, 4]])
_PAIRS = np.array([[10.0, 0, 20], [10.15, 0, 20], [4.0, 0, 22], [4.15, 0, 22]])  # 15 cm apart, far away
_ALL = np.concatenate([_NEAR, _PAIRS])
_NOTHING = Matches(np.empty((0, 2), dtype=np.int64), np.zeros(3), 0.0)


def _cov(bend: float, sigma: float = 0.02) -> Array:
    """Landmarks known to sigma, those far away turning together about the origin by ``bend``."""
    turn = np.cross([0.0, 1.0, 0.0], np.where(_ALL[:, 2:] > 5, _ALL, 0.0)).ravel()
    return sigma**2 * np.eye(3 * len(_ALL)) + bend**2 * np.outer(turn, turn)


def test_the_score_is_the_likelihood_of_all_matches_at_once() -> None:
    rng = np.random.default_rng(2)
    a, b = Side(_ALL, _cov(0.01)), Side(_ALL + 0.02 * rng.standard_normal(_ALL.shape), _cov(0.0))
    prior, log_volume = np.diag([0.02, 0.05, 0.05]) ** 2, 5.0
    match = match_jointly(a, b, _NOTHING, prior, _BASIS, log_volume)
    assert sorted(match.pairs.tolist()) == [[j, j] for j in range(len(_ALL))]
    J = np.concatenate([np.hstack([-skew(p), np.eye(3)]) @ _BASIS for p in b.places])
    error = (a.places - b.places).ravel()
    exact = multivariate_normal(np.zeros(len(error)), a.cov + b.cov + J @ prior @ J.T).logpdf(error)
    assert match.score == pytest.approx(2.0 * (exact + log_volume * len(_ALL)), abs=0.01)


@pytest.mark.parametrize("bend", [0.0, 0.02, -0.03])
def test_what_is_bent_is_straightened_before_the_next_landmark_is_judged(bend: float) -> None:
    """The far landmarks lie off by several times their spacing, and are still told apart."""
    rng = np.random.default_rng(5)
    turned = _ALL @ se3_exp(np.array([0, bend, 0, 0, 0, 0]))[:3, :3].T
    bent = np.where(_ALL[:, 2:] > 5, turned, _ALL) + 0.01 * rng.standard_normal(_ALL.shape)
    start = Matches(np.array([[0, 0], [3, 3]]), np.zeros(3), 0.0)
    match = match_jointly(
        Side(_ALL, _cov(0.05)), Side(bent, _cov(0.0)), start, np.diag([0.3, 0.3, 0.3]) ** 2, _BASIS, 5.0
    )
    assert sorted(match.pairs.tolist()) == [[j, j] for j in range(len(_ALL))]


def test_landmarks_that_are_somewhere_else_stay_new() -> None:
    a = Side(_NEAR, 1e-4 * np.eye(9))
    b = Side(_NEAR + np.array([0.0, 0.0, 9.0]), 1e-4 * np.eye(9))
    match = match_jointly(a, b, _NOTHING, 1e-4 * np.eye(3), _BASIS, 5.0)
    assert len(match.pairs) == 0
    assert match.score == 0.0


def test_distances_have_the_variance_along_them() -> None:
    """What moves landmarks together does not change how far apart they are."""
    side = Side(_NEAR, 1e-4 * np.eye(9) + np.kron(np.ones((3, 3)), np.eye(3)))
    length, var = side.distances()
    assert length[0, 1] == pytest.approx(2.0)
    np.testing.assert_allclose(var[np.triu_indices(3, 1)], 2e-4, rtol=1e-9)


def test_each_decision_is_taken_back_once_and_the_rest_made_anew() -> None:
    a, b = Side(_ALL, _cov(0.01)), Side(_ALL, _cov(0.0))
    prior = np.diag([0.02, 0.05, 0.05]) ** 2
    found = match_jointly(a, b, _NOTHING, prior, _BASIS, 5.0)
    others = decided_otherwise(a, b, [found], prior, _BASIS, 5.0)
    assert len(others) == len(found.pairs) - 2
    for k, other in enumerate(others, start=2):
        np.testing.assert_array_equal(other.pairs[:k], found.pairs[:k])
        assert found.pairs[k].tolist() not in other.pairs.tolist()
        assert other.score < found.score
