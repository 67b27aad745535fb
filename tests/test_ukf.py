"""The filter: right where the answer is known, and never at work on a covariance that is none."""

from __future__ import annotations

import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tracking.consistency import mean_band
from tracking.errors import CovarianceError, ParameterError
from tracking.motion import MotionConfig, MotionKind, advance, process_noise, state_at_rest
from tracking.ukf import UnscentedFilter, repaired, safe_root


def linear_step(x: np.ndarray, P: np.ndarray, F: np.ndarray, Q: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return F @ x, F @ P @ F.T + Q


def linear_update(
    x: np.ndarray, P: np.ndarray, H: np.ndarray, z: np.ndarray, R: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    K = np.linalg.solve(H @ P @ H.T + R, H @ P).T
    return x + K @ (z - H @ x), P - K @ H @ P


def test_a_linear_problem_is_solved_as_kalman_does() -> None:
    """Predictions, updates, and two updates without a prediction between them."""
    rng = np.random.default_rng(4)
    F = np.array([[1, 0, 0.1, 0], [0, 1, 0, 0.1], [0, 0, 0.9, 0], [0, 0, 0, 1.0]])
    H = np.eye(4)[:2]
    x, P = rng.normal(size=4), np.diag([1.0, 2.0, 0.5, 0.1])
    Q, R = 0.01 * np.eye(4), np.array([[0.2, 0.05], [0.05, 0.1]])
    ukf = UnscentedFilter(x, P)
    for i in range(30):
        if i % 3:
            x, P = linear_step(x, P, F, Q)
            ukf.predict(lambda s: s @ F.T, Q)
        z = rng.normal(size=2)
        innovation = ukf.update(z, R, lambda s: s @ H.T)
        np.testing.assert_allclose(innovation.value, z - H @ x, atol=1e-9)
        x, P = linear_update(x, P, H, z, R)
        np.testing.assert_allclose(ukf.x, x, atol=1e-9)
        np.testing.assert_allclose(ukf.P, P, atol=1e-9)


def test_innovation_changes_nothing_and_agrees_with_the_update() -> None:
    ukf = UnscentedFilter(np.array([1.0, 2.0]), np.diag([0.5, 0.2]))
    before = ukf.x.copy(), ukf.P.copy()
    seen = ukf.innovation(np.array([1.7]), np.array([[0.3]]), lambda s: s[:, :1])
    np.testing.assert_array_equal(ukf.x, before[0])
    np.testing.assert_array_equal(ukf.P, before[1])
    assert seen.nis == pytest.approx(0.7**2 / 0.8)
    assert ukf.update(np.array([1.7]), np.array([[0.3]]), lambda s: s[:, :1]).nis == pytest.approx(seen.nis)


def test_sway_is_predicted_with_true_covariances_and_its_frequency_is_found() -> None:
    """NIS of one frame ahead inside its band over 40 shakes of known kind; frequency to a tenth, place at rest."""
    config, rng = MotionConfig(), np.random.default_rng(1)
    dt, R, anchor, nis, hz = 1 / 30, 1e-6 * np.eye(3), np.zeros(3), [], []
    away = []
    for _ in range(40):
        x, P = state_at_rest(anchor, config)
        x[7] += rng.normal() * config.sway_log_sigma
        P[3:6, 3:6] = 0.15**2 * np.eye(3)
        P[8:11, 8:11] = 0.01**2 * np.eye(3)
        true = x + np.linalg.cholesky(P) @ rng.normal(size=11) * np.array([1, 1, 1, 1, 1, 1, 0, 0, 1, 1, 1])
        ukf = UnscentedFilter(state_at_rest(anchor, config)[0], P)
        for k in range(90):
            if k:
                Q = process_noise(true, dt, anchor, MotionKind.SWAY, config)
                true = advance(true, dt, anchor, MotionKind.SWAY, config)
                true[:6] += np.linalg.cholesky(Q[:6, :6] + 1e-18 * np.eye(6)) @ rng.normal(size=6)
                Q = process_noise(ukf.x, dt, anchor, MotionKind.SWAY, config)
                ukf.predict(lambda s: advance(s, dt, anchor, MotionKind.SWAY, config), Q)
            z = true[:3] + rng.normal(size=3) * 1e-3
            seen = ukf.update(z, R, lambda s: s[:, :3])
            if k > 10:
                nis.append(seen.nis)
        hz.append(abs(ukf.x[7] - true[7]))
        away.append(float(np.linalg.norm(ukf.x[8:11] - true[8:11])))
    band = mean_band(3, len(nis), 0.999)
    assert band.low * 0.93 < np.mean(nis) < band.high * 1.07
    assert np.median(hz) < 0.1
    assert np.median(away) < 0.003  # of 16 mm


@given(seed=st.integers(0, 2**32 - 1), scale=st.floats(-9, 3))
def test_whatever_comes_in_the_covariance_stays_one(seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    ukf = UnscentedFilter(rng.normal(size=3), np.diag(10.0 ** rng.uniform(-8, 2, 3)))
    for _ in range(6):
        kind = rng.integers(5)
        z, R = rng.normal(size=2) * 10.0**scale, np.diag(10.0 ** rng.uniform(-12, 2, 2))
        if kind == 0:
            z = z * np.nan
        elif kind == 1:
            R = -R
        elif kind == 2:
            R = R + np.array([[0, 1e3], [-1e3, 0]])
        elif kind == 3:
            ukf.predict(lambda s: s * 1.01, np.diag(10.0 ** rng.uniform(-12, -2, 3)))
        try:
            ukf.update(z, R, lambda s: np.sin(s[:, :2]) + s[:, 1:])
        except (CovarianceError, ParameterError):
            assert kind in (0, 1, 2)
        assert np.isfinite(ukf.x).all()
        assert np.linalg.eigvalsh(ukf.P / np.sqrt(np.outer(np.diag(ukf.P), np.diag(ukf.P))))[0] > 0


def test_bad_beginnings_are_refused() -> None:
    with pytest.raises(CovarianceError, match="not positive definite"):
        UnscentedFilter(np.zeros(2), np.diag([1.0, -1.0]))
    with pytest.raises(ParameterError, match="not finite"):
        UnscentedFilter(np.array([np.nan, 0.0]), np.eye(2))


def test_rounding_is_repaired_and_nonsense_is_not() -> None:
    spoiled = np.array([[1.0, 1.0 + 1e-12], [1.0 + 1e-12, 1.0]])
    root = safe_root(spoiled)
    np.testing.assert_allclose(root.T @ root, spoiled, atol=1e-9)
    assert np.linalg.eigvalsh(repaired(spoiled))[0] > 0
    with pytest.raises(CovarianceError, match="not finite"):
        safe_root(np.full((2, 2), np.nan))


def test_a_filter_can_be_written_down() -> None:
    ukf = UnscentedFilter(np.array([1.0, 2.0]), np.diag([0.5, 0.2]))
    again = pickle.loads(pickle.dumps(ukf))
    again.predict(lambda s: 2 * s, 0.1 * np.eye(2))
    ukf.predict(lambda s: 2 * s, 0.1 * np.eye(2))
    np.testing.assert_array_equal(again.P, ukf.P)
