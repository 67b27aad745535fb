"""What a session without covariances shows of its noise: of depth, in the image, and how both grow with depth.

A camera with depth errs by pixels in the image and by a power of depth along the ray, and one isotropic sigma says
nothing of either. Residuals do: of each part, their squares over what the unknowns have left free of it (variance
components, Foerstner 1979), in bins of depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.depth_noise import NoiseShape
from cluster_slam.geometry import Array
from cluster_slam.graph.batch import BatchSmoother, Estimate
from cluster_slam.graph.innovations import influence

_FEWEST = 300.0  # degrees of freedom of each part that tell something
_BINS = 12  # of depth
_LEAST_SPREAD = 0.02  # of the logarithm of depth, to tell how noise grows with it
_STEEPEST = 4.0  # power of depth


def noise_shape(smoother: BatchSmoother, estimate: Estimate, least_var: float) -> NoiseShape | None:
    """The shape that the residuals of a solved estimate have; None where they are too few, or not ahead.

    ``least_var`` m^2 is the least variance that is found, at a depth of 1 m and in any bin of depth.
    """
    r, h = smoother.residuals(estimate)
    K, used = influence(smoother, estimate)
    if not used.any() or h[used, 2].min() <= 0.0:
        return None
    depth = h[used, 2]
    to_parts = np.tile(np.eye(3), (len(depth), 1, 1))
    to_parts[:, :2, 2] = -h[used, :2] / depth[:, None]  # an error of the depth moves a point along its ray
    root = to_parts @ np.linalg.cholesky(smoother.frames.covs[smoother.rows[used]])
    square = (root @ r[used, :, None])[..., 0] ** 2
    free = np.diagonal(root @ (np.eye(3) - K[used]) @ np.swapaxes(root, 1, 2), axis1=1, axis2=2)
    stated = np.diagonal(root @ np.swapaxes(root, 1, 2), axis1=1, axis2=2)
    laws = [_power_law(_Part(square[:, i], free[:, i], stated[:, i], np.log(depth)), least_var) for i in ([0, 1], [2])]
    if laws[0] is None or laws[1] is None:
        return None
    return NoiseShape(laws[1][0], laws[0][0], laws[1][1], laws[0][1])


@dataclass(frozen=True, slots=True, eq=False)
class _Part:
    """Squared residuals (q, a) along some axes, what is expected of them, and of errors, m^2; log of depth (q,)."""

    square: Array
    free: Array
    stated: Array
    log_depth: Array


def _power_law(part: _Part, least: float) -> tuple[float, float] | None:
    """Sigma at 1 m and power of depth of one part; None where too little is left free of it."""
    redundancy, square = (part.free / part.stated).sum(axis=1), part.square.sum(axis=1)
    if redundancy.sum() < _FEWEST:
        return None
    power = 0.0
    if part.log_depth.std() > _LEAST_SPREAD:
        edges = np.quantile(part.log_depth, np.linspace(0.0, 1.0, _BINS + 1)[1:-1])
        of = np.searchsorted(edges, part.log_depth)
        weight = np.maximum(np.bincount(of, redundancy, _BINS), 1e-9)
        log_var = np.log(np.maximum(np.bincount(of, square, _BINS) / weight, least))
        x = np.bincount(of, redundancy * part.log_depth, _BINS) / weight
        x -= np.average(x, weights=weight)
        power = float(np.clip(0.5 * (weight * x) @ log_var / (weight @ x**2), 0.0, _STEEPEST))
    variance = square.sum() / (redundancy @ np.exp(2.0 * power * part.log_depth))
    return float(np.sqrt(max(variance, least))), power
