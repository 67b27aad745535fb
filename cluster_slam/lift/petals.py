"""The depth of a flower from the depths within its box: petals, not what is behind or in front of them.

A box holds petals, leaves behind them that show between, perhaps a stem or another flower in front, edges that bleed,
and pixels without a depth. A flower is no deeper than it is wide. So the depths that fit into one flower's depth and
lie nearest the middle of the box are taken for the petals; a plane through them, with a prior on its tilt, says the
depth at the middle, whatever part of the flower is hidden.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.sensors.depth import DepthModel

_INNER = 0.95  # share of the box that is looked at: an ellipse
_CENTRED = 0.55  # sigma of the weight that falls from the middle, in half-axes
_TILT = 0.7  # sigma of the tangent of a flower's tilt
_RELIEF = 0.10  # sigma of petals about a plane, in half widths of the flower
_MIN_WEIGHT = 0.06  # of the petals, of all that an empty box could have: fewer is no depth
_TUKEY = 4.0  # sigmas at which a pixel counts no more


@dataclass(frozen=True, slots=True)
class PetalDepth:
    """The depth of a flower's middle."""

    depth: float  # m, as the depth image measures it; NaN: none
    sigma: float  # m
    slope_u: float  # m / px
    slope_v: float
    support: float  # weight of the pixels that agree, 0 to 1


NO_DEPTH = PetalDepth(np.nan, np.nan, 0.0, 0.0, 0.0)


def petal_depth(depth: Array, centre: Array, size: Array, focal_px: float, model: DepthModel) -> PetalDepth:
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
    """
    u, v, z, weight, possible = _pixels(depth, centre, size)
    if not len(z):
        return NO_DEPTH
    width_px = float(np.sqrt(size[0] * size[1]))
    petals, rival = _front(z, weight, width_px / focal_px, model)
    support = float(weight[petals].sum()) / possible
    if support < _MIN_WEIGHT or petals.sum() < 3:
        return NO_DEPTH
    fitted = _plane(u[petals], v[petals], z[petals], weight[petals], width_px, focal_px, model)
    value, sigma, b, c = fitted
    return PetalDepth(value, float(np.hypot(sigma, rival)), b, c, support)


def _pixels(depth: Array, centre: Array, size: Array) -> tuple[Array, Array, Array, Array, float]:
    """Offsets u and v, depth and weight of the valid pixels in the box's ellipse, and the weight of all of them."""
    half = np.maximum(_INNER * size / 2, 1.6)
    low = np.maximum(np.ceil(centre - half).astype(int), 0)
    high = np.minimum(np.floor(centre + half).astype(int) + 1, depth.shape[::-1])
    if (high <= low).any():
        return (*(np.empty(0),) * 4, 1.0)
    patch = depth[low[1] : high[1], low[0] : high[0]]
    dv, du = np.mgrid[low[1] : high[1], low[0] : high[0]]
    du, dv = du - centre[0], dv - centre[1]
    r2 = (du / half[0]) ** 2 + (dv / half[1]) ** 2
    weight = np.where(r2 <= 1.0, np.exp(-0.5 * r2 / _CENTRED**2), 0.0)
    valid = (patch > 0) & (weight > 0)
    return du[valid], dv[valid], patch[valid].astype(float), weight[valid], float(weight.sum())


def _front(z: Array, weight: Array, width: float, model: DepthModel) -> tuple[Array, float]:
    """Which pixels are the petals, and the sigma of having taken the wrong ones, m."""
    order = np.argsort(z, kind="stable")
    zs, total = z[order], np.concatenate([[0.0], np.cumsum(weight[order])])
    reach = 0.9 * width * zs + 4.0 * model.sigma(zs)
    end = np.searchsorted(zs, zs + reach, side="right")
    inside = total[end] - total[:-1]
    best = int((inside > 0.999 * inside.max()).argmax())  # of equals, the nearest
    chosen = np.zeros(len(z), bool)
    chosen[order[best : end[best]]] = True
    rest = ~chosen
    middle = float(np.median(z[chosen]))
    if not rest.any():
        return chosen, 0.0
    apart = (zs > zs[end[best] - 1]) | (zs < zs[best])
    others = np.where(apart, np.minimum(inside, total[-1] - inside[best]), 0.0)
    second = int(others.argmax())
    doubt = float(others[second] / (inside[best] + others[second]))
    doubt = max(0.0, doubt - 0.3) * 0.5  # a rival of less than three in ten is none
    distance = float(zs[second] - middle)
    return chosen, float(np.sqrt(doubt * (1 - doubt)) * abs(distance))


def _plane(
    u: Array, v: Array, z: Array, weight: Array, width_px: float, focal_px: float, model: DepthModel
) -> tuple[float, float, float, float]:
    """Depth at the middle, its sigma, and the slopes, by least squares that let go of what does not fit."""
    middle = float(np.median(z))
    noise = float(model.sigma(np.array([middle]))[0])
    relief = _RELIEF * 0.5 * width_px * middle / focal_px
    pixel_var = noise**2 + relief**2
    alike = 1.0 + len(z) / (4.0 * np.pi * model.correlation_px**2)  # so many pixels tell something of their own
    share = min(1.0, alike / len(z))
    prior = np.diag([0.0, 1.0, 1.0]) / (_TILT * middle / focal_px) ** 2
    X = np.column_stack([np.ones(len(z)), u, v])
    robust = np.ones(len(z))
    solution = np.array([middle, 0.0, 0.0])
    for _ in range(4):
        A = X.T @ (X * (robust * weight / weight.mean())[:, None]) * (share / pixel_var) + prior
        y = X.T @ (z * robust * weight / weight.mean()) * (share / pixel_var)
        solution = np.linalg.solve(A, y)
        residual = z - X @ solution
        scale = max(np.sqrt(pixel_var), 1.4826 * float(np.median(np.abs(residual))))
        robust = np.maximum(1.0 - (residual / (_TUKEY * scale)) ** 2, 0.0) ** 2
    variance = float(np.linalg.solve(A, np.eye(3)[0])[0]) * max(1.0, scale**2 / pixel_var)
    step = model.unit_m**2 / 12.0
    return float(solution[0]), float(np.sqrt(variance + relief**2 + step)), float(solution[1]), float(solution[2])
