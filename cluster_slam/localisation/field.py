"""The nearest landmark of any point, looked up in a grid: thousands of hypotheses ask for it."""

from __future__ import annotations

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

_MAX_CELLS = 20_000_000
_CELLS_IN_REACH = 5


class NearestField:
    """Index of the landmark nearest to the middle of each cell, where one lies within reach."""

    def __init__(self, positions: Array, reach_m: float) -> None:
        """positions (f, 3), m; beyond ``reach_m`` nothing is found."""
        self.positions = np.vstack([positions, np.full((1, 3), 1e6)])  # the last stands for none
        self.none = len(positions)
        low, high = positions.min(0) - 1.5 * reach_m, positions.max(0) + 1.5 * reach_m
        cell = max(reach_m / _CELLS_IN_REACH, float(np.cbrt(np.prod(high - low) / _MAX_CELLS)))
        self.low, self.per_m = low, 1.0 / cell
        self.shape = np.ceil((high - low) / cell).astype(np.int64) + 1
        self.grid = np.full(self.shape, self.none, np.int32)
        self._fill(positions, reach_m, cell)
        self.flat = self.grid.ravel()
        self.strides = np.array([self.shape[1] * self.shape[2], self.shape[2], 1])

    def _fill(self, positions: Array, reach_m: float, cell: float) -> None:
        half = int(np.ceil(reach_m / cell)) + 1
        best = np.full(self.shape, np.inf, np.float32)
        steps = np.arange(-half, half + 1)
        for index, p in enumerate((positions - self.low) / cell):
            at = np.floor(p).astype(np.int64)
            begin = np.maximum(at - half, 0)
            end = np.minimum(at + half + 1, self.shape)
            sides = [
                (at[a] + steps[(at[a] + steps >= begin[a]) & (at[a] + steps < end[a])] + 0.5 - p[a]) ** 2
                for a in range(3)
            ]
            d2 = sides[0][:, None, None] + sides[1][:, None] + sides[2]
            where = tuple(slice(int(b), int(e)) for b, e in zip(begin, end, strict=True))
            closer = d2 < best[where]
            best[where] = np.where(closer, d2, best[where])
            self.grid[where] = np.where(closer, index, self.grid[where])

    def nearest(self, points: Array) -> IntArray:
        """Landmark (...,) nearest to each of the points (..., 3); ``none`` where there is none in reach."""
        cell = ((points - self.low) * self.per_m).astype(np.int64)
        inside = ((points >= self.low) & (cell < self.shape)).all(-1)
        at = np.where(inside, cell @ self.strides, 0)
        return np.where(inside, self.flat[at], self.none).astype(np.int64)

    def distance_sq(self, points: Array) -> tuple[IntArray, Array]:
        """Nearest landmark (...,) and its squared distance, m^2."""
        index = self.nearest(points)
        off = points - self.positions[index]
        return index, np.einsum("...a,...a->...", off, off)
