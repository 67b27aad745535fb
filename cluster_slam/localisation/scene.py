"""What one frame shows, ready to be matched, and how large its errors are taken to be."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.depth_noise import stretched
from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray


@dataclass(frozen=True, slots=True)
class ErrorScale:
    """What is believed of the errors of a recording; sessions learn it from their own frames."""

    flower_variance: float = 1.0  # times the stated covariances of the points
    sway_m: float = 0.002  # of a cluster from rest, one sigma an axis
    touched_share: float = 0.03  # of the clusters: touched of late, they swing ...
    touched_m: float = 0.02  # ... about so far, one sigma an axis
    detection: float = 0.8  # probability that a flower in view is detected
    unmapped: float = 0.2  # share of the points that the map does not have: false ones, new flowers
    pose_variance: float = 1.0  # times the stated covariances of the given poses or steps
    depth_powers: tuple[float, float] = (0.0, 0.0)  # with which stated sigmas grow with depth, along the ray and across


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """Points of one frame with their covariances."""

    points: Array  # (n, 3) camera, m
    covs: Array  # (n, 3, 3) m^2, with the variance factor in
    sigma: Array  # (n,) root mean square an axis, m

    def __len__(self) -> int:
        return len(self.points)


def make_look(points: Array, covs: Array, scale: ErrorScale) -> Look:
    """A look from points (n, 3) and their stated covariances (n, 3, 3).

    Raises
    ------
    InputError
        A value is not finite or a covariance is not positive definite: the message names the point.
    """
    points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
    covs = np.asarray(covs, dtype=np.float64).reshape(-1, 3, 3) * scale.flower_variance
    for name, values in (("position", points), ("covariance", covs.reshape(-1, 9))):
        bad = ~np.isfinite(values).all(axis=1)
        if bad.any():
            raise InputError(f"the {name} of point {int(bad.argmax())} of the frame is not finite")
    if len(covs) != len(points):
        raise InputError(f"{len(points)} points with {len(covs)} covariances, expected one each")
    smallest = np.linalg.eigvalsh(covs)[:, 0] if len(covs) else np.ones(1)
    if smallest.min() <= 0:
        k = int(smallest.argmin())
        raise InputError(f"the covariance of point {k} is not positive definite (eigenvalue {smallest[k]:.3g})")
    return Look(points, covs, np.sqrt(covs.trace(axis1=1, axis2=2) / 3.0))


def covs_at(look: Look, rows: IntArray, depth: Array, scale: ErrorScale) -> Array:
    """Covariances (m, 3, 3) of points ``rows`` as stated for the depths (m,) where their flowers are expected, m.

    At the depth that was measured, points that came out too near would count for more than those too far.
    """
    covs = look.covs[rows]
    ahead = (look.points[rows, 2] > 0) & (depth > 0)
    if scale.depth_powers == (0.0, 0.0) or not ahead.all():
        return covs
    return stretched(look.points[rows], covs, depth, scale.depth_powers)
