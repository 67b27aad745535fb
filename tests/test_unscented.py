"""The unscented transform against filterpy, linear algebra and exact moments."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracking.errors import CovarianceError, ParameterError
from tracking.unscented import CUBATURE, SigmaRule, combine, fifth_degree, sigma_points, unscented_transform


def spd(rng: np.random.Generator, *shape: int) -> np.ndarray:
    *lead, d = shape
    a = rng.standard_normal((*lead, d, d))
    return a @ np.swapaxes(a, -1, -2) + 0.1 * np.eye(d)


def curved(x: np.ndarray) -> np.ndarray:
    return np.stack([(x * x).sum(-1), np.sqrt(1.0 + (x * x).sum(-1)), x[..., 0] * x[..., -1]], axis=-1)


@pytest.mark.parametrize(("alpha", "tolerance"), [(1.0, 1e-12), (0.5, 1e-12), (0.1, 1e-12), (1e-2, 1e-9), (1e-4, 1e-6)])
@pytest.mark.parametrize(("beta", "kappa"), [(2.0, 0.0), (0.0, 1.0)])
@pytest.mark.parametrize("n", [3, 6])
def test_filterpy_agrees(alpha: float, tolerance: float, beta: float, kappa: float, n: int) -> None:
    from filterpy.kalman import MerweScaledSigmaPoints
    from filterpy.kalman import unscented_transform as theirs

    def describe(x: np.ndarray) -> np.ndarray:
        offsets = x.reshape(*x.shape[:-1], n, 3)
        r = np.linalg.norm(offsets - offsets.mean(-2, keepdims=True), axis=-1)
        return np.stack([(r * r).sum(-1), r.mean(-1)], axis=-1)

    rng = np.random.default_rng(0)
    cluster = rng.random((n, 3))
    mean, cov = (cluster - cluster.mean(0)).ravel(), 0.1**2 * np.eye(3 * n)
    points = MerweScaledSigmaPoints(3 * n, alpha, beta, kappa)
    expected_mean, expected_cov = theirs(describe(points.sigma_points(mean, cov)), points.Wm, points.Wc)
    ours_mean, ours_cov = unscented_transform(mean, cov, describe, SigmaRule(alpha, beta, kappa))
    np.testing.assert_allclose(ours_mean, expected_mean, rtol=tolerance)
    np.testing.assert_allclose(ours_cov, expected_cov, rtol=tolerance)


def test_the_weights_are_the_printed_ones() -> None:
    mean, cov = SigmaRule(0.5, 2.0, 1.0).weights(3)  # lambda = 0.25 * 4 - 3 = -2
    np.testing.assert_allclose(mean, [-2.0] + 6 * [0.5])
    np.testing.assert_allclose(cov, [-2.0 + 1 - 0.25 + 2] + 6 * [0.5])


@given(st.integers(1, 6), st.floats(0.05, 2.0), st.floats(-0.5, 3.0), st.integers(0, 2**32 - 1))
def test_differences_are_the_printed_formula(length: int, alpha: float, beta: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    rule = SigmaRule(alpha, beta, 0.5)
    values = rng.standard_normal((2 * length + 1, 2))
    wm, wc = rule.weights(length)
    mean = wm @ values
    cov = (values - mean).T @ (wc[:, None] * (values - mean))
    got_mean, got_cov = combine(values, rule, length)
    magnitude = np.abs(wc).sum() * 20
    np.testing.assert_allclose(got_mean, mean, atol=1e-13 * magnitude)
    np.testing.assert_allclose(got_cov, cov, atol=1e-12 * magnitude)


@given(st.integers(1, 6), st.sampled_from([1e-3, 0.1, 1.0, 2.0]), st.integers(0, 2**32 - 1))
def test_a_linear_function_is_exact(length: int, alpha: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    mean, cov, A = rng.standard_normal(length), spd(rng, length), rng.standard_normal((3, length))
    for rule in (SigmaRule(alpha), CUBATURE):
        got_mean, got_cov = unscented_transform(mean, cov, lambda x: x @ A.T + 1.0, rule)
        np.testing.assert_allclose(got_mean, A @ mean + 1.0, atol=1e-9)
        np.testing.assert_allclose(got_cov, A @ cov @ A.T, rtol=1e-8, atol=1e-9)


def test_a_kalman_update_is_the_linear_one() -> None:
    # the joint transform of (state, measurement) gives the Kalman gain
    rng = np.random.default_rng(1)
    P, H, R = spd(rng, 4), rng.standard_normal((2, 4)), spd(rng, 2)
    mean = rng.standard_normal(4)
    _, joint = unscented_transform(mean, P, lambda x: np.concatenate([x, x @ H.T], axis=-1), SigmaRule(0.1))
    S = joint[4:, 4:] + R
    gain = joint[:4, 4:] @ np.linalg.inv(S)
    np.testing.assert_allclose(gain, P @ H.T @ np.linalg.inv(H @ P @ H.T + R), atol=1e-9)


@pytest.mark.parametrize("alpha", [1e-3, 0.1, 1.0])
def test_a_filter_made_of_transforms_is_the_kalman_filter_on_a_linear_model(alpha: float) -> None:
    """Fifty steps of a constant-velocity target: the Kalman filter, filterpy's UKF and ours agree."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    rng = np.random.default_rng(5)
    F, H = np.eye(6) + 0.1 * np.eye(6, k=3), np.eye(3, 6)
    Q, R, rule = 0.01 * np.eye(6), 0.2 * np.eye(3), SigmaRule(alpha)
    theirs = UnscentedKalmanFilter(
        6, 3, 0.1, lambda x: H @ x, lambda x, dt: F @ x, MerweScaledSigmaPoints(6, alpha, 2.0, 0.0)
    )
    theirs.Q, theirs.R = Q, R
    x, P = np.zeros(6), np.eye(6)
    ours_x, ours_P = x, P
    for _ in range(50):
        z = rng.standard_normal(3)
        x, P = F @ x, F @ P @ F.T + Q
        gain = P @ H.T @ np.linalg.inv(H @ P @ H.T + R)
        x, P = x + gain @ (z - H @ x), P - gain @ H @ P
        ours_x, ours_P = unscented_transform(ours_x, ours_P, lambda s: s @ F.T, rule)
        ours_P = ours_P + Q
        both, joint = unscented_transform(ours_x, ours_P, lambda s: np.concatenate([s, s @ H.T], axis=-1), rule)
        S = joint[6:, 6:] + R
        ours_x = ours_x + joint[:6, 6:] @ np.linalg.solve(S, z - both[6:])
        ours_P = ours_P - joint[:6, 6:] @ np.linalg.solve(S, joint[6:, :6])
        theirs.predict()
        theirs.update(z)
    np.testing.assert_allclose(ours_x, x, atol=1e-9)
    np.testing.assert_allclose(ours_P, P, atol=1e-9)
    np.testing.assert_allclose(ours_x, theirs.x, atol=1e-8)
    np.testing.assert_allclose(ours_P, theirs.P, atol=1e-8)


