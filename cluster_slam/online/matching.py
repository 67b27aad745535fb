"""Matches of flowers and points in one frame, one to one within a chi-square gate."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from cluster_slam.association.frames import chi2_and_log_det
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

_NONE: IntArray = np.zeros(0, dtype=np.int64)


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Flowers (q,) and points (q,) that belong together, with their chi-square (q,)."""

    rows: IntArray
    cols: IntArray
    chi2: Array


def match(predicted: Array, predicted_cov: Array, points: Array, cov: Array, gate_chi2: float) -> Matches:
    """The one-to-one matches that gain most; a pair inside the gate gains gate - chi2 - log det (matching likelihood).

    Parameters
    ----------
    predicted, predicted_cov : (f, 3), (f, 3, 3) where flowers should be.
    points, cov : (p, 3), (p, 3, 3) what is seen.
    gate_chi2 : of three degrees of freedom.
    """
    if len(predicted) == 0 or len(points) == 0:
        return Matches(_NONE, _NONE, np.zeros(0))
    gap = points[None] - predicted[:, None]
    spread = np.einsum("fii->f", predicted_cov)[:, None] + np.einsum("pii->p", cov)
    rows, cols = np.nonzero(np.einsum("fpi,fpi->fp", gap, gap) < gate_chi2 * spread)
    if len(rows) == 0:
        return Matches(_NONE, _NONE, np.zeros(0))
    chi2, log_det = chi2_and_log_det(gap[rows, cols], predicted_cov[rows] + cov[cols])
    inside = chi2 < gate_chi2
    rows, cols, chi2, log_det = rows[inside], cols[inside], chi2[inside], log_det[inside]
    if len(rows) == 0:
        return Matches(_NONE, _NONE, np.zeros(0))
    some_rows, r = np.unique(rows, return_inverse=True)
    some_cols, k = np.unique(cols, return_inverse=True)
    gain, known = np.zeros((2, len(some_rows), len(some_cols)))
    # The widest of the gates is the reference: every pair inside gains something, tight predictions gain more.
    gain[r, k] = gate_chi2 - chi2 + (log_det.max() - log_det) + 1e-9
    known[r, k] = chi2
    a, b = linear_sum_assignment(gain, maximize=True)
    real = gain[a, b] > 0
    a, b = a[real], b[real]
    return Matches(some_rows[a], some_cols[b], known[a, b])
