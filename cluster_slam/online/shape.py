"""The descriptor of a cluster's seen flowers: inertia and mean distance, at rest and as seen, which tell its scale."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cluster_slam.descriptors import inertia_and_mean_distance
from cluster_slam.geometry import Array


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Descriptor (2,) of the seen flowers at rest, and as seen with its covariance (2, 2)."""

    at_rest: Array
    seen: Array
    cov: Array


def measured_by(at_rest: Array) -> Callable[[Array], Array]:
    """What states (s, 8) show: centroid, and inertia and mean distance, which grow with scale squared and scale."""
    powers = np.array([2.0, 1.0])
    return lambda s: np.concatenate([s[:, :3], at_rest * np.exp(powers * s[:, 6:7])], axis=1)


def seen_shape(offsets: Array, points: Array, var: Array) -> Shape | None:
    """Descriptor of the seen flowers: at rest from ``offsets`` (k, 3), as seen from ``points`` (k, 3), noise taken out.

    ``var`` (k,) are the variances of the points along an axis, m^2. To first order in the noise, and its mean to the
    second: E[inertia] has 3 (k - 1) / k sum var more than the truth, each distance r about var / r more.
    """
    k = len(offsets)
    if k < 3:
        return None
    r = points - points.mean(0)
    length = np.sqrt((r * r).sum(1))
    if (length < 1e-9).any():
        return None
    share = 1.0 - 1.0 / k
    inertia, distance = inertia_and_mean_distance(points)
    seen = np.array([inertia - 3.0 * share * var.sum(), distance - share * float((var / length).mean())])
    unit = r / length[:, None]
    slope = np.stack([2.0 * r, (unit - unit.mean(0)) / k])  # (2, k, 3)
    cov = np.einsum("aki,k,bki->ab", slope, var, slope)
    cov[0, 0] += 6.0 * float((var * var).sum())
    cov[1, 1] += float((var * var / length**2).sum()) / k**2
    cov += np.diag(1e-6 * np.diag(cov))
    at_rest = inertia_and_mean_distance(offsets)
    return Shape(np.asarray(at_rest, np.float64), seen, cov)
