"""Chi-square gates against SciPy and by hand, the all-pairs gate against one pair at a time."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from tracking.allpairs import gate_all
from tracking.errors import CovarianceError, ParameterError
from tracking.gating import (
    Gate,
    GateReason,
    apply_gate,
    chi2_threshold,
    gate_reasons,
    inflate,
    mahalanobis_sq,
    matching_log_likelihood,
)


def spd(rng: np.random.Generator, n: int, d: int) -> np.ndarray:
    a = rng.standard_normal((n, d, d))
    return a @ np.swapaxes(a, -1, -2) + 0.05 * np.eye(d)


def test_the_papers_threshold() -> None:
    assert round(chi2_threshold(2, 0.95), 4) == 5.9915


@given(st.integers(1, 60), st.floats(1e-6, 1 - 1e-6))
def test_thresholds_are_scipys(dof: int, probability: float) -> None:
    assert chi2_threshold(dof, probability) == pytest.approx(stats.chi2.ppf(probability, dof), rel=1e-9)


@pytest.mark.parametrize("probability", [0.0, 1.0, -0.1, 1.5, float("nan")])
def test_probabilities_outside_0_1_are_refused(probability: float) -> None:
    with pytest.raises(ParameterError, match=r"\(0, 1\)"):
        chi2_threshold(2, probability)


def test_distances_by_hand() -> None:
    # 3^2 / 4 + 1^2 / 0.25
    assert mahalanobis_sq(np.array([3.0, 1.0]), np.diag([4.0, 0.25])) == pytest.approx(6.25)
    assert mahalanobis_sq(np.array([1.0, 1.0]), np.array([[2.0, 1.0], [1.0, 2.0]])) == pytest.approx(2.0 / 3.0)


@given(st.integers(1, 7), st.integers(0, 2**32 - 1))
def test_distances_and_likelihoods_are_scipys(d: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    v, S = rng.standard_normal((5, d)), spd(rng, 5, d)
    expected = [stats.multivariate_normal.logpdf(x, np.zeros(d), C) for x, C in zip(v, S, strict=True)]
    np.testing.assert_allclose(matching_log_likelihood(v, S), expected, rtol=1e-8, atol=1e-8)
    np.testing.assert_allclose(
        mahalanobis_sq(v, S), (v * np.linalg.solve(S, v[..., None])[..., 0]).sum(-1), rtol=1e-8, atol=1e-12
    )


def test_stacks_broadcast() -> None:
    rng = np.random.default_rng(1)
    v, S = rng.standard_normal((4, 1, 3)), spd(rng, 6, 3)
    out = mahalanobis_sq(v, S)
    assert out.shape == (4, 6)
    assert out[2, 3] == pytest.approx(mahalanobis_sq(v[2, 0], S[3]))


@pytest.mark.parametrize("d", [2, 3])
def test_a_covariance_that_is_not_positive_definite_is_named(d: int) -> None:
    S = np.tile(np.eye(d), (4, 1, 1))
    S[2, 0, 0] = -0.5
    with pytest.raises(CovarianceError, match=r"\[2\].*-0\.5"):
        mahalanobis_sq(np.zeros((4, d)), S)


def test_reasons() -> None:
    gate = Gate(0.95, 2, equal_count=True)
    innovation = np.array([[0.0, 0.0], [9.0, 0.0], [0.0, 0.0], [np.nan, 0.0]])
    out = apply_gate(gate, innovation, np.eye(2), [3, 3, 3, 3], [3, 3, 4, 3])
    expected = [GateReason.ACCEPTED, GateReason.DISTANCE, GateReason.COUNT, GateReason.INVALID]
    assert out.reasons.tolist() == expected
    assert out.passed.tolist() == [True, False, False, False]
    assert out.log_likelihood[0] == pytest.approx(-np.log(2 * np.pi))
    assert gate_reasons(Gate(0.95, 2), np.array([5.99, 6.0])).tolist() == [GateReason.ACCEPTED, GateReason.DISTANCE]


def test_a_gate_checks_its_options() -> None:
    with pytest.raises(ParameterError, match="sigma_inflation_m"):
        Gate(sigma_inflation_m=-0.001)
    with pytest.raises(ParameterError, match="degrees of freedom"):
        Gate(dof=0)
    with pytest.raises(ParameterError, match="n_reference"):
        apply_gate(Gate(equal_count=True), np.zeros(2), np.eye(2))
    with pytest.raises(ParameterError, match="3 entries"):
        apply_gate(Gate(dof=2), np.zeros(3), np.eye(3))


def test_padding_adds_to_the_standard_deviation() -> None:
    np.testing.assert_allclose(inflate(0.01**2 * np.eye(9), 0.005), 0.015**2 * np.eye(9), rtol=1e-12)
    rng = np.random.default_rng(2)
    cov = spd(rng, 3, 4)
    sigma = np.sqrt(np.linalg.eigvalsh(cov))
    np.testing.assert_allclose(np.sqrt(np.linalg.eigvalsh(inflate(cov, 0.5))), sigma + 0.5, rtol=1e-9)


def test_a_gate_holds_what_it_says() -> None:
    rng = np.random.default_rng(3)
    n = 20_000
    S = spd(rng, 1, 4)[0]
    v = rng.standard_normal((n, 4)) @ np.linalg.cholesky(S).T
    share = (mahalanobis_sq(v, S) <= chi2_threshold(4, 0.9)).mean()
    assert abs(share - 0.9) < 4 * np.sqrt(0.09 / n)


@given(st.integers(1, 5), st.sampled_from([0.3, 3.0, 300.0, 1e5]), st.integers(0, 2**32 - 1))
def test_all_pairs_are_gated_as_one_by_one(d: int, spread: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, A, B = spread * rng.standard_normal((23, d)), spd(rng, 23, d), spd(rng, 31, d)
    b = spread * rng.standard_normal((31, d))
    b[:10] = a[:10] + rng.standard_normal((10, d))
    A[0] *= 1e6
    gate = Gate(0.95, d)
    expected = mahalanobis_sq(b - a[:, None], A[:, None] + B) <= gate.threshold
    np.testing.assert_array_equal(gate_all(gate, a, A, b, B), expected)
    alone = mahalanobis_sq(b - a[:, None], A[:, None]) <= gate.threshold
    np.testing.assert_array_equal(gate_all(gate, a, A, b, 0 * B), alone)


def test_all_pairs_with_nearly_dependent_components() -> None:
    # inertia and mean distance are correlated to 0.999 and of very different size
    rng = np.random.default_rng(4)
    x = rng.uniform(0.02, 0.08, 200)
    means = np.stack([6 * x**2, x], axis=1)
    jacobian = np.stack([12 * x, np.ones_like(x)], axis=1)
    covs = 1e-6 * (jacobian[:, :, None] * jacobian[:, None]) + np.diag([1e-10, 1e-10])
    gate = Gate(0.95, 2)
    expected = mahalanobis_sq(means - means[:, None], covs[:, None] + covs) <= gate.threshold
    np.testing.assert_array_equal(gate_all(gate, means, covs, means, covs), expected)


def test_all_pairs_with_counts_and_without_any() -> None:
    gate = Gate(0.95, 2, equal_count=True)
    two, one = (np.zeros((2, 2)), np.tile(np.eye(2), (2, 1, 1))), (np.zeros((1, 2)), np.eye(2)[None])
    assert gate_all(gate, *two, *one, [3, 4], [4]).tolist() == [[False], [True]]
    assert gate_all(Gate(), np.zeros((0, 2)), np.zeros((0, 2, 2)), *one).shape == (0, 1)
    with pytest.raises(ParameterError, match="not finite: row 1"):
        gate_all(Gate(), np.array([[0, 0], [np.nan, 0]]), two[1], *one)
    with pytest.raises(ParameterError, match="counts"):
        gate_all(gate, *two, *one)
    with pytest.raises(CovarianceError):
        gate_all(Gate(), two[0], -2 * two[1], *one)
