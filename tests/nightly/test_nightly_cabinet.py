"""A real depth camera (TUM RGB-D fr3 cabinet): what is lifted in one picture is where the next one sees it."""

from __future__ import annotations

import os
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from cluster_slam.geometry import inverse, pose_from_tum, transform
from cluster_slam.io.images import open_images, pictures
from cluster_slam.io.tables import TUM_POSE, read_tum
from cluster_slam.lift import lift
from cluster_slam.sensors.depth import depth_model

CABINET = Path(os.environ.get("CLUSTER_SLAM_DATA", "data/real")) / "tum-cabinet"
POSE_M = 0.005  # sigma of a motion-captured pose, as the session states


def _depths(depth: NDArray, pixels: NDArray) -> tuple[NDArray, NDArray]:
    """Depths (n,) about pixels (n, 2), and whether they are all there and of one surface."""
    u, v = pixels.T
    near = np.stack([depth[v + dv, u + du] for dv in (-2, 0, 2) for du in (-2, 0, 2)])
    return np.median(near, axis=0), (near.min(0) > 0) & (np.ptp(near, axis=0) < 0.05 * near.max(0))


@pytest.mark.nightly
@pytest.mark.skipif(not CABINET.is_dir(), reason="real recordings are not here (CLUSTER_SLAM_DATA)")
def test_views_of_a_cabinet_agree_to_the_depth_noise() -> None:
    table = read_tum(CABINET / "poses.txt")
    stamps, T_world_camera = table.columns["timestamp"], pose_from_tum(table.stack(TUM_POSE))
    images = open_images(CABINET, stamps, scale=0.0002, max_time_difference=0.02)
    camera = images.camera
    model = depth_model("generic", focal_px=(camera.fx + camera.fy) / 2)
    v, u = np.mgrid[20 : camera.height - 20 : 20, 20 : camera.width - 20 : 20]
    grid = np.column_stack([u.ravel(), v.ravel()])
    rows = []
    for a, b in pairwise(shot for shot in pictures(images) if shot.depth is not None):
        z, is_whole = _depths(a.depth, grid)
        points, _ = lift(
            camera, grid[is_whole].astype(float), z[is_whole], convention="z", sigma_px=0.5,
            depth_coefficient=model.coefficient,
        )  # fmt: skip
        moved = transform(inverse(T_world_camera[b.frame]) @ T_world_camera[a.frame], points)
        pixels = np.rint(camera.project(moved)).astype(int)
        inside = ((pixels > 2) & (pixels < [camera.width - 3, camera.height - 3])).all(1)
        seen, is_whole = _depths(b.depth, pixels[inside])
        expected = moved[inside, 2]
        rows += zip(seen[is_whole] - expected[is_whole], expected[is_whole], strict=True)
    difference, z = np.array(rows).T
    sigma = np.sqrt(2 * model.sigma(z) ** 2 + 2 * POSE_M**2)
    median, share = float(np.median(np.abs(difference))), float((np.abs(difference) < 3 * sigma).mean())
    text = f"cabinet: {len(z)} places, median difference {1e3 * median:.1f} mm, sigma {1e3 * np.median(sigma):.1f} mm"
    sys.stdout.write(f"{text}, within three sigma {share:.3f}\n")
    assert median < np.median(sigma)
    assert share > 0.85
