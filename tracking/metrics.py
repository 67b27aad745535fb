"""How good labels and sets of points are against the truth: identity scores, HOTA, GOSPA.

Labels are compared row by row: row k is one detection, known to be the same in the truth and in the estimate, so
localisation is exact and only identities are judged. The id -1 marks clutter in either.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
CLUTTER = -1


@dataclass(frozen=True, slots=True, eq=False)
class IdentityScores:
    """Identity scores of a whole session (Ristani 2016), and the one-to-one matching of ids behind them."""

    n_idtp: int  # rows whose true and estimated id are matched to each other
    n_idfp: int  # rows that carry an estimated id, and are not among n_idtp
    n_idfn: int  # rows of true objects that are not among n_idtp
    true_ids: IntArray  # (p,) matched ids, increasing; pairs that share at least one row
    estimated_ids: IntArray  # (p,) the partner of each

    @property
    def idf1(self) -> float:
        """2 IDTP / (2 IDTP + IDFP + IDFN); 1 where there is nothing to find and nothing was found."""
        return _ratio(2 * self.n_idtp, 2 * self.n_idtp + self.n_idfp + self.n_idfn)

    @property
    def precision(self) -> float:
        """IDTP / (IDTP + IDFP)."""
        return _ratio(self.n_idtp, self.n_idtp + self.n_idfp)

    @property
    def recall(self) -> float:
        """IDTP / (IDTP + IDFN)."""
        return _ratio(self.n_idtp, self.n_idtp + self.n_idfn)


@dataclass(frozen=True, slots=True)
class HotaScores:
    """Higher-order tracking accuracy and its two factors: hota = sqrt(detection * association)."""

    hota: float
    detection: float  # DetA
    association: float  # AssA


@dataclass(frozen=True, slots=True)
class GospaScores:
    """GOSPA and its parts, each already raised to 1/p and so in the unit of the points; p-th powers add up."""

    total: float
    localisation: float
    missed: float
    false: float
    n_missed: int
    n_false: int


def identity_scores(true_ids: IntArray, estimated_ids: IntArray) -> IdentityScores:
    """Identity scores of labels, with the matching of ids that maximises the rows in agreement.

    Parameters
    ----------
    true_ids, estimated_ids : (m,) int
        What each row is and what it was taken for; -1 is clutter. Ids of the two need not be alike.

    Raises
    ------
    ValueError
        The two differ in length.

    Notes
    -----
    Ristani, Solera, Zou, Cucchiara, Tomasi, "Performance measures and a data set for multi-target, multi-camera
    tracking" (2016), equations 4 to 8. As the rows are the same, a wrong id costs one false positive and one false
    negative.
    """
    table = _contingency(true_ids, estimated_ids)
    i, j = linear_sum_assignment(table.counts, maximize=True)
    shared = table.counts[i, j]
    n_idtp, kept = int(shared.sum()), shared > 0
    n_true, n_estimated = int(table.true_rows.sum()), int(table.estimated_rows.sum())
    return IdentityScores(
        n_idtp, n_estimated - n_idtp, n_true - n_idtp, table.true_ids[i[kept]], table.estimated_ids[j[kept]]
    )


def hota(true_ids: IntArray, estimated_ids: IntArray) -> HotaScores:
    """HOTA of labels; as each detection is exactly where it is, all localisation thresholds give the same.

    Parameters
    ----------
    true_ids, estimated_ids : (m,) int
        What each row is and what it was taken for; -1 is clutter.

    Raises
    ------
    ValueError
        The two differ in length.

    Notes
    -----
    Luiten et al., "HOTA: a higher order metric for evaluating multi-object tracking" (2021), equations 14 to 17. A
    score is 1 where there is nothing to find and nothing was found.
    """
    table = _contingency(true_ids, estimated_ids)
    n_tp = int(table.counts.sum())
    n_either = int(table.true_rows.sum() + table.estimated_rows.sum()) - n_tp
    detection = _ratio(n_tp, n_either)
    i, j = np.nonzero(table.counts)
    tpa = table.counts[i, j].astype(np.float64)
    jaccard = tpa / (table.true_rows[i] + table.estimated_rows[j] - tpa)
    association = float((tpa * jaccard).sum() / n_tp) if n_tp else float(n_either == 0)
    return HotaScores(float(np.sqrt(detection * association)), detection, association)


def gospa(true_points: Array, estimated_points: Array, cutoff: float, order: float = 2.0) -> GospaScores:
    """GOSPA with alpha = 2: distances of the points assigned, cutoff^p / 2 for each point missed or false.

    Parameters
    ----------
    true_points, estimated_points : (n, d), (m, d)
        Points in one frame, one unit.
    cutoff : float
        Above this distance two points are not the same, in the unit of the points; greater than 0.
    order : float
        The exponent p, at least 1.

    Raises
    ------
    ValueError
        A cutoff or an order out of range.

    Notes
    -----
    Rahmathullah, Garcia-Fernandez, Svensson, "Generalized optimal sub-pattern assignment metric" (2017), equation 1
    and proposition 1 (alpha = 2).
    """
    if not cutoff > 0 or not order >= 1:
        raise ValueError(f"cutoff must be above 0 and order at least 1, not {cutoff} and {order}")
    n, m = len(true_points), len(estimated_points)
    difference = true_points.reshape(n, 1, -1) - estimated_points.reshape(1, m, -1) if n and m else np.zeros((n, m, 1))
    cost = np.minimum(np.sqrt((difference * difference).sum(-1)), cutoff) ** order
    i, j = linear_sum_assignment(cost)
    near = cost[i, j][cost[i, j] < cutoff**order]
    n_missed, n_false = n - len(near), m - len(near)
    parts = float(near.sum()), n_missed * cutoff**order / 2, n_false * cutoff**order / 2
    root = 1.0 / order
    return GospaScores(sum(parts) ** root, parts[0] ** root, parts[1] ** root, parts[2] ** root, n_missed, n_false)


@dataclass(frozen=True, slots=True, eq=False)
class _Contingency:
    """How many rows each pair of ids shares, and how many rows each id has."""

    true_ids: IntArray  # (a,)
    estimated_ids: IntArray  # (b,)
    counts: IntArray  # (a, b)
    true_rows: IntArray  # (a,)
    estimated_rows: IntArray  # (b,)


def _contingency(true_ids: IntArray, estimated_ids: IntArray) -> _Contingency:
    true_ids, estimated_ids = np.asarray(true_ids, np.int64), np.asarray(estimated_ids, np.int64)
    if true_ids.shape != estimated_ids.shape or true_ids.ndim != 1:
        raise ValueError(f"labels must be two rows of one length, not {true_ids.shape} and {estimated_ids.shape}")
    is_true, is_estimated = true_ids != CLUTTER, estimated_ids != CLUTTER
    a, true_rows = np.unique(true_ids[is_true], return_counts=True)
    b, estimated_rows = np.unique(estimated_ids[is_estimated], return_counts=True)
    both = is_true & is_estimated
    cell = np.searchsorted(a, true_ids[both]) * len(b) + np.searchsorted(b, estimated_ids[both])
    counts = np.bincount(cell, minlength=len(a) * len(b)).reshape(len(a), len(b))
    return _Contingency(a, b, counts.astype(np.int64), true_rows.astype(np.int64), estimated_rows.astype(np.int64))


def _ratio(part: float, whole: float) -> float:
    return float(part / whole) if whole else 1.0
