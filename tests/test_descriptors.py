"""Inertia, mean distance and the other small descriptors: by hand, against Monte Carlo, invariances, bad input."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate

from cluster_slam.descriptors import (
    InertiaDistance,
    block_diagonal,
    closed_form_moments,
    compare_with_missing,
    descriptor_moments,
    distance_and_axes,
    distance_axes_descriptor,
    inertia_and_mean_distance,
    inertia_beta,
    isotropic,
    paper_descriptor,
    subsets,
    unscented_moments,
)
from cluster_slam.descriptors.norms import length, radial_length
from cluster_slam.errors import InputError
from cluster_slam.geometry import so3_exp
from tracking.errors import CovarianceError
from tracking.gating import chi2_threshold, mahalanobis_sq
from tracking.unscented import SigmaRule, fifth_degree, unscented_transform

SEEDS = st.integers(0, 2**32 - 1)
SQUARE = np.array([[1.0, 0, 0], [-1.0, 0, 0], [0, 1.0, 0], [0, -1.0, 0]])


def cluster(rng: np.random.Generator, n: int, size: float = 0.1) -> np.ndarray:
    return size * rng.random((n, 3))


def correlated(rng: np.random.Generator, n: int, sigma: float) -> np.ndarray:
    a = rng.standard_normal((3 * n, 3 * n)) / np.sqrt(3 * n)
    return sigma**2 * (a @ a.T + 0.1 * np.eye(3 * n))


def relative_error(cov: np.ndarray, expected: np.ndarray) -> float:
    """Largest entry of the difference in units of the standard deviations."""
    sigma = np.sqrt(np.diagonal(expected))
    return float(np.abs((cov - expected) / np.outer(sigma, sigma)).max())


def test_by_hand() -> None:
    np.testing.assert_allclose(inertia_and_mean_distance(3.0 * SQUARE + 7.0), [36.0, 3.0])
    np.testing.assert_allclose(inertia_and_mean_distance(np.array([[0, 0, 0], [0, 0, 3.0]])), [4.5, 1.5])
    np.testing.assert_allclose(distance_and_axes(SQUARE), [1.0, np.sqrt(0.5), np.sqrt(0.5), 0.0], atol=1e-15)


@given(st.integers(2, 8), SEEDS, st.booleans())
def test_motion_order_and_mirror_change_nothing(n: int, seed: int, is_mirrored: bool) -> None:
    rng = np.random.default_rng(seed)
    points = cluster(rng, n)
    moved = points @ so3_exp(rng.uniform(-3, 3, 3)).T * (-1.0 if is_mirrored else 1.0)
    moved = rng.permutation(moved + rng.uniform(-0.3, 0.3, 3))
    expected = inertia_and_mean_distance(points)
    np.testing.assert_allclose(inertia_and_mean_distance(moved), expected, rtol=1e-12)
    mean, cov = closed_form_moments(points, 0.004)
    other_mean, other_cov = closed_form_moments(moved, 0.004)
    np.testing.assert_allclose(other_mean, mean, rtol=1e-12)
    np.testing.assert_allclose(other_cov, cov, rtol=1e-11)


def test_ten_metres_away_is_the_same() -> None:
    rng = np.random.default_rng(0)
    points = cluster(rng, 5)
    far = points + np.array([10.0, -10.0, 10.0])
    for describe in (
        lambda p: closed_form_moments(p, 0.01),
        lambda p: descriptor_moments(p, isotropic(5, 0.01)),
        lambda p: unscented_moments(p, isotropic(5, 0.01)),
        lambda p: unscented_moments(p, isotropic(5, 0.01), SigmaRule(1e-3)),
    ):
        (mean, cov), (far_mean, far_cov) = describe(points), describe(far)
        np.testing.assert_allclose(far_mean, mean, rtol=1e-9)
        np.testing.assert_allclose(far_cov, cov, rtol=1e-6)


def test_single_precision_input_is_computed_in_double() -> None:
    points = cluster(np.random.default_rng(1), 4)
    mean, cov = unscented_moments(points.astype(np.float32), isotropic(4, 0.01).astype(np.float32), SigmaRule(1e-3))
    expected_mean, expected_cov = unscented_moments(points, isotropic(4, 0.01), SigmaRule(1e-3))
    assert mean.dtype == cov.dtype == np.float64
    np.testing.assert_allclose(mean, expected_mean, rtol=1e-5)
    np.testing.assert_allclose(cov, expected_cov, rtol=1e-5)


@pytest.mark.parametrize(("n", "sigma"), [(2, 0.01), (3, 0.003), (4, 0.02), (6, 0.01)])
def test_closed_forms_against_a_million_draws(n: int, sigma: float) -> None:
    rng = np.random.default_rng(n)
    points = cluster(rng, n)
    draws = np.concatenate(
        [inertia_and_mean_distance(points + sigma * rng.standard_normal((100_000, n, 3))) for _ in range(10)]
    )
    mean, cov = closed_form_moments(points, sigma)
    assert (np.abs(draws.mean(0) - mean) < 5 * np.sqrt(np.diag(cov) / len(draws))).all()
    assert relative_error(np.cov(draws.T), cov) < 0.01


def test_general_moments_against_a_million_draws() -> None:
    rng = np.random.default_rng(11)
    points, cov = cluster(rng, 4), correlated(rng, 4, 0.012)
    factor = np.linalg.cholesky(cov)
    draws = np.concatenate(
        [
            inertia_and_mean_distance(points + (rng.standard_normal((100_000, 12)) @ factor.T).reshape(-1, 4, 3))
            for _ in range(10)
        ]
    )
    mean, expected = descriptor_moments(points, cov)
    assert (np.abs(draws.mean(0) - mean) < 5 * np.sqrt(np.diag(expected) / len(draws))).all()
    assert relative_error(np.cov(draws.T), expected) < 0.01


@given(st.integers(2, 7), st.floats(1e-4, 0.1), SEEDS)
def test_general_moments_are_the_closed_form_where_that_applies(n: int, sigma: float, seed: int) -> None:
    points = cluster(np.random.default_rng(seed), n)
    mean, cov = closed_form_moments(points, sigma)
    got_mean, got_cov = descriptor_moments(points, isotropic(n, sigma))
    np.testing.assert_allclose(got_mean, mean, rtol=1e-10)
    np.testing.assert_allclose(got_cov, cov, rtol=1e-7)


@given(st.integers(3, 6), SEEDS)
def test_an_error_that_all_flowers_share_changes_nothing(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, cov = cluster(rng, n), correlated(rng, n, 0.004)
    shared = np.tile(0.02**2 * np.eye(3), (n, n))
    for describe in (descriptor_moments, unscented_moments):
        mean, expected = describe(points, cov)
        got_mean, got = describe(points, cov + shared)
        np.testing.assert_allclose(got_mean, mean, rtol=1e-9)
        np.testing.assert_allclose(got, expected, rtol=1e-6)


@pytest.mark.parametrize("alpha", [1e-2, 0.3, 1.0])
@given(n=st.integers(2, 6), beta=st.floats(0.0, 3.0), sigma=st.floats(0.002, 0.05), seed=SEEDS)
def test_the_unscented_variance_of_the_inertia(alpha: float, n: int, beta: float, sigma: float, seed: int) -> None:
    """4 s^2 I + beta d^2 s^4, d = 3 (n - 1), for any alpha; exact with beta = 2 / d."""
    points = cluster(np.random.default_rng(seed), n)
    inertia, d = inertia_and_mean_distance(points)[0], 3 * (n - 1)
    mean, cov = unscented_moments(points, isotropic(n, sigma), SigmaRule(alpha, beta))
    assert mean[0] == pytest.approx(inertia + d * sigma**2, rel=1e-10)
    assert cov[0, 0] == pytest.approx(4 * sigma**2 * inertia + beta * d**2 * sigma**4, rel=1e-9)
    factor = sigma * np.kron(np.eye(n) - 1.0 / n, np.eye(3))
    assert inertia_beta(factor, SigmaRule(alpha)) == pytest.approx(2 / d, rel=1e-9)


@given(st.integers(2, 6), st.sampled_from([0.1, 1.0]), SEEDS)
def test_the_chosen_beta_makes_the_inertias_variance_true(n: int, alpha: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    points, cov = cluster(rng, n), correlated(rng, n, 0.02)
    rule = SigmaRule(alpha)
    flat = (points - points.mean(0)).ravel()
    centring = np.kron(np.eye(n) - 1.0 / n, np.eye(3))
    AP = centring @ cov
    true = 4 * flat @ cov @ flat + 2 * np.trace(AP @ AP)
    factor = centring @ np.linalg.cholesky(cov)
    beta = inertia_beta(factor, rule)
    _, got = unscented_transform(flat, cov, lambda x: (x * x).sum(-1, keepdims=True), rule, beta, factor)
    assert got[0, 0] == pytest.approx(true, rel=1e-8)
    assert unscented_moments(points, cov)[1][0, 0] == pytest.approx(true, rel=1e-9)
    assert descriptor_moments(points, cov)[1][0, 0] == pytest.approx(true, rel=1e-9)


@given(st.integers(3, 6), SEEDS)
def test_the_transform_is_the_closed_form_within_one_percent(n: int, seed: int) -> None:
    """Where it applies: no flower within 25 sigma of the centroid, where the distance has its kink."""
    points = cluster(np.random.default_rng(seed), n)
    sigma = 0.04 * float(np.linalg.norm(points - points.mean(0), axis=1).min())
    mean, cov = closed_form_moments(points, sigma)
    got_mean, got = unscented_moments(points, isotropic(n, sigma))
    assert (np.abs(got_mean - mean) < 0.01 * np.sqrt(np.diag(cov))).all()
    np.testing.assert_allclose(got, cov, rtol=0.01)


def test_the_fifth_degree_rule_reaches_one_percent_at_a_tenth_of_the_radius() -> None:
    rng = np.random.default_rng(3)
    for n in (3, 6):
        points = rng.standard_normal((n, 3))
        radius = np.sqrt(inertia_and_mean_distance(points)[0] / n)
        mean, cov = closed_form_moments(points, 0.1 * radius)
        flat = points.ravel()
        got_mean, got = fifth_degree(
            flat, isotropic(n, 0.1 * radius), lambda x, n=n: inertia_and_mean_distance(x.reshape(*x.shape[:-1], n, 3))
        )
        assert (np.abs(got_mean - mean) < 0.01 * np.sqrt(np.diag(cov))).all()
        np.testing.assert_allclose(got, cov, rtol=0.01)


def test_the_length_of_a_gaussian_vector_by_numerical_integration() -> None:
    def density(r: float, m: float, s: float) -> float:  # of |y|, y ~ N(u, s^2 I), |u| = m
        return (
            r / (m * s * np.sqrt(2 * np.pi)) * (np.exp(-0.5 * ((r - m) / s) ** 2) - np.exp(-0.5 * ((r + m) / s) ** 2))
        )

    for m, s in ((0.05, 0.01), (0.01, 0.01), (0.001, 0.01), (1.0, 0.3)):
        expected = integrate.quad(lambda r, m=m, s=s: r * density(r, m, s), 0, m + 12 * s)[0]
        got = radial_length(np.array(m), np.array(s))
        assert m + got.excess == pytest.approx(expected, rel=1e-9)
        step = 1e-5 * s
        up, down = radial_length(np.array(m + step), np.array(s)), radial_length(np.array(m - step), np.array(s))
        assert got.slope == pytest.approx(1 + (up.excess - down.excess) / (2 * step), rel=1e-6)
        assert got.curvature == pytest.approx((up.slope - down.slope) / (2 * step), rel=1e-5)


def test_the_length_of_a_coincident_flower_is_smooth_at_zero() -> None:
    s = np.array(0.01)
    at_zero, near = radial_length(np.array(0.0), s), radial_length(np.array(1.001e-5), s)
    assert at_zero.excess == pytest.approx(0.01 * np.sqrt(8 / np.pi))  # Maxwell's mean
    assert at_zero.slope_ratio == pytest.approx(near.slope_ratio, rel=1e-6)
    assert at_zero.curvature == pytest.approx(near.curvature, rel=1e-5)


@given(SEEDS)
def test_the_length_for_any_covariance_has_the_derivatives_it_claims(seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.standard_normal((3, 3))
    u, S = rng.standard_normal(3), a @ a.T + 0.02 * np.eye(3)

    def mean(x: np.ndarray) -> float:
        return float(np.linalg.norm(x) + length(x, S).excess)

    step = 1e-4
    axes = step * np.eye(3)
    got = length(u, S)
    np.testing.assert_allclose(got.gradient, [(mean(u + e) - mean(u - e)) / (2 * step) for e in axes], atol=1e-6)
    rows = [(length(u + e, S).gradient - length(u - e, S).gradient) / (2 * step) for e in axes]
    np.testing.assert_allclose(got.hessian, rows, atol=1e-5)


def test_coincident_and_collinear_flowers_have_true_moments() -> None:
    rng = np.random.default_rng(7)
    line = np.array([[0.0, 0, 0], [0.03, 0, 0], [0.08, 0, 0]])
    for points in (np.zeros((3, 3)), line, np.concatenate([line, line[:1]])):
        mean, cov = closed_form_moments(points, 0.01)
        draws = inertia_and_mean_distance(points + 0.01 * rng.standard_normal((400_000, len(points), 3)))
        assert (np.abs(draws.mean(0) - mean) < 5 * np.sqrt(np.diag(cov) / len(draws))).all()
        assert relative_error(np.cov(draws.T), cov) < 0.02
        unscented_moments(points, isotropic(len(points), 0.01))


@pytest.mark.parametrize(("n", "radius"), [(3, 3), (3, 20), (4, 6), (5, 3), (6, 20), (8, 3), (8, 8)])
def test_the_gate_of_two_noisy_observations_holds_what_it_says(n: int, radius: float) -> None:
    """94 to 97.5 % for a nominal 95 %; without the observation's own covariance it would be 78 to 88 %."""
    rng = np.random.default_rng(100 * n + int(radius))
    points = rng.standard_normal((6000, n, 3))
    points -= points.mean(1, keepdims=True)
    points *= radius / np.sqrt((points**2).sum((1, 2)) / n)[:, None, None]
    a, b = (points + rng.standard_normal(points.shape) for _ in range(2))
    descriptor = InertiaDistance()
    reference, observed = descriptor.describe(a, isotropic(n, 1.0)), descriptor.describe(b, isotropic(n, 1.0))
    threshold = chi2_threshold(2, 0.95)
    share = (descriptor.compare(reference, observed).distance_sq <= threshold).mean()
    assert 0.94 <= share <= 0.975
    paper = paper_descriptor().describe(a, isotropic(n, 1.0))
    alone = mahalanobis_sq(inertia_and_mean_distance(b) - paper.mean, paper.cov) <= threshold
    assert 0.77 <= alone.mean() <= 0.885


