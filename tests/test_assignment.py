"""One-to-one assignment against brute force."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import tracking.assignment as module
from tracking.assignment import assign, unassigned
from tracking.errors import ParameterError


def brute_force(cost: np.ndarray, max_cost: float) -> float:
    """The least sum of (cost - max_cost) over partial one-to-one maps."""
    if cost.shape[0] > cost.shape[1]:
        cost = cost.T
    r, c = cost.shape
    gain = np.minimum(np.where(np.isnan(cost), np.inf, cost) - max_cost, 0.0)
    return min((sum(gain[i, p[i]] for i in range(r)) for p in permutations(range(c), r)), default=0.0)


@given(st.integers(0, 4), st.integers(0, 5), st.integers(0, 2**32 - 1))
def test_the_sum_is_the_least(r: int, c: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    cost = rng.uniform(0, 2, (r, c))
    cost[rng.random((r, c)) < 0.2] = np.inf
    cost[rng.random((r, c)) < 0.1] = np.nan
    rows, cols = assign(cost, 1.0)
    assert len(set(rows.tolist())) == len(rows) == len(set(cols.tolist()))
    assert (cost[rows, cols] < 1.0).all()
    assert (cost[rows, cols] - 1.0).sum() == pytest.approx(brute_force(cost, 1.0), abs=1e-12)


@settings(max_examples=30)
@given(st.integers(1, 40), st.integers(1, 40), st.integers(0, 2**32 - 1))
def test_components_change_nothing(r: int, c: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    cost = rng.uniform(0, 20, (r, c))
    whole = assign(cost, 1.0)
    gain = np.minimum(cost - 1.0, 0.0)
    rows, cols = module._by_components(gain)
    assert gain[rows, cols].sum() == pytest.approx(gain[whole].sum(), abs=1e-12)
    assert len(set(rows.tolist())) == len(rows)


@settings(max_examples=30)
@given(st.integers(1, 30), st.integers(1, 30), st.integers(0, 2**32 - 1))
def test_pairs_had_at_once_change_nothing(r: int, c: int, seed: int) -> None:
    """Among many that no other competes with."""
    cost = np.random.default_rng(seed).uniform(0, 20, (r, c))
    gain = np.minimum(cost - 1.0, 0.0)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(module, "SPLIT_ABOVE", 3)
        rows, cols = module._split(gain)
    assert (gain[rows, cols] < 0.0).all()
    assert gain[rows, cols].sum() == pytest.approx(gain[module._solve(gain)].sum(), abs=1e-12)
    assert len(set(rows.tolist())) == len(rows) == len(set(cols.tolist()))


def test_a_large_sparse_problem_is_split_and_quick() -> None:
    rng = np.random.default_rng(0)
    cost = np.where(rng.random((600, 700)) < 0.002, rng.random((600, 700)), np.inf)
    rows, cols = assign(cost, 0.9)
    assert (np.diff(rows) > 0).all()
    r, c = module._solve(np.minimum(cost - 0.9, 0.0))
    assert (cost[rows, cols] - 0.9).sum() == pytest.approx((cost[r, c] - 0.9).sum())


def test_a_joint_assignment_beats_a_greedy_one() -> None:
    # greedy takes (0, 0) at 1 and leaves row 1 with nothing; jointly both are matched
    rows, cols = assign(np.array([[1.0, 2.0], [1.5, 9.0]]), 5.0)
    assert cols.tolist() == [1, 0]
    assert rows.tolist() == [0, 1]


def test_missed_and_new_are_explicit() -> None:
    rows, cols = assign(np.array([[9.0, 0.1], [9.0, 9.0]]), 1.0)
    assert (rows.tolist(), cols.tolist()) == ([0], [1])
    assert unassigned(rows, 2).tolist() == [1]
    assert unassigned(cols, 2).tolist() == [0]


def test_a_cost_at_the_limit_is_not_taken() -> None:
    assert len(assign(np.array([[1.0]]), 1.0)[0]) == 0


def test_nothing_to_assign() -> None:
    for shape in ((0, 0), (0, 3), (3, 0)):
        assert [len(x) for x in assign(np.zeros(shape), 1.0)] == [0, 0]


def test_bad_input() -> None:
    with pytest.raises(ParameterError, match="matrix"):
        assign(np.zeros(3), 1.0)
    with pytest.raises(ParameterError, match="max_cost"):
        assign(np.zeros((1, 1)), np.inf)
    with pytest.raises(ParameterError, match="-inf"):
        assign(np.array([[-np.inf]]), 1.0)


def test_ties_are_the_same_each_time() -> None:
    first = assign(np.zeros((60, 60)), 1.0)
    again = assign(np.zeros((60, 60)), 1.0)
    np.testing.assert_array_equal(first, again)
