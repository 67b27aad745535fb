"""Many frames at once: what lies in one frame has one lane number, and only what shares a lane can meet.

Frames of stretches that do not depend on each other are worked on together, so that each step of a method is one call
for all of them. Tables are flat: one row a thing, sorted by lane.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.optimize import linear_sum_assignment

from cluster_slam.association.frames import chi2_and_log_det
from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

_STRETCH = 2.0  # times its run-up: of a stretch


@dataclass(frozen=True, slots=True, eq=False)
class Lanes:
    """Stretches of frames to follow: at step k lane a is in frame ``first[a] + k * way[a]``."""

    first: IntArray
    way: IntArray  # 1 forwards, -1 backwards
    run_up: IntArray  # steps whose outcome is thrown away
    length: IntArray  # steps in all

    @classmethod
    def of(cls, stamps: Array, run_up_s: float, *, both_ways: bool) -> Lanes:
        """A session in stretches of about the same number of frames, forwards, or forwards and then backwards."""
        n = len(stamps)
        in_run_up = np.arange(n) - np.searchsorted(stamps, stamps - run_up_s)
        usual = max(float(np.median(in_run_up)), 1.0)  # frames; a pause of hours is no reason to cut the session finer
        count = int(np.clip(n / (_STRETCH * usual), 1, n))
        bounds = np.arange(count + 1) * n // count
        begin, end = bounds[:-1], bounds[1:]
        before = np.searchsorted(stamps, stamps[begin] - run_up_s)
        after = np.searchsorted(stamps, stamps[end - 1] + run_up_s, side="right") - 1
        forwards = cls(before, np.ones(count, dtype=np.int64), begin - before, end - before)
        if not both_ways:
            return forwards
        return cls(
            first=np.concatenate([before, after]),
            way=np.repeat([1, -1], count),
            run_up=np.concatenate([forwards.run_up, after - end + 1]),
            length=np.concatenate([forwards.length, after - begin + 1]),
        )

    def at(self, k: int) -> IntArray:
        """Frame (a,) of every lane at step k; before the first and after the last step that of the nearest."""
        step: IntArray = self.first + np.clip(k, 0, self.length - 1) * self.way
        return step


def ranges(start: IntArray, count: IntArray) -> IntArray:
    """Concatenated ranges: start[0], start[0] + 1 ... (count[0] of them), start[1] ..."""
    offset = np.cumsum(count) - count
    return np.asarray(np.arange(int(count.sum())) + np.repeat(start - offset, count))


def pairs_in_lanes(a_lane: IntArray, b_lane: IntArray, n_lanes: int) -> tuple[IntArray, IntArray]:
    """All pairs (rows, columns) of things a and b in the same lane; both must be sorted by lane."""
    n_b = np.bincount(b_lane, minlength=n_lanes)
    start = np.cumsum(n_b) - n_b
    count = n_b[a_lane]
    return np.repeat(np.arange(len(a_lane)), count), ranges(start[a_lane], count)


def sums(values: Array, group: IntArray, n_groups: int) -> Array:
    """Sums (n_groups, ...) of values (q, ...) by group (q,)."""
    out = np.zeros((n_groups, *values.shape[1:]))
    if len(values):
        order = np.argsort(group, kind="stable")
        starts = run_starts(group[order])
        out[group[order[starts]]] = np.add.reduceat(values[order], starts, axis=0)
    return out


def run_starts(keys: IntArray) -> IntArray:
    """Where each run of equal keys (q,) begins; q is at least one."""
    begins = np.empty(len(keys), dtype=bool)
    begins[0] = True
    np.not_equal(keys[1:], keys[:-1], out=begins[1:])
    return begins.nonzero()[0]


def near_pairs(
    predicted: Array, reach_var: Array, lane: IntArray, points: Array, var: Array, point_lane: IntArray, n_lanes: int
) -> tuple[IntArray, IntArray]:
    """Pairs (rows, columns) in one lane with a squared distance below ``reach_var`` (r,) + ``var`` (c,), m^2."""
    rows, cols = pairs_in_lanes(lane, point_lane, n_lanes)
    far_sq = np.zeros(len(rows))
    for axis in range(3):
        step = points[cols, axis] - predicted[rows, axis]
        far_sq += step * step
    near = far_sq < reach_var[rows] + var[cols]
    return rows[near], cols[near]


def assign(
    rows: IntArray, cols: IntArray, diff: Array, cov: Array, gate_chi2: float, row_lane: IntArray
) -> tuple[IntArray, IntArray, Array]:
    """One-to-one assignment (rows, columns, chi2) that gains most, where a pair inside the gate gains gate - chi2.

    Candidates are pairs with differences (q, 3) of covariance (q, 3, 3), sorted by row; ``row_lane`` (r,) is sorted.
    """
    chi2, _ = chi2_and_log_det(diff, cov)
    inside = chi2 < gate_chi2
    rows, cols, chi2 = rows[inside], cols[inside], chi2[inside]
    if len(rows) == 0:
        return rows, cols, chi2
    chosen = (np.bincount(rows)[rows] == 1) & (np.bincount(cols)[cols] == 1)
    rest = np.flatnonzero(~chosen)  # the pairs that compete with others
    if len(rest):
        row = rows[rest]
        r = np.cumsum(np.diff(row, prepend=row[0]) != 0)
        c = np.unique(cols[rest], return_inverse=True)[1]
        starts = [*run_starts(row_lane[row]).tolist(), len(rest)]
        gain = gate_chi2 - chi2[rest]
        for first, last in pairwise(starts):
            here = slice(first, last)
            chosen[rest[here]] = _taken(r[here] - r[first], c[here] - c[here].min(), gain[here])
    return rows[chosen], cols[chosen], chi2[chosen]


def _taken(r: IntArray, c: IntArray, gain: Array) -> BoolArray:
    """Which of the pairs (q,) of rows and columns are taken so that their gains sum to the most."""
    table = np.zeros((int(r[-1]) + 1, int(c.max()) + 1))
    table[r, c] = gain
    a, b = linear_sum_assignment(table, maximize=True)
    partner = np.full(len(table), -1)
    partner[a] = b
    return np.asarray(partner[r] == c)