def test_missing_members_are_searched_for() -> None:
    rng = np.random.default_rng(8)
    points = cluster(rng, 5)
    cov, part = isotropic(5, 0.002), isotropic(4, 0.002)
    seen = points[[0, 1, 3, 4]]
    for descriptor in (InertiaDistance(), distance_axes_descriptor()):
        out = compare_with_missing(descriptor, points, cov, seen, part)
        assert out.distance_sq == pytest.approx(0.0, abs=1e-12)
        assert compare_with_missing(descriptor, seen, part, points, cov).distance_sq == pytest.approx(0.0, abs=1e-12)
    chosen, covs = subsets(points, np.diag(np.arange(15.0)), 4)
    assert chosen.shape == (5, 4, 3)
    np.testing.assert_array_equal(np.diag(covs[1]), [0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 13, 14])  # without member 3


def test_lengths_that_differ_are_refused() -> None:
    rng = np.random.default_rng(9)
    descriptor = distance_axes_descriptor()
    three, five = (
        descriptor.describe(cluster(rng, 3), isotropic(3, 0.01)),
        descriptor.describe(cluster(rng, 5), isotropic(5, 0.01)),
    )
    with pytest.raises(InputError, match="3 and 5 flowers"):
        descriptor.compare(three, five)


def test_two_flowers_have_one_distance() -> None:
    rng = np.random.default_rng(10)
    a, b = cluster(rng, 2), cluster(rng, 2)
    for descriptor in (InertiaDistance(), distance_axes_descriptor()):
        one, two = (descriptor.describe(p, isotropic(2, 0.001)) for p in (a, b))
        assert one.value.shape == (1,)
        assert one.dof == 1
        difference = 0.5 * (np.linalg.norm(a[1] - a[0]) - np.linalg.norm(b[1] - b[0]))
        # var of half a distance: s^2 / 2 each
        assert descriptor.compare(one, two).distance_sq == pytest.approx(difference**2 / 0.001**2, rel=0.01)


