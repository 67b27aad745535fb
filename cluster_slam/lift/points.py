"""From pixels and depths to flowers: 3-D points in the camera frame with their covariance."""

from __future__ import annotations

from typing import Literal

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.sensors.camera import Camera

Convention = Literal["z", "ray"]


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
