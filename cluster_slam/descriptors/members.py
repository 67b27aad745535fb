"""A cluster's members: points (..., n, 3) in metres and their joint covariance (..., 3 n, 3 n), x y z in turn."""

from __future__ import annotations

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array


def checked_points(points: Array, minimum: int = 2) -> Array:
    """The points (..., n, 3) as float64, or an error that says what is wrong.

    Raises
    ------
    InputError
        Not (..., n, 3), fewer than `minimum` members, or not finite.
    """
    points = np.asarray(points, dtype=np.float64)
    if points.ndim < 2 or points.shape[-1] != 3:
        raise InputError(f"members must be points (..., n, 3), got shape {points.shape}")
    if points.shape[-2] < minimum:
        raise InputError(f"a descriptor needs at least {minimum} flowers, the cluster has {points.shape[-2]}")
    if not np.isfinite(points).all():
        raise InputError(f"a member's position is not finite: {points[~np.isfinite(points).all(-1)][0]}")
    return points


def centred(points: Array) -> Array:
    """Points (..., n, 3) relative to their centroid."""
    out: Array = points - np.einsum("...ni->...i", points)[..., None, :] / points.shape[-2]
    return out


def checked_sigma(sigma: Array | float) -> Array:
    """Standard deviations as float64, or an error.

    Raises
    ------
    InputError
        Not finite or not positive.
    """
    out = np.asarray(sigma, dtype=np.float64)
    if not (np.isfinite(out) & (out > 0)).all():
        raise InputError(f"a flower's sigma must be a length > 0, got {out if out.ndim == 0 else out.min()}")
    return out


def centred_cov(cov: Array) -> Array:
    """Joint covariances (..., 3 n, 3 n) of the offsets from the centroid."""
    n = cov.shape[-1] // 3
    blocks = cov.reshape(*cov.shape[:-2], n, 3, n, 3)
    blocks = blocks - blocks.mean(-4, keepdims=True)
    blocks = blocks - blocks.mean(-2, keepdims=True)
    out: Array = blocks.reshape(cov.shape)
    return out


def member_blocks(cov: Array) -> Array:
    """Each member's own covariances (..., n, 3, 3) out of joint ones (..., 3 n, 3 n)."""
    n = cov.shape[-1] // 3
    i = np.arange(n)
    return np.moveaxis(cov.reshape(*cov.shape[:-2], n, 3, n, 3)[..., i, :, i, :], 0, -3)


def isotropic(n: int, sigma: float) -> Array:
    """Joint covariance (3 n, 3 n) of n members with independent errors of `sigma` metres along each axis."""
    return np.eye(3 * n) * float(sigma) ** 2


def block_diagonal(covs: Array) -> Array:
    """Joint covariances (..., 3 n, 3 n) of members with independent errors of covariances (..., n, 3, 3)."""
    n = covs.shape[-3]
    out = np.zeros((*covs.shape[:-3], n, 3, n, 3))
    i = np.arange(n)
    out[..., i, :, i, :] = np.moveaxis(covs, -3, 0)
    return out.reshape(*covs.shape[:-3], 3 * n, 3 * n)
