"""``detections.csv`` with ``camera.yaml`` (level 2): pixels and depths, lifted to flowers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.io.camera_info import read_camera
from cluster_slam.io.frames import frames_of
from cluster_slam.io.tables import Table, check_lengths, read_table
from cluster_slam.lift import Convention, lift
from cluster_slam.records import Observations, StatedNoise
from cluster_slam.sensors.camera import Camera


def read_detections(
    folder: Path, convention: Convention, noise: StatedNoise, stamps: Array
) -> tuple[Observations, tuple[str, ...]]:
    """Observations of a session's detections, and warnings.

    Parameters
    ----------
    folder
        The session.
    convention
        What a depth is measured along.
    noise
        Its sigmas of pixel and depth become the covariances.
    stamps
        (n,) of the frames.

    Raises
    ------
    InputError
        Names file, row, value and what was expected.
    """
    table = read_table(
        folder / "detections.csv", ("timestamp", "u", "v", "depth"), ("score",), ignored=("width", "height")
    )
    check_lengths(table, ("u", "v", "depth"))
    camera = read_camera(folder / "camera.yaml")
    depths = table.columns["depth"]
    if (depths <= 0).any():
        k = int((depths <= 0).argmax())
        raise table.refuse(k, f"depth is {depths[k]:g}, expected metres above 0")
    frame = frames_of(table, stamps)
    pixels = table.stack(("u", "v"))
    points, covs = lift(
        camera, pixels, depths, convention=convention, sigma_px=noise.pixel, depth_coefficient=noise.depth
    )
    lost = np.isnan(points).any(axis=1)
    if lost.any():
        k = int(lost.argmax())
        u, v = pixels[k]
        raise table.refuse(k, f"u {u:g}, v {v:g} where the distortion has no inverse, expected a pixel of the image")
    scores = table.columns.get("score", np.full(len(table), np.nan))
    warnings = (*table.warnings, *_outside(table, camera))
    return Observations(frame, points, covs, scores, True), warnings


def _outside(table: Table, camera: Camera) -> tuple[str, ...]:
    """A warning where pixels lie outside of the image."""
    u, v = table.columns["u"], table.columns["v"]
    width = np.inf if camera.width is None else camera.width
    height = np.inf if camera.height is None else camera.height
    outside = (u < -0.5) | (u > width - 0.5) | (v < -0.5) | (v > height - 0.5)
    if not outside.any():
        return ()
    k = int(outside.argmax())
    size = f"{camera.width} x {camera.height}"
    text = f"u {u[k]:g}, v {v[k]:g} is outside of the image of {size}, as are {outside.sum() - 1} more"
    return (f"{table.path}: row {table.rows[k]}: {text}",)
