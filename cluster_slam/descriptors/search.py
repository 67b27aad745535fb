"""All one-to-one maps between the members of two clusters that could pass a gate: exact, by breadth-first search.

The members of the first cluster are placed one after another, outermost first. The residual of the best rigid
alignment of those placed so far can only grow, and two placed members whose distance changed by x leave at least
x^2 / 2; so every partial map beyond the limit is dropped with all that would follow from it. Many pairs of clusters
are searched at once.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cluster_slam.descriptors.alignment import largest_overlap
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

MISSED = -1
MAX_STATES = 400_000  # partial maps kept at once; beyond it the best are, and the answer is no longer certain
ROUNDING = 1e-11  # of the squared radius


@dataclass(frozen=True, slots=True, eq=False)
class Maps:
    """Complete maps that may pass; as `search_maps` returns them, by pair and then best bound first."""

    pair: IntArray  # (s,)
    partner: IntArray  # (s, n) member of the second cluster, or MISSED
    bound: Array  # (s,) never above the map's true cost


@dataclass(slots=True, eq=False)
class _States:
    """Partial maps with the sums that the residual of their alignment needs."""

    pair: IntArray  # (s,)
    partner: IntArray  # (s, n) in the order in which members are placed
    used: NDArray[np.bool_]  # (s, m)
    count: Array  # (s,)
    sums: Array  # (16, s): sum a, sum b, sum a b' (9), sum |a|^2 + |b|^2
    bound: Array  # (s,)

    def joined(self, other: _States) -> _States:
        """Both."""
        return _States(
            np.concatenate([self.pair, other.pair]),
            np.concatenate([self.partner, other.partner]),
            np.concatenate([self.used, other.used]),
            np.concatenate([self.count, other.count]),
            np.concatenate([self.sums, other.sums], axis=1),
            np.concatenate([self.bound, other.bound]),
        )


def search_maps(a: Array, b: Array, var: Array, limit: Array, missed_cost: float = np.inf) -> Maps:
    """Maps of a (p, n, 3) into b (p, m, 3) whose cost does not exceed `limit` (p,); `var` (p,) of a residual.

    The cost is residual / var + missed_cost * (members of both without partner). With an infinite `missed_cost` all
    members of a are placed, which wants n <= m, and members of b that stay alone cost nothing.
    """
    found = _search(a - a.mean(-2, keepdims=True), b - b.mean(-2, keepdims=True), var, limit, missed_cost)
    best = np.lexsort((found.bound, found.pair))
    return Maps(found.pair[best], found.partner[best], found.bound[best])


def _search(a: Array, b: Array, var: Array, limit: Array, missed_cost: float) -> Maps:
    """The same unordered. A batch that grows too large is searched half by half."""
    order = np.argsort(-(a * a).sum(-1), axis=-1, kind="stable")
    problem = _Problem(np.take_along_axis(a, order[..., None], axis=1), b, var, limit, missed_cost)
    states = problem.start()
    for level in range(a.shape[1]):
        states = problem.extend(states, level)
        if len(states.pair) > MAX_STATES and len(a) > 1:
            half = len(a) // 2
            one = _search(a[:half], b[:half], var[:half], limit[:half], missed_cost)
            two = _search(a[half:], b[half:], var[half:], limit[half:], missed_cost)
            pair = np.concatenate([one.pair, two.pair + half])
            return Maps(pair, np.concatenate([one.partner, two.partner]), np.concatenate([one.bound, two.bound]))
        states = _thinned(states)
    partner = np.empty_like(states.partner)
    np.put_along_axis(partner, order[states.pair], states.partner, axis=1)
    return Maps(states.pair, partner, states.bound)


class _Problem:
    """Pairs of clusters with the distances among their members."""

    def __init__(self, a: Array, b: Array, var: Array, limit: Array, missed_cost: float) -> None:
        self.a, self.b, self.var, self.limit, self.missed_cost = a, b, var, limit, missed_cost
        self.inner_a = np.linalg.norm(a[:, :, None] - a[:, None], axis=-1)
        self.inner_b = np.linalg.norm(b[:, :, None] - b[:, None], axis=-1)
        self.squares_a, self.squares_b = (a * a).sum(-1), (b * b).sum(-1)
        self.slack = ROUNDING * (self.squares_a.sum(-1) + self.squares_b.sum(-1))

    def start(self) -> _States:
        """Nothing placed yet."""
        p, n, m = len(self.a), self.a.shape[1], self.b.shape[1]
        partner, used = np.full((p, n), MISSED, np.int64), np.zeros((p, m), dtype=bool)
        return _States(np.arange(p), partner, used, np.zeros(p), np.zeros((16, p)), np.zeros(p))

    def extend(self, states: _States, level: int) -> _States:
        """Place the next member: at each partner that is free and near enough, and nowhere if that is allowed."""
        parent, choice = np.nonzero(self._compatible(states, level))
        placed = self._place(states, parent, choice, level)
        if np.isfinite(self.missed_cost):
            skipped = self._kept(states, np.arange(len(states.pair)), states.count, states.sums, level)
            return placed.joined(skipped)
        return placed

    def _compatible(self, states: _States, level: int) -> NDArray[np.bool_]:
        """Partners that are free and whose distances to all placed before could be within the limit (s, m)."""
        ok = ~states.used
        spare = np.sqrt(2.0 * (self.limit * self.var + self.slack))[states.pair, None]
        for before in range(level):
            partner = states.partner[:, before]
            wanted = self.inner_a[states.pair, level, before]
            change = self.inner_b[states.pair, partner] - wanted[:, None]  # MISSED takes the last row, then is let off
            ok &= (np.abs(change) <= spare) | (partner == MISSED)[:, None]
        return ok

    def _place(self, states: _States, parent: IntArray, choice: IntArray, level: int) -> _States:
        pair = states.pair[parent]
        x, y = self.a[pair, level].T, self.b[pair, choice].T
        sums = states.sums[:, parent]
        sums[:3] += x
        sums[3:6] += y
        sums[6:15] += (x[:, None] * y[None]).reshape(9, -1)
        sums[15] += self.squares_a[pair, level] + self.squares_b[pair, choice]
        return self._kept(states, parent, states.count[parent] + 1.0, sums, level, choice)

    def _kept(
        self,
        states: _States,
        parent: IntArray,
        count: Array,
        sums: Array,
        level: int,
        choice: IntArray | None = None,
    ) -> _States:
        """The children that are within the limit."""
        pair = states.pair[parent]
        bound = self._bound(pair, count, sums, level)
        keep = np.flatnonzero(bound <= self.limit[pair])
        partner, used = states.partner[parent[keep]], states.used[parent[keep]]
        if choice is not None:
            partner[:, level] = choice[keep]
            used[np.arange(len(keep)), choice[keep]] = True
        return _States(pair[keep], partner, used, count[keep], sums[:, keep], bound[keep])

    def _bound(self, pair: IntArray, count: Array, sums: Array, level: int) -> Array:
        """Residual of the best alignment of those placed, in units of var, and the price of those left alone."""
        k = np.maximum(count, 1.0)
        sa, sb = sums[:3], sums[3:6] / k
        H = sums[6:15] - (sa[:, None] * sb[None]).reshape(9, -1)
        spread = sums[15] - (sa * sa).sum(0) / k - (sb * sb).sum(0) * k
        bound: Array = np.maximum(spread - 2.0 * largest_overlap(H) - self.slack[pair], 0.0) / self.var[pair]
        if np.isfinite(self.missed_cost):
            to_come = self.a.shape[1] - 1 - level
            alone = (level + 1 - count) + np.maximum(self.b.shape[1] - count - to_come, 0.0)
            bound = bound + self.missed_cost * alone
        return bound


def _thinned(states: _States) -> _States:
    if len(states.pair) <= MAX_STATES:
        return states
    keep = np.sort(np.argpartition(states.bound, MAX_STATES)[:MAX_STATES])
    s = states
    return _States(s.pair[keep], s.partner[keep], s.used[keep], s.count[keep], s.sums[:, keep], s.bound[keep])
