"""Boxes of flowers in a picture and the depth image beside it, lifted to points with covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.lift.petals import NO_DEPTH, petal_depth
from cluster_slam.lift.points import Convention, lift_unscented
from cluster_slam.records import BoolArray, ImageDetections
from cluster_slam.sensors.camera import Camera
from cluster_slam.sensors.depth import DepthModel


@dataclass(frozen=True, slots=True, eq=False)
class LiftedBoxes:
    """Flowers of one picture; rows as the detections, NaN where a box has no depth."""

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
    """
    focal = (camera.fx + camera.fy) / 2
    found = [
        petal_depth(depth, centre, size, focal, model) if size.min() > 0 else NO_DEPTH
        for centre, size in zip(boxes.centres, boxes.sizes, strict=True)
    ]
    depths = np.array([f.depth for f in found])
    sigmas = np.array([f.sigma for f in found])
    slopes = np.array([(f.slope_u, f.slope_v) for f in found]).reshape(-1, 2)
    points, covs = np.full((len(found), 3), np.nan), np.full((len(found), 3, 3), np.nan)
    good = np.isfinite(depths)
    if good.any():
        points[good], covs[good] = lift_unscented(
            camera,
            boxes.centres[good],
            depths[good],
            convention=convention,
            sigma_px=sigma_px[good],
            sigma_depth=sigmas[good],
            slopes=slopes[good],
            focal_sigma=model.focal_sigma,
            centre_sigma_px=model.centre_sigma_px,
        )
    good &= np.isfinite(points).all(1)
    return LiftedBoxes(depths, sigmas, points, covs, good)
