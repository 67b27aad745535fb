"""The full-geometry test: against brute force, chi-square, missing members, correlated errors."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

import cluster_slam.descriptors.search as search_module
from cluster_slam.descriptors import (
    Background,
    FullGeometry,
    calibrated_threshold,
    compare_with_missing,
    isotropic,
    match_geometries,
    match_geometry,
)
from cluster_slam.descriptors.alignment import align, align_isotropic, largest_overlap, rigid_fit
from cluster_slam.errors import InputError
from cluster_slam.geometry import kabsch, so3_exp, transform
from tracking.errors import CovarianceError, ParameterError

SEEDS = st.integers(0, 2**32 - 1)


def cluster(rng: np.random.Generator, n: int) -> np.ndarray:
    """Flowers 15 to 80 mm apart."""
    points = rng.uniform(-0.05, 0.05, (1, 3))
    while len(points) < n:
        p = rng.uniform(-0.05, 0.05, 3)
        if np.linalg.norm(points - p, axis=1).min() > 0.015:
            points = np.vstack([points, p])
    return points


def brute_force(a: np.ndarray, b: np.ndarray) -> float:
    """Least residual over all maps of the smaller set."""
    if len(a) > len(b):
        a, b = b, a
    best = np.inf
    for choice in permutations(range(len(b)), len(a)):
        partners = b[list(choice)]
        best = min(best, float(((partners - transform(kabsch(a, partners), a)) ** 2).sum()))
    return best


@settings(max_examples=40, deadline=None)
@given(st.integers(2, 5), st.integers(2, 5), SEEDS)
def test_the_best_map_is_that_of_brute_force(n: int, m: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.random((n, 3)), rng.random((m, 3))
    expected = brute_force(a, b) / 0.02
    one = match_geometry(a, isotropic(n, 0.1), b, isotropic(m, 0.1))
    many = match_geometries(a[None], b[None], np.sqrt(0.02))
    assert one.distance_sq == pytest.approx(expected, rel=1e-9, abs=1e-10)
    assert many.distance_sq[0] == pytest.approx(expected, rel=1e-9, abs=1e-10)
    assert len(one.reference) == len(set(one.observed.tolist())) == min(n, m)
    moved = transform(one.T_observed_reference, a[one.reference])
    assert ((moved - b[one.observed]) ** 2).sum() / 0.02 == pytest.approx(expected, rel=1e-9, abs=1e-10)


@given(st.integers(2, 6), SEEDS)
def test_motion_and_order_change_nothing(n: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = cluster(rng, n), cluster(rng, n)
    order = rng.permutation(n)
    moved = (b @ so3_exp(rng.uniform(-3, 3, 3)).T + rng.uniform(-10, 10, 3))[order]
    one = match_geometry(a, isotropic(n, 0.01), b, isotropic(n, 0.01))
    two = match_geometry(a, isotropic(n, 0.01), moved, isotropic(n, 0.01))
    turned = match_geometry(moved, isotropic(n, 0.01), a, isotropic(n, 0.01))
    assert two.distance_sq == pytest.approx(one.distance_sq, rel=1e-8, abs=1e-9)
    assert turned.distance_sq == pytest.approx(one.distance_sq, rel=1e-8, abs=1e-9)
    assert two.log_likelihood == pytest.approx(one.log_likelihood, rel=1e-6)


def test_a_mirrored_cluster_is_another_one() -> None:
    rng = np.random.default_rng(0)
    a = cluster(rng, 6)
    out = match_geometry(a, isotropic(6, 0.001), -a, isotropic(6, 0.001))
    assert out.distance_sq > 100.0
    three = match_geometry(a[:3], isotropic(3, 0.001), -a[:3], isotropic(3, 0.001))
    assert three.distance_sq == pytest.approx(0.0, abs=1e-9)  # a triangle turns over in space


def test_a_square_and_a_rectangle_by_hand() -> None:
    # sides 2 x 2 against 2 x 4, aligned about the common centre: each corner is off by 1
    square = np.array([[1.0, 1, 0], [-1, 1, 0], [-1, -1, 0], [1, -1, 0]])
    rectangle = square * [2.0, 1.0, 1.0]
    out = match_geometry(square, isotropic(4, 0.3), rectangle, isotropic(4, 0.4))
    assert out.distance_sq == pytest.approx(4 / 0.25)
    assert out.dof == 6


@pytest.mark.parametrize(("n", "is_general"), [(2, False), (3, False), (5, False), (4, True), (6, True)])
def test_distances_of_true_matches_are_chi_square(n: int, is_general: bool) -> None:
    """Members 25 sigma apart or more, so that no other map interferes."""
    rng = np.random.default_rng(n)
    trials = 150 if is_general else 800
    points = 1.5 * cluster(rng, n)
    cov_a = cov_b = isotropic(n, 6e-4)
    if is_general:
        factors = [6e-4 * rng.standard_normal((3 * n, 3 * n)) / np.sqrt(3 * n) for _ in range(2)]
        cov_a, cov_b = (f @ f.T + 1e-8 * np.eye(3 * n) for f in factors)
    R = so3_exp(rng.uniform(-2, 2, 3))
    found = []
    for _ in range(trials):
        a = points + (np.linalg.cholesky(cov_a) @ rng.standard_normal(3 * n)).reshape(n, 3)
        b = (points @ R.T) + 1.0 + (np.linalg.cholesky(cov_b) @ rng.standard_normal(3 * n)).reshape(n, 3)
        found.append(match_geometry(a, cov_a, b, cov_b))
    dof = 1 if n == 2 else 3 * n - 6
    assert {match.dof for match in found} == {dof}
    assert stats.kstest([match.distance_sq for match in found], stats.chi2(dof).cdf).pvalue > 1e-3


def test_the_general_alignment_is_the_isotropic_one_where_that_applies() -> None:
    rng = np.random.default_rng(1)
    a, b = rng.random((7, 5, 3)), rng.random((7, 5, 3))
    cov = np.broadcast_to(isotropic(5, 0.1), (7, 15, 15))
    general, quick = align(a, cov, b, cov), align_isotropic(a, b, np.full(7, 0.02))
    np.testing.assert_allclose(general.T, quick.T, atol=1e-6)
    np.testing.assert_allclose(general.distance_sq, quick.distance_sq, rtol=1e-9)
    np.testing.assert_allclose(general.log_likelihood, quick.log_likelihood, rtol=1e-9)


def test_the_general_alignment_is_at_a_minimum() -> None:
    rng = np.random.default_rng(2)
    a = cluster(rng, 5)
    f = 0.004 * rng.standard_normal((2, 15, 15))
    cov_a, cov_b = f @ np.swapaxes(f, 1, 2) + 1e-6 * np.eye(15)
    b = a @ so3_exp(np.array([0.3, -1.0, 0.5])).T + 0.004 * rng.standard_normal((5, 3))
    best = align(a, cov_a, b, cov_b)
    R = np.kron(np.eye(5), best.T[:3, :3])
    S = R @ cov_a @ R.T + cov_b  # the covariance at the optimum, held fixed as Gauss-Newton does
    for axis in range(6):
        for step in (-1e-4, 1e-4):
            xi = step * np.eye(6)[axis]
            e = (b - a @ (best.T[:3, :3] @ so3_exp(xi[:3])).T - best.T[:3, 3] - xi[3:]).ravel()
            assert e @ np.linalg.solve(S, e) > best.distance_sq - 1e-6


def test_the_evidence_is_the_integral_over_the_pose() -> None:
    """Two members on a line far apart from a third: Laplace's integral against a plain sum over many rotations."""
    rng = np.random.default_rng(3)
    a = np.array([[0.0, 0, 0], [0.04, 0, 0], [0, 0.06, 0], [0, 0, 0.05]])
    var = 0.004**2
    b = a + 0.002 * rng.standard_normal(a.shape)
    got = align_isotropic(a, b, np.array(var)).log_likelihood
    # translations integrate in closed form; rotations near the best one as a grid of the tangent space
    T = kabsch(a, b)
    grid = np.linspace(-0.5, 0.5, 41)
    w = np.stack(np.meshgrid(grid, grid, grid, indexing="ij"), -1).reshape(-1, 3)
    e = b - b.mean(0) - (a - a.mean(0)) @ np.swapaxes(T[:3, :3] @ so3_exp(w), -1, -2)
    angle = np.linalg.norm(w, axis=1)
    haar = np.where(angle > 1e-9, 2 * (1 - np.cos(angle)) / np.maximum(angle, 1e-9) ** 2, 1.0) / (8 * np.pi**2)
    density = np.exp(-0.5 * (e * e).sum((-1, -2)) / var) * (2 * np.pi * var) ** (-1.5 * 3) / 4**1.5 * haar
    assert got == pytest.approx(np.log(density.sum() * (grid[1] - grid[0]) ** 3), abs=0.02)


