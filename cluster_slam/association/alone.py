"""Single observations of clusters that sway: one flower alone proves little, so something else must support it.

Where a cluster is off its rest and only one of its flowers was matched in a frame, the prediction is wide and a false
detection or a neighbour's flower may fit as well. Such a match stands if both directions of time found it, or if it
lies where the frames before and after have the cluster.
"""

from __future__ import annotations

import numpy as np

from cluster_slam.association.displacement import cluster_pairs, measured_displacements
from cluster_slam.association.frames import Frames, chi2_and_log_det
from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

_NEAR_S = 0.15  # frames so near say where the cluster is ...
_BEND = 0.3  # ... to so much of its displacement: it does not move along a line


def without_support(
    frames: Frames,
    T: Array,
    places: Array,
    cluster: IntArray,
    landmark: IntArray,
    agree: BoolArray,
    rest_sigma_m: float,
    gate_chi2: float,
) -> BoolArray:
    """Observations (m,) that stand alone, far from rest, and that nothing supports.

    Poses T (n, 4, 4), places (l, 3) with their cluster (l,), landmark (m,) of each observation; ``agree`` (m,): both
    directions of time found it.
    """
    pair, frame, of = cluster_pairs(frames, landmark, cluster)
    if len(frame) == 0:
        return np.zeros(len(frames), dtype=bool)
    d, cov = measured_displacements(frames, T, landmark, places, pair, len(frame))
    used = pair >= 0
    count = np.bincount(pair[used], minlength=len(frame))
    agreed = np.bincount(pair[used], agree[used], minlength=len(frame)) > 0
    at_rest = chi2_and_log_det(d, cov + rest_sigma_m**2 * np.eye(3))[0] < gate_chi2
    trusted = (count > 1) | agreed | at_rest
    doubtful = np.flatnonzero(~trusted)
    stands = _interpolated_chi2(doubtful, trusted, d, cov, frames.stamps[frame], of) < gate_chi2
    out = np.zeros(len(frame), dtype=bool)
    out[doubtful[~stands]] = True
    unsupported: BoolArray = used & out[pair]
    return unsupported


def _interpolated_chi2(which: IntArray, trusted: BoolArray, d: Array, cov: Array, stamps: Array, of: IntArray) -> Array:
    """Distances (q,) of displacements from the line between trusted ones before and after; inf where none is near."""
    order = np.lexsort((stamps, of))
    order = order[trusted[order]]
    key = of * (stamps.max() - stamps.min() + 10.0 * _NEAR_S) + (stamps - stamps.min())  # clusters lie far apart
    at = np.searchsorted(key[order], key[which])
    before, after = order[np.maximum(at - 1, 0)], order[np.minimum(at, len(order) - 1)]
    gap_before, gap_after = key[which] - key[before], key[after] - key[which]
    near = (gap_before > 0) & (gap_before < _NEAR_S) & (gap_after > 0) & (gap_after < _NEAR_S)
    share = (gap_before / np.where(near, gap_before + gap_after, 1.0))[:, None]
    expected = (1.0 - share) * d[before] + share * d[after]
    bend = _BEND**2 * np.maximum((d[before] ** 2).sum(-1), (d[after] ** 2).sum(-1))
    S = cov[which] + cov[before] + cov[after] + bend[:, None, None] * np.eye(3)
    chi2, _ = chi2_and_log_det(d[which] - expected, S)
    return np.where(near, chi2, np.inf)
