"""One-to-one assignment with explicit missed and new: who belongs to whom, and who to nobody."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from tracking.errors import ParameterError
from tracking.gaussian import Array

IntArray = NDArray[np.int64]
SPLIT_ABOVE = 2500  # entries; below, looking for components costs more than it saves


def assign(cost: Array, max_cost: float) -> tuple[IntArray, IntArray]:
    """The pairs of least total cost, where leaving a row missed and a column new together costs `max_cost`.

    Minimises the sum over chosen pairs of (cost - max_cost). Pairs that cost `max_cost` or more, or NaN, are never
    chosen. Equal inputs give equal outputs; a tie goes where the solver finds it first in row order.

    Parameters
    ----------
    cost
        (r, c); inf or NaN where a pair is not admissible.
    max_cost
        Cost of one missed row with one new column.

    Returns
    -------
    rows, cols
        (k,) each, rows increasing. `unassigned(rows, r)` are missed, `unassigned(cols, c)` are new.

    Raises
    ------
    ParameterError
        `cost` is not a matrix or holds -inf, or `max_cost` is not finite.
    """
    cost = np.asarray(cost, dtype=float)
    if cost.ndim != 2:
        raise ParameterError(f"costs must be a matrix, got shape {cost.shape}")
    if not np.isfinite(max_cost):
        raise ParameterError(f"max_cost must be finite, got {max_cost}")
    gain = np.where(cost < max_cost, cost, max_cost) - max_cost  # NaN compares false
    if np.isneginf(gain).any():
        raise ParameterError("a cost of -inf leaves nothing to compare")
    rows, cols = _split(gain)
    order = np.argsort(rows, kind="stable")
    return rows[order], cols[order]


def unassigned(indices: IntArray, n: int) -> IntArray:
    """The indices of 0 ... n - 1 that are not among the given ones, increasing."""
    free = np.ones(n, dtype=bool)
    free[indices] = False
    return np.flatnonzero(free).astype(np.int64)


def _solve(gain: Array) -> tuple[IntArray, IntArray]:
    rows, cols = linear_sum_assignment(gain)
    useful = gain[rows, cols] < 0.0
    return rows[useful].astype(np.int64), cols[useful].astype(np.int64)


def _split(gain: Array) -> tuple[IntArray, IntArray]:
    """Pairs that no other competes with are had at once; what is left of a large problem is far smaller. Exact."""
    if gain.size <= SPLIT_ABOVE:
        return _solve(gain)
    i, j = np.nonzero(gain)
    alone = (np.bincount(i, minlength=1)[i] == 1) & (np.bincount(j, minlength=1)[j] == 1)
    rows, cols = np.unique(i[~alone]), np.unique(j[~alone])
    rest = gain[np.ix_(rows, cols)]
    r, c = _by_components(rest) if rest.size > SPLIT_ABOVE else _solve(rest)
    return np.concatenate([i[alone], rows[r]]), np.concatenate([j[alone], cols[c]])


def _by_components(gain: Array) -> tuple[IntArray, IntArray]:
    """Solve each connected component of the admissible pairs by itself: exact, and far smaller problems."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    n_rows, n_cols = gain.shape
    i, j = np.nonzero(gain)
    n = n_rows + n_cols
    graph = coo_array((np.ones(len(i), dtype=np.int8), (i, j + n_rows)), shape=(n, n))
    n_components, label = connected_components(graph, directed=False)
    by_row, by_col = _members(label[:n_rows], n_components), _members(label[n_rows:], n_components)
    found = [_solve_block(gain, r, c) for r, c in zip(by_row, by_col, strict=True) if len(r) and len(c)]
    if not found:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.concatenate([f[0] for f in found]), np.concatenate([f[1] for f in found])


def _members(label: NDArray[np.int32], n: int) -> list[IntArray]:
    """The members of each of n components, increasing."""
    order = np.argsort(label, kind="stable").astype(np.int64)
    return np.split(order, np.cumsum(np.bincount(label, minlength=n))[:-1])


def _solve_block(gain: Array, rows: IntArray, cols: IntArray) -> tuple[IntArray, IntArray]:
    if len(rows) == 1 and len(cols) == 1:
        return rows, cols
    r, c = _solve(gain[np.ix_(rows, cols)])
    return rows[r], cols[c]
