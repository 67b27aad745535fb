"""Noise of points at the depth where their flowers are, not at the depth where they were measured.

A camera states the noise of a point at its measured depth, with which it grows. So points that were measured too near
seem surer than points that were measured too far, and flowers come out too near: with sigma proportional to depth
squared by 4 sigma^2 / z, which many views do not average away. The noise at the expected depth has no such bias.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.association.frames import Frames
from cluster_slam.geometry import Array

_FEWEST = 50  # observations that tell how noise depends on depth
_LEAST_SPREAD = 0.02  # of the logarithm of their depths
_STEEPEST = 4.0  # power of depth
_LEAST_DEPTH = 1e-6  # m
_FARTHEST = 2.0  # times the measured depth: what is expected farther off is no error of depth


@dataclass(frozen=True, slots=True)
class NoiseShape:
    """Sigmas at a depth of 1 m, of the depth and in the image's plane, m, and the powers of depth they grow with.

    An error of the depth moves a point along its ray; one of the pixel moves it at the same depth.
    """

    depth: float
    lateral: float
    power_depth: float = 0.0
    power_lateral: float = 0.0

    def covs(self, points: Array, depth: Array) -> Array:
        """Covariances (m, 3, 3) of points (m, 3) in the camera frame that are at ``depth`` (m,) m."""
        ray = points / np.maximum(np.abs(points[:, 2:]), _LEAST_DEPTH)
        lateral = (self.lateral * depth**self.power_lateral) ** 2
        along = (self.depth * depth**self.power_depth) ** 2
        out: Array = lateral[:, None, None] * np.diag([1.0, 1.0, 0.0]) + along[:, None, None] * _squares(ray)
        return out


def at_expected_depth(frames: Frames, depth: Array) -> Frames:
    """The same with covariances as the session states them for points at ``depth`` (m,) m, NaN where none is known."""
    along, across = powers_of_depth(frames)
    known = np.isfinite(depth) & (frames.points[:, 2] > 0)
    if (along == 0.0 and across == 0.0) or not known.any():
        return frames
    covs = frames.covs.copy()
    covs[known] = stretched(frames.points[known], covs[known], depth[known], (along, across))
    return replace(frames, covs=covs)


def expected_depth(points: Array, depth: Array | None) -> Array:
    """Depth (m,) m of points (m, 3) where it is known, as far as it can be one of theirs; as measured elsewhere."""
    measured = np.maximum(np.abs(points[:, 2]), _LEAST_DEPTH)
    if depth is None:
        return measured
    near = np.clip(depth, measured / _FARTHEST, measured * _FARTHEST)
    return np.where(np.isfinite(depth), near, measured)


def stretched(points: Array, covs: Array, depth: Array, powers: tuple[float, float]) -> Array:
    """Covariances (m, 3, 3) as they would be stated at ``depth`` (m,) m of points (m, 3) ahead, with these powers."""
    along, across = powers
    ratio = np.clip(depth / points[:, 2], 1.0 / _FARTHEST, _FARTHEST)
    u = points / np.linalg.norm(points, axis=1)[:, None]
    stretch = (ratio**across)[:, None, None] * np.eye(3)
    stretch = stretch + (ratio**along - ratio**across)[:, None, None] * _squares(u)
    out: Array = stretch @ covs @ stretch
    return out


def powers_of_depth(frames: Frames) -> tuple[float, float]:
    """Powers of depth with which the stated sigma grows along the ray and across it; zeros where nothing tells."""
    sums = DepthSums()
    sums.add(frames.points, frames.covs)
    return sums.powers()


class DepthSums:
    """Sums over observations that tell how the logarithms of the stated sigmas grow with that of depth."""

    def __init__(self) -> None:
        self._n, self._of_x = 0, np.zeros(2)
        self._of_y, self._of_xy = np.zeros(2), np.zeros(2)  # along the ray, across it

    def add(self, points: Array, covs: Array) -> None:
        """Points (q, 3) of the camera frame with stated covariances (q, 3, 3)."""
        ahead = points[:, 2] > 0
        points, covs = points[ahead], covs[ahead]
        u = points / np.linalg.norm(points, axis=1)[:, None]
        along = np.einsum("mi,mij,mj->m", u, covs, u)
        across = 0.5 * (np.trace(covs, axis1=1, axis2=2) - along)
        x, y = np.log(points[:, 2]), 0.5 * np.log(np.stack([along, across]))
        self._n += len(x)
        self._of_x += x.sum(), x @ x
        self._of_y += y.sum(axis=1)
        self._of_xy += y @ x

    def powers(self) -> tuple[float, float]:
        """Along the ray and across it; zeros where nothing tells."""
        n = max(self._n, 1)
        mean, square = self._of_x / n
        var = square - mean * mean
        if self._n < _FEWEST or var < _LEAST_SPREAD**2:
            return 0.0, 0.0
        along, across = np.clip((self._of_xy / n - mean * self._of_y / n) / var, 0.0, _STEEPEST)
        return float(along), float(across)


def _squares(v: Array) -> Array:
    """Outer products (m, 3, 3) of vectors (m, 3) with themselves."""
    out: Array = v[:, :, None] * v[:, None]
    return out
