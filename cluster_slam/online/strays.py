"""Flowers that stand alone have no shape to be searched for when they were touched.

Where such a flower is missed and a point stands nearby that nobody claims, either it was touched since it was last seen
and stands there, or it is missed by chance and the point is something new. The likelier of the two is believed.
"""

from __future__ import annotations

import numpy as np
from scipy.optimize import linear_sum_assignment

from cluster_slam.association.frames import chi2_and_log_det
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray
from tracking.gaussian import LOG_2PI

_TOUCHED = 0.02  # that a flower which is missed was touched in this frame, before the data
_DETECTED = 0.8  # share of the flowers in view that are seen


def find_strays(expected: Array, cov: Array, points: Array, S: Array, density: float) -> tuple[IntArray, IntArray]:
    """The one-to-one pairs of missed flowers and unclaimed points that a touch explains better than chance.

    Parameters
    ----------
    expected, cov : (f, 3), (f, 3, 3) where the missed flowers may be if they were touched, world.
    points, S : (p, 3), (p, 3, 3) what nobody claims, world.
    density : of points that nobody claims, 1 / m^3.

    Returns
    -------
    (k,) flowers and (k,) points.
    """
    chi2, log_det = chi2_and_log_det(points[None] - expected[:, None], cov[:, None] + S[None])
    moved = np.log(_TOUCHED * _DETECTED) - 0.5 * (chi2 + log_det + 3.0 * LOG_2PI)
    odds = np.maximum(moved - np.log((1.0 - _DETECTED) * density), 0.0)
    rows, cols = linear_sum_assignment(odds, maximize=True)
    real = odds[rows, cols] > 0.0
    return rows[real].astype(np.int64), cols[real].astype(np.int64)