def test_overlap_and_fit_against_singular_values() -> None:
    rng = np.random.default_rng(4)
    H = rng.standard_normal((200, 3, 3))
    s = np.linalg.svd(H, compute_uv=False)
    expected = s[:, 0] + s[:, 1] + np.sign(np.linalg.det(H)) * s[:, 2]
    got = largest_overlap(np.moveaxis(H, 0, -1).reshape(9, -1))
    np.testing.assert_allclose(got, expected, rtol=1e-7)
    assert (got >= expected * (1 - 1e-14)).all()
    assert largest_overlap(np.zeros((9, 1)))[0] == 0.0
    a, b = rng.standard_normal((5, 4, 3)), rng.standard_normal((5, 4, 3))
    np.testing.assert_allclose(rigid_fit(a, b)[2], kabsch(a[2], b[2]), atol=1e-12)


def test_members_missing_on_either_side() -> None:
    rng = np.random.default_rng(5)
    points = cluster(rng, 6)
    a, b = points[[0, 1, 2, 3, 4]], points[[5, 4, 3, 2, 1]] + 0.2
    cov = isotropic(5, 5e-4)
    out = match_geometry(a, cov, b, cov, missed_cost=8.0)
    assert out.reference.tolist() == [1, 2, 3, 4]
    assert out.observed.tolist() == [4, 3, 2, 1]
    assert out.distance_sq == pytest.approx(0.0, abs=1e-9)
    whole = match_geometry(a, cov, b, cov)
    assert len(whole.reference) == 5
    assert whole.distance_sq > 50.0