def test_joint_covariances() -> None:
    rng = np.random.default_rng(12)
    blocks = np.array([[np.diag(rng.random(3)) for _ in range(4)] for _ in range(2)])
    joint = block_diagonal(blocks)
    assert joint.shape == (2, 12, 12)
    np.testing.assert_array_equal(joint[1, 3:6, 3:6], blocks[1, 1])
    assert np.count_nonzero(joint) == 24


@pytest.mark.parametrize(
    ("points", "words"),
    [
        (np.zeros((1, 3)), "at least 2 flowers, the cluster has 1"),
        (np.zeros((3, 2)), "got shape"),
        (np.array([[0, 0, 0], [np.nan, 0, 1.0]]), "not finite"),
    ],
)
def test_bad_points(points: np.ndarray, words: str) -> None:
    for describe in (closed_form_moments, lambda p, s: unscented_moments(p, isotropic(len(p), s))):
        with pytest.raises(InputError, match=words):
            describe(points, 0.01)


def test_bad_errors_of_the_members() -> None:
    points = cluster(np.random.default_rng(13), 3)
    for sigma in (0.0, -0.01, float("nan")):
        with pytest.raises(InputError, match="sigma"):
            closed_form_moments(points, sigma)
    indefinite = isotropic(3, 0.01)
    indefinite[0, 0] = -1e-4
    for describe in (unscented_moments, descriptor_moments):
        with pytest.raises(CovarianceError, match=r"smallest eigenvalue -0\.0001"):
            describe(points, indefinite)
