"""Few colours for many clusters, so that neighbours differ."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

# Okabe and Ito (2008): told apart with all common kinds of colour blindness; yellow and black left out, the lighter
# ones darkened for white paper. The page has the same ones as --c0 to --c5.
PALETTE = ("#0072b2", "#d55e00", "#00855f", "#b85f92", "#3596d1", "#b97700")
_NEIGHBOURS = 5  # one fewer than there are colours


def colour_indices(positions: Array) -> IntArray:
    """An index into the palette for each position (n, 3): that of the fewest near neighbours, then the least used."""
    n = len(positions)
    out = np.full(n, -1, dtype=np.int64)
    if not n:
        return out
    _, nearest = cKDTree(positions).query(positions, k=min(_NEIGHBOURS + 1, n))
    near = np.zeros((n, n), dtype=bool)
    near[np.repeat(np.arange(n), np.size(nearest) // n), np.ravel(nearest)] = True
    near |= near.T
    for i in range(n):
        conflicts = np.bincount(out[near[i] & (out >= 0)], minlength=len(PALETTE))
        used = np.bincount(out[out >= 0], minlength=len(PALETTE))
        out[i] = (conflicts * (n + 1) + used).argmin()
    return out
