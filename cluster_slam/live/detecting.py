"""Flowers in the images of a live camera: a detector finds them, the depth image lifts them, as in a recording."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.lift import lift_boxes
from cluster_slam.live.view import LiveCamera, View
from cluster_slam.sensors.depth import depth_model

if TYPE_CHECKING:
    from cluster_slam.io.observed import Detector


@dataclass(frozen=True, slots=True)
class FlowerFinder:
    """Puts points in the place of images; a view that has points already stays as it is."""

    detector: Detector
    camera: LiveCamera

    def __call__(self, view: View) -> View:
        """The view with its flowers; without depth it has none.

        Raises
        ------
        InputError
            Nobody knows the intrinsics.
        """
        if view.colour is None or view.depth is None:
            return view
        intrinsics = self.camera.intrinsics
        if intrinsics is None:
            raise InputError("camera: images without intrinsics, expected a camera.yaml beside them")
        boxes = self.detector.detect(view.colour)
        focal = (intrinsics.fx + intrinsics.fy) / 2
        lifted = lift_boxes(
            intrinsics,
            boxes,
            view.depth.astype(np.float64) * (self.camera.depth_scale or 0.001),
            convention="z",
            model=depth_model(self.camera.depth_camera or "generic", focal_px=focal),
            sigma_px=self.detector.sigma_px(boxes.sizes),
            image=view.colour,
            lean=self.detector.lean,
        )
        keep = lifted.is_lifted
        return replace(view, points=lifted.points[keep], covs=lifted.covs[keep], scores=boxes.scores[keep])
