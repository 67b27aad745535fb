"""The depth of a flower from the depths within its box: petals, not what is behind or in front of them.

A box holds petals, leaves behind them that show between, perhaps a stem or another flower in front, edges that bleed,
and pixels without a depth. A flower is no deeper than it is wide. So the depths that fit into one flower's depth and
lie nearest the middle of the box are taken for the petals; a plane through them, with a prior on its tilt, says the
depth at the middle, whatever part of the flower is hidden.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray
from cluster_slam.sensors.depth import DepthModel

_INNER = 0.95  # share of the box that is looked at: an ellipse
_CENTRED = 0.55  # sigma of the weight that falls from the middle, in half-axes
_TILT = 0.7  # sigma of the tangent of a flower's tilt
_RELIEF = 0.055  # sigma of petals about a plane, in half widths of the flower
_DEEP = (0.3, 0.9)  # depth of a flower, in widths: one that faces the camera, and one that does not
_GOES_ON = 1.2  # weight of what goes on beyond the box, in depth ...
_THIN = 3.0  # ... and in colour: a stem has this many times its share of the ring in the box
_RING = (1.3, 1.9)  # about the ellipse, in half-axes
_MIN_SCORE = 0.15  # of the petals: their weight in the box less their share of the ring
_ALL = 0.85  # of the weight in the box: what holds so much has no rival ...
_MIN_ALL = 0.3  # ... if it is so much of a whole box
_DOUBT = 0.3  # a rival that scores so much of the best leaves no depth
_TUKEY = 3.0  # sigmas at which a pixel counts no more


@dataclass(frozen=True, slots=True)
class PetalDepth:
    """The depth of a flower's middle."""

    depth: float  # m, as the depth image measures it; NaN: none
    sigma: float  # m
    slope_u: float  # m / px
    slope_v: float
    sigma_slope: float = 0.0  # m / px, of either
    seen: float = 0.0  # share of the box's ellipse that is petals with a depth


NO_DEPTH = PetalDepth(np.nan, np.nan, 0.0, 0.0)


def petal_depth(
    depth: Array,
    centre: Array,
    size: Array,
    focal_px: float,
    model: DepthModel,
    image: NDArray[np.uint8] | None = None,
    others: Array | None = None,
) -> PetalDepth:
    """The depth at the middle of a flower's box.

    Parameters
    ----------
    depth
        (h, w) m, 0 or NaN where there is none.
    centre, size
        (2,) of the box, pixels.
    focal_px
        Of the depth image.
    model
        How its pixels err.
    image
        (h, w, 3) the colour picture; None: depths alone say what is a petal.
    others
        (k, 4) middle and size of further boxes that reach into this one: a pixel is of the box whose middle is nearer.
    """
    patch = _patch(depth, centre, size, image, np.empty((0, 4)) if others is None else others)
    if not len(patch.z):
        return NO_DEPTH
    width_px = float(np.sqrt(size[0] * size[1]))
    petals = _petals(patch, width_px / focal_px, model)
    if petals.sum() < 3:
        return NO_DEPTH
    u, v, z = patch.u[petals], patch.v[petals], patch.z[petals]
    return replace(_plane(u, v, z, width_px, focal_px, model), seen=float(petals.sum()) / patch.area)


@dataclass(frozen=True, slots=True, eq=False)
class _Patch:
    """The valid pixels in a box's ellipse, and the depths in a ring about it."""

    u: Array  # (n,) from the middle, px
    v: Array
    z: Array  # (n,) m
    weight: Array  # (n,) falls from the middle; sums to 1 where all pixels are valid
    ring: Array  # (m,) m, increasing
    n_ring: int  # pixels of the ring, valid or not
    area: float  # of the ellipse, pixels


def _patch(depth: Array, centre: Array, size: Array, image: NDArray[np.uint8] | None, others: Array) -> _Patch:
    half = np.maximum(_INNER * size / 2, 1.6)
    low = np.maximum(np.ceil(centre - _RING[1] * half).astype(int), 0)
    high = np.maximum(np.minimum(np.floor(centre + _RING[1] * half).astype(int) + 1, depth.shape[::-1]), low)
    patch = depth[low[1] : high[1], low[0] : high[0]]
    u = np.arange(low[0], high[0]) - centre[0]
    v = (np.arange(low[1], high[1]) - centre[1])[:, None]
    r2 = (u / half[0]) ** 2 + (v / half[1]) ** 2
    foreign = _nearest_other(u + centre[0], v + centre[1], others)
    inside = (r2 <= 1.0) & (r2 <= foreign)
    weight = np.where(inside, np.exp(-0.5 * r2 / _CENTRED**2), 0.0)
    about = (r2 >= _RING[0] ** 2) & (r2 <= _RING[1] ** 2) & (foreign > 1.0)
    whole = max(float(np.exp(-0.5 * r2[r2 <= 1.0] / _CENTRED**2).sum()), 1e-9)
    if image is not None:
        weight = weight * _petal_coloured(image[low[1] : high[1], low[0] : high[0]], weight, about)
    valid = (patch > 0) & inside
    uu, vv = np.broadcast_arrays(u, v)
    return _Patch(
        uu[valid],
        vv[valid],
        patch[valid].astype(float),
        weight[valid] / whole,
        np.sort(patch[about & (patch > 0)].astype(float)),
        int(about.sum()),
        float(np.pi * half.prod()),
    )


