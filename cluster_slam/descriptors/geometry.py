"""The full-geometry test: best one-to-one matching of members and best rigid motion, chi-square with 3 n - 6."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from itertools import permutations

import numpy as np

from cluster_slam.descriptors.members import checked_points
from cluster_slam.geometry import Array, kabsch, transform
from cluster_slam.records import IntArray
from tracking.gating import mahalanobis_sq


@dataclass(frozen=True, slots=True, eq=False)
class GeometryMatch:
    """The best matching of two clusters' members."""

    distance_sq: float  # squared Mahalanobis distance of the residuals
    dof: int  # 3 k - 6
    reference: IntArray  # (k,) matched members of the reference
    observed: IntArray  # (k,) their partners
    T_observed_reference: Array  # (4, 4) takes reference points onto observed ones


def match_geometry(reference: Array, observed: Array, covs: Array) -> GeometryMatch:
    """Match points (n, 3) with points (m, 3), n, m >= 3: all of the smaller set are matched.

    `covs` (3, 3): covariance of a residual.
    """
    a, b = checked_points(reference, 3), checked_points(observed, 3)
    swapped = len(a) > len(b)
    few, many = (b, a) if swapped else (a, b)
    choices = _injections(len(few), len(many))
    best = choices[int(np.argmin(_residuals(few, many[choices])))]
    own = np.arange(len(few), dtype=np.int64)
    i, j = (best, own) if swapped else (own, best)
    T = kabsch(a[i], b[j])
    residual = b[j] - transform(T, a[i])
    return GeometryMatch(float(mahalanobis_sq(residual, covs).sum()), 3 * len(i) - 6, i, j, T)


@lru_cache(maxsize=32)
def _injections(k: int, n: int) -> IntArray:
    return np.array(list(permutations(range(n), k)), dtype=np.int64)


def _residuals(a: Array, b: Array) -> Array:
    """Least squares residuals (...) of rigid alignment of a (k, 3) with b (..., k, 3)."""
    a = a - a.mean(0)
    b = b - b.mean(-2, keepdims=True)
    H = a.T @ b
    s = np.linalg.svd(H, compute_uv=False)
    sign = np.where(np.linalg.det(H) < 0, -1.0, 1.0)
    out: Array = (a * a).sum() + (b * b).sum((-1, -2)) - 2.0 * (s[..., 0] + s[..., 1] + sign * s[..., 2])
    return out
