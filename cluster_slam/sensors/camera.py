"""The pinhole camera with the distortion models of ROS ``camera_info``: plumb bob and rational polynomial.

Model and order of the coefficients ``k1 k2 p1 p2 k3 k4 k5 k6``: OpenCV, "Camera calibration and 3D reconstruction",
after Brown (1966) and Claus and Fitzgibbon (2005). Normalised coordinates are x / z and y / z in the camera frame.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array

N_COEFFICIENTS = {"plumb_bob": 5, "rational_polynomial": 8}  # at most; further ones must be zero
_MAX_STEPS = 30
_STEP_TOLERANCE = 1e-12  # of normalised coordinates: 1e-9 pixels


@dataclass(frozen=True, slots=True, eq=False)
class Camera:
    """Intrinsics, all in pixels but the distortion coefficients, which have no unit."""

    fx: float
    fy: float
    cx: float
    cy: float
    distortion: Array  # (8,) k1 k2 p1 p2 k3 k4 k5 k6
    width: int | None = None
    height: int | None = None

    def project(self, points: Array) -> Array:
        """Pixels (n, 2) of points (n, 3) in the camera frame, z > 0."""
        distorted = distort(points[:, :2] / points[:, 2:], self.distortion)[0]
        return distorted * [self.fx, self.fy] + [self.cx, self.cy]

    def normalise(self, pixels: Array) -> tuple[Array, Array]:
        """Normalised coordinates without distortion, and how they change with the pixel.

        Newton's method on the distortion, from the distorted point.

        Parameters
        ----------
        pixels
            (n, 2)

        Returns
        -------
        tuple
            Coordinates (n, 2), NaN where the distortion cannot be undone (the pixel lies outside of where the model
            is one to one), and the Jacobians (n, 2, 2), in 1 / pixel.
        """
        target = (pixels - [self.cx, self.cy]) / [self.fx, self.fy]
        xy = target.copy()
        with np.errstate(all="ignore"):
            for _ in range(_MAX_STEPS):
                value, jacobian = distort(xy, self.distortion)
                step = _solve2(jacobian, target - value)
                xy = xy + step
                if not np.nanmax(np.abs(step), initial=0.0) > _STEP_TOLERANCE:
                    break
            value, jacobian = distort(xy, self.distortion)
            lost = ~(np.abs(value - target).max(axis=1, initial=0.0) < 1e-9) | ~(np.linalg.det(jacobian) > 0)
        xy[lost] = np.nan
        jacobian[lost] = np.eye(2)
        inverse = np.stack([_solve2(jacobian, np.tile(e, (len(xy), 1))) for e in np.eye(2)], axis=-1)
        return xy, inverse / [self.fx, self.fy]


def _solve2(A: Array, b: Array) -> Array:
    """Solutions (n, 2) of A x = b for stacks (n, 2, 2), by Cramer's rule: a singular one gives inf or NaN."""
    det = A[:, 0, 0] * A[:, 1, 1] - A[:, 0, 1] * A[:, 1, 0]
    x = (A[:, 1, 1] * b[:, 0] - A[:, 0, 1] * b[:, 1]) / det
    y = (A[:, 0, 0] * b[:, 1] - A[:, 1, 0] * b[:, 0]) / det
    return np.stack([x, y], axis=1)


def distort(xy: Array, coefficients: Array) -> tuple[Array, Array]:
    """Distorted normalised coordinates (n, 2) and their Jacobians (n, 2, 2).

    Parameters
    ----------
    xy
        (n, 2) normalised coordinates.
    coefficients
        (8,) k1 k2 p1 p2 k3 k4 k5 k6
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = coefficients
    x, y = xy[:, 0], xy[:, 1]
    r2 = x * x + y * y
    top, top_slope = 1 + r2 * (k1 + r2 * (k2 + r2 * k3)), k1 + r2 * (2 * k2 + r2 * 3 * k3)
    low, low_slope = 1 + r2 * (k4 + r2 * (k5 + r2 * k6)), k4 + r2 * (2 * k5 + r2 * 3 * k6)
    radial = top / low
    slope = 2 * (top_slope - radial * low_slope) / low  # d radial / d r2, twice
    out = np.stack(
        [x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y],
        axis=1,
    )
    jacobian = np.empty((len(xy), 2, 2))
    jacobian[:, 0, 0] = radial + x * x * slope + 2 * p1 * y + 6 * p2 * x
    jacobian[:, 1, 1] = radial + y * y * slope + 6 * p1 * y + 2 * p2 * x
    jacobian[:, 0, 1] = jacobian[:, 1, 0] = x * y * slope + 2 * p1 * x + 2 * p2 * y
    return out, jacobian
