"""Which of a plant's flowers a session looked at: those that stood in its field of view."""

from __future__ import annotations

import numpy as np

from cluster_slam.geometry import Array, inverse, transform
from cluster_slam.io.map.incoming import View
from cluster_slam.records import BoolArray

SHARE = 0.02  # of the frames that must have had it in view, where the session is long


def looked_at(view: View | None, world: Array, min_views: int) -> BoolArray:
    """Which points (f, 3) of the session's world were in view often enough (f,); none where the view is not known."""
    if view is None or not len(world):
        return np.zeros(len(world), dtype=bool)
    n = len(view.T_world_camera)
    count = np.zeros(len(world), dtype=np.int64)
    for T in inverse(view.T_world_camera):
        points = transform(T, world)
        depth = points[:, 2]
        rays = np.column_stack([points[:, :2] / np.where(depth > 1e-6, depth, np.inf)[:, None], depth])
        count += ((rays >= view.low) & (rays <= view.high)).all(axis=1)
    needed = max(1, min(min_views, n), int(np.ceil(SHARE * n)))
    enough: BoolArray = count >= needed
    return enough
