"""Scoring after a gap: the closed form against numerical integration, and probabilities against enumeration."""

from __future__ import annotations

from itertools import permutations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from tracking.reid import Background, Groups, association_probabilities, same_group

PLAIN = Background(log_density=np.log(1e4), log_group_density=np.log(10.0), n_new=0.2)


def groups(points: np.ndarray, sigma: float) -> Groups:
    points = np.atleast_3d(points) if points.ndim == 3 else points[None]
    return Groups(points, np.full(points.shape[:2], sigma**2), np.ones(points.shape[:2], dtype=bool))


def test_the_offset_is_integrated_out() -> None:
    """One dimension of the closed form by brute force: the log ratio differs from the integral by nothing."""
    rng = np.random.default_rng(1)
    known = rng.normal(0.0, 0.03, (4, 2))
    seen = known + np.array([0.004, -0.003]) + rng.normal(0.0, 0.002, (4, 2))
    sigma, drift, p = 0.002, 0.005, 0.9
    found = same_group(groups(seen, 0.0014), groups(known, 0.0014), np.array([drift**2]), np.full((1, 4), p), PLAIN)
    assert found.partner[0].tolist() == [0, 1, 2, 3]
    v = 2 * 0.0014**2
    grid = np.linspace(-0.03, 0.03, 2001)
    x, y = np.meshgrid(grid, grid)
    log = -(x**2 + y**2) / (2 * drift**2) - np.log(2 * np.pi * drift**2)
    for r in seen - known:
        log += -((r[0] - x) ** 2 + (r[1] - y) ** 2) / (2 * v) - np.log(2 * np.pi * v)
    same = np.log(np.exp(log - log.max()).sum()) + log.max() + 2 * np.log(grid[1] - grid[0]) + 4 * np.log(p) - 0.2
    another = PLAIN.log_group_density + 3 * PLAIN.log_density
    np.testing.assert_allclose(found.log_ratio[0], same - another, atol=1e-6)
    assert sigma < drift


def test_missing_and_new_members_cost_what_they_should() -> None:
    known = np.array([[0.0, 0, 0], [0.03, 0, 0], [0, 0.03, 0], [0, 0, 0.03]])
    seen, var = np.full((1, 4), 0.9), np.array([1e-6])
    full = same_group(groups(known, 0.001), groups(known, 0.001), var, seen, PLAIN)
    less = same_group(groups(known[:3], 0.001), groups(known, 0.001), var, seen, PLAIN)
    more = np.concatenate([known, [[0.2, 0.2, 0.2]]])
    extra = same_group(groups(more, 0.001), groups(known, 0.001), var, seen, PLAIN)
    assert less.partner[0].tolist() == [0, 1, 2]
    assert extra.partner[0].tolist() == [0, 1, 2, 3, -1]
    # one more unknown flower: n_new * density against density
    np.testing.assert_allclose(extra.log_ratio - full.log_ratio, np.log(PLAIN.n_new), atol=1e-9)


@given(st.integers(0, 50))
def test_the_same_shape_elsewhere_is_found(seed: int) -> None:
    """Whatever the common offset within the drift, members keep their partners, in any order."""
    rng = np.random.default_rng(seed)
    known = rng.normal(0.0, 0.03, (5, 3))
    order = rng.permutation(5)
    seen = known[order] + rng.normal(0.0, 0.02, 3) + rng.normal(0.0, 0.0005, (5, 3))
    found = same_group(groups(seen, 0.001), groups(known, 0.001), np.array([0.02**2]), np.full((1, 5), 0.9), PLAIN)
    assert found.partner[0].tolist() == order.tolist()


def exact(ratio: np.ndarray) -> np.ndarray:
    """Marginals by going through all one-to-one associations."""
    n, m = ratio.shape
    total, pairs = 0.0, np.zeros((n, m))
    for columns in set(permutations([*range(m), *([-1] * n)], n)):
        weight = np.prod([ratio[i, j] for i, j in enumerate(columns) if j >= 0])
        total += weight
        for i, j in enumerate(columns):
            if j >= 0:
                pairs[i, j] += weight
    return pairs / total


def test_one_pair_is_exact() -> None:
    pairs, new, gone = association_probabilities(np.array([[np.log(3.0)]]))
    np.testing.assert_allclose([pairs[0, 0], new[0], gone[0]], [0.75, 0.25, 0.25])


@given(st.integers(0, 30))
def test_probabilities_are_close_to_enumeration(seed: int) -> None:
    log_ratio = np.random.default_rng(seed).normal(0.0, 3.0, (3, 3))
    pairs, new, _ = association_probabilities(log_ratio)
    np.testing.assert_allclose(pairs.sum(axis=1) + new, 1.0, atol=1e-9)
    difference = np.abs(pairs - exact(np.exp(log_ratio)))
    assert difference.max() < 0.3  # loops of three that compete at even odds
    assert difference.mean() < 0.1


def test_what_is_not_admissible_has_no_probability() -> None:
    pairs, new, gone = association_probabilities(np.array([[-np.inf, 2.0], [-np.inf, -np.inf]]))
    assert pairs[0, 0] == pairs[1, 0] == pairs[1, 1] == 0.0
    assert new[1] == 1.0
    assert gone[0] == 1.0
