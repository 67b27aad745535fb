"""From pixels and depths to flowers: 3-D points in the camera frame with their covariance."""

from __future__ import annotations

from typing import Literal

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.sensors.camera import Camera
from tracking.unscented import SigmaRule, combine, sigma_points

Convention = Literal["z", "ray"]
_RULE = SigmaRule(alpha=1.0, beta=2.0, kappa=0.0)


def lift(
    camera: Camera, pixels: Array, depths: Array, *, convention: Convention, sigma_px: float, depth_coefficient: float
) -> tuple[Array, Array]:
    """Points seen at pixels and depths, and their covariances to first order in the noise.

    The pixel's noise (u and v alike) and the depth's are independent; the sigma of the depth is
    ``depth_coefficient * z^2``. First order is enough here: the pixel's noise is a thousandth of the focal length.

    Parameters
    ----------
    camera
        Intrinsics.
    pixels
        (n, 2) u and v, pixels, as the distorted image has them.
    depths
        (n,) m
    convention
        "z": depths along the optical axis; "ray": along the pixel's ray.
    sigma_px
        Sigma of u and of v, pixels.
    depth_coefficient
        Sigma of the depth at one metre, 1/m.

    Returns
    -------
    tuple
        Points (n, 3), m, and covariances (n, 3, 3), m^2, camera frame. Points are NaN where the distortion cannot be
        undone.
    """
    xy, xy_by_pixel = camera.normalise(pixels)
    ray = np.concatenate([xy, np.ones((len(xy), 1))], axis=1)  # z = 1
    by_xy = np.tile(np.eye(3)[:, :2], (len(xy), 1, 1))  # d ray / d xy
    if convention == "ray":
        norm = np.linalg.norm(ray, axis=1)
        ray = ray / norm[:, None]
        by_xy = (by_xy - ray[:, :, None] * ray[:, None, :2]) / norm[:, None, None]
    points = depths[:, None] * ray
    by_pixel = depths[:, None, None] * (by_xy @ xy_by_pixel)
    by_depth = ray * (depth_coefficient * points[:, 2:] ** 2)
    covs = sigma_px**2 * by_pixel @ np.swapaxes(by_pixel, 1, 2) + by_depth[:, :, None] * by_depth[:, None, :]
    return points, covs


def lift_unscented(
    camera: Camera,
    pixels: Array,
    depths: Array,
    *,
    convention: Convention,
    sigma_px: Array,
    sigma_depth: Array,
    slopes: Array | None = None,
    focal_sigma: float = 0.0,
    centre_sigma_px: float = 0.0,
) -> tuple[Array, Array]:
    """Points and their covariances by the unscented transform of six independent errors.

    These are the pixel's u and v, the depth, the focal length (one factor for fx and fy) and the principal point.
    Where a depth was read off a tilted surface, a pixel that errs moves along it: ``slopes`` says by how much.

    Parameters
    ----------
    camera
        Intrinsics.
    pixels
        (n, 2) u and v, pixels, as the distorted image has them.
    depths
        (n,) m
    convention
        "z": depths along the optical axis; "ray": along the pixel's ray.
    sigma_px, sigma_depth
        (n,) sigmas of u and v, pixels, and of the depth, m.
    slopes
        (n, 2) change of the depth by u and by v, m / pixel; None: depths belong to the true pixel, whatever it is.
    focal_sigma
        Relative sigma of the focal length.
    centre_sigma_px
        Sigma of the principal point, pixels.

    Returns
    -------
    tuple
        Points (n, 3), m, and covariances (n, 3, 3), m^2, camera frame. Points are NaN where the distortion cannot be
        undone there or a sigma beside.
    """
    n = len(pixels)
    mean = np.column_stack([pixels, depths, np.zeros((n, 3))])
    sigma = np.column_stack(
        [sigma_px, sigma_px, sigma_depth, np.tile([focal_sigma, centre_sigma_px, centre_sigma_px], (n, 1))]
    )
    factor = sigma[:, :, None] * np.eye(6)
    points = sigma_points(mean, factor, _RULE, factor)  # (n, 13, 6)
    tilt = np.zeros((n, 2)) if slopes is None else slopes
    values = points.reshape(-1, 6)
    moved = values[:, 2] + ((points[..., :2] - pixels[:, None]) * tilt[:, None]).sum(-1).ravel()
    principal = np.array([camera.cx, camera.cy])
    seen = (values[:, :2] - principal - values[:, 4:]) / (1.0 + values[:, 3:4]) + principal
    lifted = lift(camera, seen, moved, convention=convention, sigma_px=1.0, depth_coefficient=1.0)[0]
    centres, covs = combine(lifted.reshape(n, 13, 3), _RULE, 6)
    return centres, covs
