"""How much a frame speaks for a pose in the map, against the chance that it shows flowers that the map does not have.

All hypotheses are compared by their marginal likelihood: displacements are integrated in closed form, the pose by
Laplace's method under a prior that is uniform over orientations and over the space about the plant.
"""

from __future__ import annotations

import numpy as np

from cluster_slam.geometry import Array, inverse, transform
from cluster_slam.localisation.fit import LOG_2PI, Fit
from cluster_slam.localisation.landmarks import Landmarks
from cluster_slam.localisation.scene import ErrorScale, Look
from cluster_slam.records import BoolArray, IntArray

_HIDDEN_SHARE = 0.2  # of the clusters in view: behind a leaf


def null_density(marks: Landmarks, look: Look) -> float:
    """Density (1/m^3) of unknown flowers near a flower: that of flowers inside clusters."""
    spread = max(marks.spread, 3.0 * float(look.sigma.mean()))
    return float(1.0 / (4.0 * np.pi * spread**2) ** 1.5)


def log_evidence(fit: Fit, look: Look, marks: Landmarks, scale: ErrorScale) -> float:
    """Log of the ratio of likelihoods: the frame is seen from about this pose, against not of this map at all."""
    value, log_det = np.linalg.slogdet(fit.information)
    if value <= 0:
        return -np.inf
    pose = 0.5 * (6.0 * LOG_2PI - log_det) - np.log(_pose_volume(marks, look))
    points = fit.log_likelihood - null_log_likelihood(fit.rows, fit.flowers, look, marks)
    return float(points + pose + count_evidence(fit.T_map_camera, fit.rows, fit.flowers, look, marks, scale))


def count_evidence(
    T: Array, rows: IntArray, flowers: IntArray, look: Look, marks: Landmarks, scale: ErrorScale
) -> float:
    """Log of the odds of what was seen, what the map does not have, and what should have been seen and was not."""
    counted = len(rows) * np.log(scale.detection * (1.0 - scale.unmapped))
    counted += (len(look) - len(rows)) * np.log(scale.unmapped)
    return float(counted + _missed(T, flowers, look, marks, scale))


def _pose_volume(marks: Landmarks, look: Look) -> float:
    """Volume of the poses that a camera may have: positions (m^3) times orientations (8 pi^2)."""
    reach = float(np.median(np.linalg.norm(look.points, axis=1)))
    extent = np.ptp(marks.positions, axis=0) + 2.0 * reach
    return float(np.prod(extent) * 8.0 * np.pi**2)


def null_log_likelihood(rows: IntArray, flowers: IntArray, look: Look, marks: Landmarks) -> float:
    """Log density of the matched points as flowers of unknown clusters (a Neyman-Scott process)."""
    points = look.points[rows]
    clusters, group = np.unique(marks.cluster[flowers], return_inverse=True)
    n = len(clusters)
    count = np.bincount(group, minlength=n).astype(float)
    mean = np.stack([np.bincount(group, x, n) for x in points.T], axis=1) / count[:, None]
    spread = max(marks.spread, float(look.sigma.mean()))
    within = float(((points - mean[group]) ** 2).sum()) / spread**2
    room = np.prod(np.ptp(mean, axis=0) + 4.0 * spread)
    members = -0.5 * within - 1.5 * float(((count - 1.0) * np.log(2.0 * np.pi * spread**2) + np.log(count)).sum())
    return float(members + n * np.log(n / room))


def _missed(T: Array, flowers: IntArray, look: Look, marks: Landmarks, scale: ErrorScale) -> float:
    """Log probability that the flowers in view which nobody saw were missed, or hidden with their whole cluster."""
    seen = in_view_of(T, look, marks)
    seen[flowers] = False
    missed = np.bincount(marks.cluster[seen], minlength=marks.n_clusters) * np.log(1.0 - scale.detection)
    hidden = np.full(marks.n_clusters, np.log(_HIDDEN_SHARE))
    hidden[marks.cluster[flowers]] = -np.inf
    return float(np.where(missed < 0.0, np.maximum(missed, hidden), 0.0).sum())


def in_view_of(T: Array, look: Look, marks: Landmarks) -> BoolArray:
    """Which flowers of the map (f,) lie in view, as far as the frame's own points tell."""
    return _in_view(transform(inverse(T), marks.positions), look)


def _in_view(points: Array, look: Look) -> BoolArray:
    """Which points (f, 3) lie within the cone and the range that the frame's own points span."""
    z = look.points[:, 2]
    inside: BoolArray = (points[:, 2] >= z.min()) & (points[:, 2] <= z.max()) & (points[:, 2] > 0)
    for axis in (0, 1):
        own = look.points[:, axis] / z
        slope = points[:, axis] / np.where(inside, points[:, 2], 1.0)
        inside &= (slope >= own.min()) & (slope <= own.max())
    return inside