@settings(max_examples=25, deadline=None)
@given(st.integers(3, 4), st.integers(3, 4), st.floats(1.0, 12.0), SEEDS)
def test_the_cheapest_partial_map_is_that_of_brute_force(n: int, m: int, missed_cost: float, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a, b = rng.random((n, 3)), rng.random((m, 3))
    best = (n + m) * missed_cost
    for k in range(2, min(n, m) + 1):
        for i in permutations(range(n), k):
            if list(i) != sorted(i):
                continue
            for j in permutations(range(m), k):
                p, q = a[list(i)], b[list(j)]
                residual = ((q - transform(kabsch(p, q), p)) ** 2).sum() / 0.02
                best = min(best, residual + missed_cost * (n + m - 2 * k))
    out = match_geometry(a, isotropic(n, 0.1), b, isotropic(m, 0.1), missed_cost=missed_cost)
    if np.isfinite(out.distance_sq):
        assert out.distance_sq + missed_cost * (n + m - 2 * len(out.reference)) == pytest.approx(best, abs=1e-8)
    else:
        assert best == pytest.approx((n + m) * missed_cost)


def test_an_error_that_all_members_share_costs_nothing() -> None:
    """A whole cluster swaying by centimetres: the gate still sees millimetres."""
    rng = np.random.default_rng(6)
    a, other = cluster(rng, 5), cluster(rng, 5)
    cov = isotropic(5, 5e-4)
    swaying = cov + np.tile(0.05**2 * np.eye(3), (5, 5))
    b = a + 5e-4 * rng.standard_normal(a.shape) + np.array([0.03, -0.06, 0.04])
    still, swayed = match_geometry(a, cov, b, cov), match_geometry(a, cov, b, swaying)
    assert swayed.distance_sq == pytest.approx(still.distance_sq, rel=1e-3)
    assert match_geometry(other, cov, b, swaying).distance_sq > 100.0


def test_a_limit_only_cuts_off() -> None:
    rng = np.random.default_rng(7)
    a = np.array([cluster(rng, 5) for _ in range(30)])
    b = a + 0.005 * rng.standard_normal(a.shape)
    everything = match_geometries(a, np.roll(b, 1, 0), 0.007).distance_sq
    limit = float(np.median(everything))
    cut = match_geometries(a, np.roll(b, 1, 0), 0.007, limit).distance_sq
    np.testing.assert_allclose(cut[everything < limit], everything[everything < limit])
    assert np.isinf(cut[everything > limit]).all()


def test_batches_that_grow_too_large_are_split(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(8)
    a, b = rng.random((12, 5, 3)), rng.random((12, 5, 3))
    expected = match_geometries(a, b, 0.5)
    monkeypatch.setattr(search_module, "MAX_STATES", 300)
    got = match_geometries(a, b, 0.5)
    np.testing.assert_allclose(got.distance_sq, expected.distance_sq)
    np.testing.assert_allclose(got.runner_up_sq, expected.runner_up_sq)


def test_the_runner_up_tells_how_sure_the_map_is() -> None:
    rng = np.random.default_rng(9)
    points = cluster(rng, 5)
    cov = isotropic(5, 0.001)
    clear = match_geometry(points, cov, points + 0.1, cov)
    assert clear.runner_up_sq > 30.0
    symmetric = np.array([[0.03, 0, 0], [-0.03, 0, 0], [0, 0.03, 0], [0, -0.03, 0]])
    unsure = match_geometry(symmetric, isotropic(4, 0.001), symmetric, isotropic(4, 0.001))
    assert unsure.runner_up_sq == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("kind", ["coincident", "collinear", "two"])
def test_degenerate_shapes_have_more_degrees_of_freedom(kind: str) -> None:
    line = np.array([[0.0, 0, 0], [0.03, 0, 0], [0.08, 0, 0]])
    points = {"coincident": np.zeros((3, 3)), "collinear": line, "two": line[:2]}[kind]
    n = len(points)
    cov = isotropic(n, 1e-4)
    for match in (
        match_geometry(points, cov, points + 1.0, cov),
        match_geometry(points, cov + 1e-14 * np.diag(np.arange(3.0 * n)), points + 1.0, cov),
    ):
        assert match.distance_sq == pytest.approx(0.0, abs=1e-9)
        assert match.dof == {"coincident": 6, "collinear": 4, "two": 1}[kind]
        assert np.isfinite(match.log_likelihood)


def test_as_a_descriptor() -> None:
    rng = np.random.default_rng(10)
    descriptor = FullGeometry()
    points = np.array([cluster(rng, 4) for _ in range(3)])
    cov = isotropic(4, 0.001)
    reference, observed = descriptor.describe(points, cov), descriptor.describe(points[::-1] + 0.3, cov)
    assert reference.dof == 6
    table = descriptor.compare(reference[:, None], observed[None])
    assert table.distance_sq.shape == (3, 3)
    np.testing.assert_array_equal(table.distance_sq < 1e-6, np.eye(3, dtype=bool)[::-1])
    general = descriptor.describe(points, cov + 1e-12 * np.diag(np.arange(12.0)))
    np.testing.assert_allclose(descriptor.compare(reference, general).distance_sq, 0.0, atol=1e-9)
    part = compare_with_missing(descriptor, points[0], cov, points[0, 1:], isotropic(3, 0.001))
    assert part.distance_sq == pytest.approx(0.0, abs=1e-9)
    smaller = descriptor.describe(points[0, 1:], isotropic(3, 0.001))
    assert descriptor.compare(reference[0], smaller).distance_sq == pytest.approx(0.0, abs=1e-9)


def test_a_calibrated_gate_holds_what_it_says_where_the_plain_one_holds_too_much() -> None:
    rng = np.random.default_rng(11)
    shapes = rng.standard_normal((24, 4, 3))
    shapes *= 3.0 / np.sqrt(((shapes - shapes.mean(1, keepdims=True)) ** 2).sum((1, 2)) / 4)[:, None, None]
    plain, calibrated = [], []
    for shape in shapes:
        reference = shape + rng.standard_normal(shape.shape)
        observed = shape + rng.standard_normal((40, *shape.shape))
        d2 = match_geometries(np.broadcast_to(reference, observed.shape), observed, np.sqrt(2.0), 40.0).distance_sq
        plain.append((d2 <= stats.chi2.ppf(0.95, 6)).mean())
        calibrated.append((d2 <= calibrated_threshold(reference, 1.0, 1.0, 0.95, rng=rng)).mean())
    assert np.mean(plain) > 0.985
    assert 0.90 < np.mean(calibrated) < 0.975


def test_the_background_is_fitted_and_normalised() -> None:
    rng = np.random.default_rng(12)
    scales = 0.03 * np.exp(0.4 * rng.standard_normal(3000))
    clusters = [s * rng.standard_normal((int(rng.integers(3, 8)), 3)) for s in scales]
    background = Background.of_clusters(clusters)
    assert background.median_scale == pytest.approx(0.03, rel=0.03)
    assert background.log_spread == pytest.approx(0.4, abs=0.03)
    # two members: the density of their difference, integrated over it (the centre has density 1)
    narrow = Background(0.02, 0.3)
    r = np.linspace(1e-4, 0.4, 4000)
    pairs = np.zeros((len(r), 2, 3))
    pairs[:, 1, 0] = r
    total = (np.exp(narrow.log_density(pairs, 0.01)) * 4 * np.pi * r**2).sum() * (r[1] - r[0])
    assert total == pytest.approx(1.0, rel=1e-3)


def test_bad_input() -> None:
    rng = np.random.default_rng(13)
    a, cov = cluster(rng, 3), isotropic(3, 0.001)
    with pytest.raises(InputError, match="at least 2 flowers"):
        match_geometry(a[:1], isotropic(1, 0.001), a, cov)
    with pytest.raises(InputError, match=r"want a joint covariance \(9, 9\)"):
        match_geometry(a, isotropic(4, 0.001), a, cov)
    with pytest.raises(InputError, match="not finite"):
        match_geometry(a, cov, a * np.nan, cov)
    with pytest.raises(CovarianceError, match="smallest eigenvalue"):
        match_geometry(a, -cov, a, cov)
    with pytest.raises(InputError, match="missed_cost"):
        match_geometry(a, cov, a, cov, missed_cost=0.0)
    with pytest.raises(InputError, match="sigma"):
        match_geometries(a[None], a[None], 0.0)
    with pytest.raises(ParameterError, match=r"\(0, 1\)"):
        calibrated_threshold(a, 0.001, 0.001, 1.0, rng=rng)
    with pytest.raises(InputError, match="scale"):
        Background(0.0, 0.1)
