"""Boxes of flowers in a picture and the depth image beside it, lifted to points with covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array
from cluster_slam.lift.petals import NO_DEPTH, PetalDepth, petal_depth
from cluster_slam.lift.points import Convention, lift_unscented
from cluster_slam.records import BoolArray, ImageDetections
from cluster_slam.sensors.camera import Camera
from cluster_slam.sensors.depth import DepthModel

_ALIKE = 1.8  # flowers of one picture differ in width by less than this factor from the middle one
_MIN_ALIKE = 5  # flowers that say what is usual
_SEEN = 0.72  # share of a box that is petals with a depth; of half, one depth in five is of what hides the rest
_DEEP = 0.3  # in widths: what is so near the plane of a flower's petals is theirs


@dataclass(frozen=True, slots=True, eq=False)
class LiftedBoxes:
    """Flowers of one picture; rows as the detections, NaN where a box has no depth."""

    centres: Array  # (k, 2) where the flowers' middles are, pixels: the boxes', less what they lean
    sigma_px: Array  # (k,) of u and of v of these
    depths: Array  # (k,) m, as the depth image measures them
    sigma_depths: Array  # (k,) m
    points: Array  # (k, 3) camera frame, m
    covs: Array  # (k, 3, 3) m^2
    is_lifted: BoolArray  # (k,)


def lift_boxes(
    camera: Camera,
    boxes: ImageDetections,
    depth: Array,
    *,
    convention: Convention,
    model: DepthModel,
    sigma_px: Array,
    image: NDArray[np.uint8] | None = None,
    lean: float = 0.0,
) -> LiftedBoxes:
    """Points of all boxes that have a depth.

    Parameters
    ----------
    camera
        Intrinsics of the depth image, which lies on the colour image pixel by pixel.
    boxes
        Detections.
    depth
        (h, w) m, 0 or NaN where there is none.
    convention
        What ``depth`` is measured along.
    model
        How its pixels err, and how well the intrinsics are known.
    sigma_px
        (k,) sigma of u and of v of the boxes' middles.
    image
        (h, w, 3) the colour picture, which helps to tell petals from what is before and behind; None: there is none.
    lean
        How far the detector's middles lie to where flowers face: widths for each unit of the tangent of their tilt.
    """
    focal = (camera.fx + camera.fy) / 2
    found = _petal_depths(np.column_stack([boxes.centres, boxes.sizes]), depth, focal, model, image)
    sigmas = np.array([f.sigma for f in found])
    slopes = np.array([(f.slope_u, f.slope_v) for f in found]).reshape(-1, 2)
    centres, depths, sigma_px = _upright(boxes, found, slopes, sigma_px, lean * focal)
    points, covs = np.full((len(found), 3), np.nan), np.full((len(found), 3, 3), np.nan)
    good = np.isfinite(depths) & _are_alike(boxes.sizes.max(axis=1, initial=0.0) * depths)
    good &= _are_seen(np.array([f.seen for f in found]), np.isfinite(depths))
    if good.any():
        points[good], covs[good] = lift_unscented(
            camera,
            centres[good],
            depths[good],
            convention=convention,
            sigma_px=sigma_px[good],
            sigma_depth=sigmas[good],
            slopes=slopes[good],
            focal_sigma=model.focal_sigma,
            centre_sigma_px=model.centre_sigma_px,
        )
    good &= np.isfinite(points).all(1)
    return LiftedBoxes(centres, sigma_px, depths, sigmas, points, covs, good)


def _upright(
    boxes: ImageDetections, found: list[PetalDepth], slopes: Array, sigma_px: Array, lean_px: float
) -> tuple[Array, Array, Array]:
    """Middles (k, 2), depths there (k,) and sigmas (k,) of the middles, brought back from the side they lean to.

    A petal's plane whose depth grows with u faces the other way; the tangent of its tilt is the slope over the metres
    of a pixel, depth / focal length. ``lean_px``: widths for each unit of it, times the focal length.
    """
    depths = np.array([f.depth for f in found])
    with np.errstate(invalid="ignore"):
        reach = lean_px * np.sqrt(boxes.sizes.prod(axis=1)) / depths
        away = np.where(np.isfinite(depths)[:, None], reach[:, None] * slopes, 0.0)
        own = np.where(np.isfinite(depths), reach * np.array([f.sigma_slope for f in found]), 0.0)
    return boxes.centres - away, depths - (slopes * away).sum(axis=1), np.hypot(sigma_px, own)


def _petal_depths(
    table: Array, depth: Array, focal_px: float, model: DepthModel, image: NDArray[np.uint8] | None
) -> list[PetalDepth]:
    """Depths of boxes (k, 4), those whose petals are seen best first: what is theirs is no other flower's.

    Without that a flower behind another would be found at the other's depth, as its box holds more of the other's
    petals than of its own.
    """
    others = [_reaching(table, k) for k in range(len(table))]
    found = [
        petal_depth(depth, box[:2], box[2:], focal_px, model, image, others[k]) if box[2:].min() > 0 else NO_DEPTH
        for k, box in enumerate(table)
    ]
    left = depth.copy()
    for k in np.argsort([-f.seen for f in found], kind="stable"):
        box = table[k]
        if not np.isfinite(found[k].depth) or not len(others[k]):
            continue
        found[k] = petal_depth(left, box[:2], box[2:], focal_px, model, image, others[k])
        if np.isfinite(found[k].depth):
            _take(left, box, found[k], focal_px)
    return found


def _take(left: Array, box: Array, petals: PetalDepth, focal_px: float) -> None:
    """Leave no depth where a flower's petals are."""
    low = np.maximum(np.floor(box[:2] - box[2:] / 2).astype(int), 0)
    high = np.maximum(np.ceil(box[:2] + box[2:] / 2).astype(int) + 1, low)
    patch = left[low[1] : high[1], low[0] : high[0]]
    u = np.arange(low[0], low[0] + patch.shape[1]) - box[0]
    v = (np.arange(low[1], low[1] + patch.shape[0]) - box[1])[:, None]
    inside = (2 * u / box[2]) ** 2 + (2 * v / box[3]) ** 2 <= 1.0
    plane = petals.depth + petals.slope_u * u + petals.slope_v * v
    reach = _DEEP * np.sqrt(box[2] * box[3]) * petals.depth / focal_px
    patch[inside & (np.abs(patch - plane) < reach)] = 0.0


def _reaching(table: Array, k: int) -> Array:
    """The boxes (m, 4) that touch box k."""
    away = np.abs(table[:, :2] - table[k, :2])
    touches = np.logical_and.reduce(away < (table[:, 2:] + table[k, 2:]) / 2 + table[k, 2:] / 2, axis=1)
    others: Array = table[touches & (np.arange(len(table)) != k)]
    return others


def _are_alike(widths: Array) -> BoolArray:
    """Which flowers are about as large as most in the picture: at a wrong depth they would not be."""
    known = widths[np.isfinite(widths)]
    if len(known) < _MIN_ALIKE:
        return np.ones(len(widths), bool)
    with np.errstate(divide="ignore", invalid="ignore"):
        alike: BoolArray = ~(np.abs(np.log(widths / np.median(known))) > np.log(_ALIKE))
    return alike


def _are_seen(shares: Array, known: BoolArray) -> BoolArray:
    """Which flowers are hidden so little that the depth is theirs, by what is usual: some detectors' boxes are wide."""
    usual = float(np.quantile(shares[known], 0.8)) if known.sum() >= _MIN_ALIKE else 1.0
    seen: BoolArray = shares >= _SEEN * min(usual, 1.0)
    return seen
