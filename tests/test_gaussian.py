"""Gaussians: checks that name what is wrong, whitening, fusion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracking.errors import CovarianceError
from tracking.gaussian import (
    ensure_positive_definite,
    ensure_positive_semidefinite,
    fuse,
    fuse_many,
    log_det,
    whiten,
)


def spd(rng: np.random.Generator, *shape: int) -> np.ndarray:
    *lead, d = shape
    a = rng.standard_normal((*lead, d, d))
    return a @ np.swapaxes(a, -1, -2) + 0.1 * np.eye(d)


def test_the_smallest_eigenvalue_is_named() -> None:
    with pytest.raises(CovarianceError, match=r"smallest eigenvalue -1\b"):
        ensure_positive_definite(np.diag([2.0, -1.0, 3.0]))


def test_the_place_in_a_stack_is_named() -> None:
    covs = np.tile(np.eye(2), (2, 3, 1, 1))
    covs[1, 2] = np.array([[1.0, 2.0], [2.0, 1.0]])
    with pytest.raises(CovarianceError, match=r"members \[1, 2\].*smallest eigenvalue -1\b"):
        ensure_positive_definite(covs, "members")


@pytest.mark.parametrize(
    ("cov", "words"),
    [
        (np.array([[1.0, np.nan], [np.nan, 1.0]]), "not finite"),
        (np.array([[1.0, 0.5], [0.2, 1.0]]), "not symmetric"),
        (np.ones((2, 3)), "square"),
        (np.zeros((2, 2)), "not positive definite"),
    ],
)
def test_bad_covariances_are_refused(cov: np.ndarray, words: str) -> None:
    with pytest.raises(CovarianceError, match=words):
        ensure_positive_definite(cov)


def test_a_singular_covariance_is_semidefinite() -> None:
    v = np.array([1.0, 2.0, -3.0])
    np.testing.assert_array_equal(ensure_positive_semidefinite(np.outer(v, v)), np.outer(v, v))
    with pytest.raises(CovarianceError):
        ensure_positive_semidefinite(np.diag([1.0, -1e-6]))


def test_fusing_two_scalars_by_hand() -> None:
    # 1 +- 2 and 4 +- 1: information 1/4 + 1, mean (1/4 + 4) / (5/4)
    mean, cov = fuse(np.array([1.0]), np.array([[4.0]]), np.array([4.0]), np.array([[1.0]]))
    assert mean[0] == pytest.approx(3.4)
    assert cov[0, 0] == pytest.approx(0.8)


def test_fusion_is_the_information_form() -> None:
    rng = np.random.default_rng(0)
    a, b, A, B = rng.standard_normal((5, 3)), rng.standard_normal((5, 3)), spd(rng, 5, 3), spd(rng, 5, 3)
    mean, cov = fuse(a, A, b, B)
    information = np.linalg.inv(A) + np.linalg.inv(B)
    np.testing.assert_allclose(np.linalg.inv(cov), information, rtol=1e-9)
    many, many_cov = fuse_many(np.stack([a, b], 1), np.stack([A, B], 1))
    np.testing.assert_allclose(many, mean, rtol=1e-9)
    np.testing.assert_allclose(many_cov, cov, rtol=1e-9)


def test_fusion_with_a_far_better_estimate_stays_positive_definite() -> None:
    mean, cov = fuse(np.zeros(2), 1e8 * np.eye(2), np.ones(2), 1e-8 * np.eye(2))
    ensure_positive_definite(cov)
    np.testing.assert_allclose(mean, 1.0, rtol=1e-12)
    np.testing.assert_allclose(np.diag(cov), 1e-8, rtol=1e-6)


@given(st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_whitened_vectors_have_the_mahalanobis_norm(d: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    v, S = rng.standard_normal((4, d)), spd(rng, 4, d)
    w = whiten(v, S)
    np.testing.assert_allclose((w * w).sum(-1), (v * np.linalg.solve(S, v[..., None])[..., 0]).sum(-1), rtol=1e-8)
    np.testing.assert_allclose(log_det(S), np.linalg.slogdet(S)[1], rtol=1e-9, atol=1e-9)
