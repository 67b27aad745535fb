"""Unknowns that last for a while, eliminated as time goes on: dense fronts, chunk after chunk.

A front is the information of all that meets in a chunk of frames. What ends there is eliminated; what goes on is
carried into the next one with all that it has become connected with.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

_NONE = np.empty(0, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Unknowns:
    """Columns of a front, in this order: stretches that end here, those that go on, places, and what is common."""

    ended: IntArray
    later: IntArray
    places: IntArray  # sorted
    n_common: int

    @property
    def n_blocks(self) -> int:
        """How many blocks of three columns there are before the common ones."""
        return len(self.ended) + len(self.later) + len(self.places)

    def of_places(self, places: IntArray) -> IntArray:
        """Blocks of places."""
        return len(self.ended) + len(self.later) + np.searchsorted(self.places, places)

    def of_stretches(self, stretches: IntArray) -> IntArray:
        """Blocks of stretches, which must be among them."""
        alive = np.concatenate([self.ended, self.later])
        order = np.argsort(alive)
        return order[np.searchsorted(alive[order], stretches)]


@dataclass(frozen=True, slots=True, eq=False)
class Carried:
    """Rows (3 c, 3 c + 3 a + common) of the stretches that go on, by themselves, the places and what is common."""

    stretches: IntArray  # (c,)
    places: IntArray  # (a,)
    rows: Array

    @classmethod
    def nothing(cls, n_common: int) -> Carried:
        """No stretch goes on."""
        return cls(_NONE, _NONE, np.zeros((0, n_common)))

    def add_to(self, H: Array, unknowns: Unknowns) -> None:
        """Into the information of the next chunk."""
        if len(self.stretches) == 0:
            return
        own = _columns(unknowns.of_stretches(self.stretches))
        common = np.arange(3 * unknowns.n_blocks, 3 * unknowns.n_blocks + unknowns.n_common)
        rest = np.concatenate([_columns(unknowns.of_places(self.places)), common])
        n = len(own)
        H[np.ix_(own, own)] += self.rows[:, :n]
        H[np.ix_(own, rest)] += self.rows[:, n:]
        H[np.ix_(rest, own)] += self.rows[:, n:].T


@dataclass(frozen=True, slots=True, eq=False)
class Front:
    """Stretches that ended in a chunk, eliminated."""

    ended: IntArray  # (e,)
    later: IntArray  # (c,) those that go on
    places: IntArray  # (a,)
    lower: Array  # (3 e, 3 e) Cholesky factor
    by: Array  # (3 e, 3 c + 3 a + common) what they depend on, the vector last

    def solved(self, known: Array) -> Array:
        """Values (e, 3) of the ended, given those of all else."""
        if len(self.ended) == 0:
            return np.empty((0, 3))
        right = self.by[:, -1] - self.by[:, :-1] @ known
        return np.asarray(solve_triangular(self.lower, right, lower=True, trans="T")).reshape(-1, 3)


def eliminate(H: Array, unknowns: Unknowns) -> tuple[Front, Carried, Array]:
    """Eliminate what ends: the front, what is carried on, and what is left of places and common ones."""
    e, c = 3 * len(unknowns.ended), 3 * len(unknowns.later)
    lower: Array = np.empty((0, 0))
    by: Array = np.empty((0, len(H)))
    if e:
        lower = np.asarray(np.linalg.cholesky(H[:e, :e]), dtype=np.float64)
        by = np.asarray(solve_triangular(lower, H[:e, e:], lower=True))
        H = H[e:, e:] - by.T @ by
    front = Front(unknowns.ended, unknowns.later, unknowns.places, lower, by)
    places = unknowns.places if c else _NONE
    return front, Carried(unknowns.later, places, H[:c] if c else np.zeros((0, unknowns.n_common))), H[c:, c:]


def _columns(blocks: IntArray) -> IntArray:
    return np.asarray((3 * blocks[:, None] + np.arange(3)).ravel())