def test_stacks_and_a_beta_of_each() -> None:
    rng = np.random.default_rng(2)
    mean, cov, beta = rng.standard_normal((2, 5, 3)), spd(rng, 2, 5, 3), rng.uniform(0, 2, (2, 5))
    got_mean, got_cov = unscented_transform(mean, cov, curved, SigmaRule(), beta)
    one_mean, one_cov = unscented_transform(mean[1, 2], cov[1, 2], curved, SigmaRule(1.0, float(beta[1, 2])))
    np.testing.assert_allclose(got_mean[1, 2], one_mean, rtol=1e-14)
    np.testing.assert_allclose(got_cov[1, 2], one_cov, rtol=1e-12)


def test_one_covariance_for_many_means() -> None:
    rng = np.random.default_rng(3)
    mean, cov = rng.standard_normal((7, 3)), spd(rng, 3)
    np.testing.assert_array_equal(
        sigma_points(mean, cov, CUBATURE), sigma_points(mean, np.tile(cov, (7, 1, 1)), CUBATURE)
    )


def test_a_square_of_one_gaussian_wants_beta_2() -> None:
    # x ~ N(m, s^2): var(x^2) = 4 m^2 s^2 + 2 s^4
    _, cov = unscented_transform(np.array([3.0]), np.array([[0.25]]), lambda x: x * x, SigmaRule(1e-2, 2.0))
    assert cov[0, 0] == pytest.approx(4 * 9 * 0.25 + 2 * 0.0625, rel=1e-9)


@given(st.integers(1, 6), st.integers(0, 2**32 - 1))
def test_the_fifth_degree_rule_is_exact_for_quartic_moments(length: int, seed: int) -> None:
    # var(x' A x) = 4 u'A P A u + 2 tr(A P A P) is a fourth moment
    rng = np.random.default_rng(seed)
    mean, P, A = rng.standard_normal(length), spd(rng, length), rng.standard_normal((length, length))
    A = A + A.T
    got_mean, got_cov = fifth_degree(mean, P, lambda x: ((x @ A) * x).sum(-1, keepdims=True))
    assert got_mean[0] == pytest.approx(mean @ A @ mean + np.trace(A @ P), rel=1e-9, abs=1e-9)
    true = 4 * mean @ A @ P @ A @ mean + 2 * np.trace(A @ P @ A @ P)
    assert got_cov[0, 0] == pytest.approx(true, rel=1e-8)


def test_bad_parameters() -> None:
    with pytest.raises(ParameterError, match="alpha"):
        SigmaRule(alpha=0.0)
    with pytest.raises(ParameterError, match="finite"):
        SigmaRule(beta=float("nan"))
    with pytest.raises(ParameterError, match="kappa"):
        unscented_transform(np.zeros(2), np.eye(2), curved, SigmaRule(1.0, 2.0, -2.0))
    with pytest.raises(ParameterError, match=r"\(2, 2\)"):
        unscented_transform(np.zeros(2), np.eye(3), curved, SigmaRule())
    with pytest.raises(CovarianceError, match="smallest eigenvalue -1"):
        unscented_transform(np.zeros(2), np.diag([1.0, -1.0]), curved, SigmaRule())