def _nearest_other(u: Array, v: Array, others: Array) -> Array:
    """Squared distance (h, w) to the middle of the nearest other box, in its half-axes."""
    nearest = np.full(np.broadcast_shapes(u.shape, v.shape), np.inf)
    for x, y, w, h in others:
        half_w, half_h = max(_INNER * w / 2, 1.6), max(_INNER * h / 2, 1.6)
        nearest = np.minimum(nearest, ((u - x) / half_w) ** 2 + ((v - y) / half_h) ** 2)
    return nearest


def _petal_coloured(image: NDArray[np.uint8], weight: Array, about: BoolArray) -> Array:
    """How likely (h, w) a pixel's colour is the flower's: what is common in the box and rare in the ring about it."""
    levels = (image >> 6).astype(np.int64)
    colour = levels[..., 0] * 16 + levels[..., 1] * 4 + levels[..., 2]
    inside = np.bincount(colour.ravel(), weight.ravel(), 64) / max(float(weight.sum()), 1e-9)
    beyond = np.bincount(colour[about], minlength=64) / max(int(about.sum()), 1)
    share: Array = ((inside + 0.005) / (inside + _THIN * beyond + 0.01))[colour]
    return np.clip(3.0 * share - 1.3, 0.0, 1.0)


def _petals(patch: _Patch, width: float, model: DepthModel) -> BoolArray:
    """Which pixels are the petals; none where something else may as well be.

    Depths that fit into one flower count by their weight in the box, less their share of the ring: what goes on beyond
    the box, as leaves before and behind do, is not the flower.
    """
    order = np.argsort(patch.z, kind="stable")
    z = patch.z[order]
    total = np.concatenate([[0.0], np.cumsum(patch.weight[order])])
    windows = [z + deep * width * z + 4.0 * model.sigma(z) for deep in _DEEP]
    low, high = np.tile(z, len(windows)), np.concatenate(windows)
    begin, end = np.tile(np.arange(len(z)), len(windows)), np.searchsorted(z, high, side="right")
    beyond = np.searchsorted(patch.ring, high, side="right") - np.searchsorted(patch.ring, low)
    held = total[end] - total[begin]
    score = held - _GOES_ON * beyond / max(patch.n_ring, 1)
    if held.max() > max(_ALL * total[-1], _MIN_ALL):  # nothing else is in the box: a flower on a leaf as deep as it
        score = held
    best = int(score.argmax())
    chosen = np.zeros(len(z), bool)
    chosen[order[begin[best] : end[best]]] = True
    apart = (low > high[best]) | (high < low[best])
    rival = float(score[apart].max(initial=0.0))
    if score[best] < _MIN_SCORE or rival > _DOUBT * score[best]:
        return np.zeros(len(z), bool)
    return chosen


def _plane(u: Array, v: Array, z: Array, width_px: float, focal_px: float, model: DepthModel) -> PetalDepth:
    """Depth at the middle, its sigma, and the slopes, by least squares that let go of what does not fit.

    All petals count alike: of a flower that is a cup the middle lies behind the rest.
    """
    middle = float(np.median(z))
    noise = float(model.sigma(np.array([middle]))[0])
    relief = _RELIEF * 0.5 * width_px * middle / focal_px
    noise_var = noise**2
    alike = 1.0 + len(z) / (4.0 * np.pi * model.correlation_px**2)  # so many pixels tell something of their own
    share = min(1.0, alike / len(z))
    prior = np.diag([0.0, 1.0, 1.0]) / (_TILT * middle / focal_px) ** 2
    X = np.column_stack([np.ones(len(z)), u, v])
    robust = np.ones(len(z))
    solution = np.array([middle, 0.0, 0.0])
    for _ in range(4):
        A = X.T @ (X * robust[:, None]) * (share / noise_var) + prior
        y = X.T @ (z * robust) * (share / noise_var)
        solution = np.linalg.solve(A, y)
        residual = z - X @ solution
        scale = max(float(np.hypot(noise, relief)), 1.4826 * float(np.median(np.abs(residual))))
        robust = np.maximum(1.0 - (residual / (_TUKEY * scale)) ** 2, 0.0) ** 2
    covariance = np.linalg.solve(A, np.eye(3)) * max(1.0, scale**2 / (noise_var + relief**2))
    variance, sigma_slope = float(covariance[0, 0]), float(np.sqrt(0.5 * (covariance[1, 1] + covariance[2, 2])))
    step = model.unit_m**2 / 12.0
    sigma = float(np.sqrt(variance + relief**2 + step))
    return PetalDepth(float(solution[0]), sigma, float(solution[1]), float(solution[2]), sigma_slope)
