"""``detections.csv`` with ``camera.yaml`` (level 2): pixels and depths, lifted to flowers."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.io.camera_info import read_camera
from cluster_slam.io.frames import frames_of
from cluster_slam.io.tables import Table, check_lengths, read_table
from cluster_slam.lift import Convention, lift, lift_unscented
from cluster_slam.records import Observations, StatedNoise
from cluster_slam.sensors.camera import Camera

SIGMAS = ("sigma_pixel", "sigma_depth")  # optional columns, as the command detect writes them: px, m


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
        folder / "detections.csv",
        ("timestamp", "u", "v", "depth"),
        ("score", *SIGMAS),
        ignored=("width", "height"),
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
    if all(name in table.columns for name in SIGMAS):
        points, covs = _with_own_sigmas(camera, table, convention, noise)
    lost = np.isnan(points).any(axis=1)
    if lost.any():
        k = int(lost.argmax())
        u, v = pixels[k]
        raise table.refuse(k, f"u {u:g}, v {v:g} where the distortion has no inverse, expected a pixel of the image")
    scores = table.columns.get("score", np.full(len(table), np.nan))
    warnings = (*table.warnings, *_outside(table, camera))
    return Observations(frame, points, covs, scores, True), warnings


def _with_own_sigmas(camera: Camera, table: Table, convention: Convention, noise: StatedNoise) -> tuple[Array, Array]:
    """Points and covariances where the detector said how well it knows each pixel and depth.

    Raises
    ------
    InputError
        A sigma is not above 0.
    """
    depths, pixels = table.columns["depth"], table.stack(("u", "v"))
    stated = (np.full(len(table), noise.pixel), noise.depth * depths**2)
    given = [np.where(np.isnan(table.columns[n]), s, table.columns[n]) for n, s in zip(SIGMAS, stated, strict=True)]
    for name, values in zip(SIGMAS, given, strict=True):
        if not (values > 0).all():
            k = int((~(values > 0)).argmax())
            raise table.refuse(k, f"{name} is {values[k]:g}, expected a number above 0")
    return lift_unscented(camera, pixels, depths, convention=convention, sigma_px=given[0], sigma_depth=given[1])


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
