"""How far a step of odometry may be wrong."""

from __future__ import annotations

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import StatedNoise


def step_cov(noise: StatedNoise, moved: Array, gap: float) -> Array:
    """Covariance (6, 6) of one step whose tangent is ``moved`` (6,), of the pose as given.

    ``gap`` is how many times longer than usual the step took: over a gap the way may have been longer.
    """
    times = float(np.sqrt(gap))
    turned, travelled = (float(np.linalg.norm(part)) * times for part in (moved[:3], moved[3:]))
    rotation = float(np.hypot(noise.pose_rotation * times, noise.odometry_rotation * turned))
    along = float(np.hypot(noise.pose_translation * times, noise.odometry_translation * travelled))
    return diagonal(rotation, float(np.hypot(along, rotation * travelled / np.sqrt(3.0))))


def diagonal(sigma_rotation: float, sigma_translation: float) -> Array:
    """Covariance (6, 6) of a tangent with one sigma for its rotations and one for its translations."""
    return np.diag(np.maximum(np.repeat([sigma_rotation, sigma_translation], 3), 1e-7) ** 2)
