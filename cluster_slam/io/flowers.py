"""``flowers.csv`` (level 3): flowers in the camera frame, with or without covariances."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.io.frames import frames_of
from cluster_slam.io.tables import Table, check_lengths, read_table
from cluster_slam.records import Observations, StatedNoise

MIN_CONDITION = 1e-12  # smallest to largest eigenvalue of a covariance that is still one
POINT_COV = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")


def read_flowers(path: Path, noise: StatedNoise, stamps: Array) -> tuple[Observations, tuple[str, ...]]:
    """Observations of ``flowers.csv`` and warnings; ``stamps`` (n,) are those of the frames."""
    table = read_table(path, ("timestamp", "x", "y", "z"), ("score", *POINT_COV))
    check_lengths(table, ("x", "y", "z"))
    frame = frames_of(table, stamps)
    has_covariance = _has_covariance(table)
    if has_covariance:
        covs = symmetric(table.stack(POINT_COV))
        check_covariances(table, covs)
    else:
        covs = np.broadcast_to(noise.flower**2 * np.eye(3), (len(table), 3, 3)).copy()
    scores = table.columns.get("score", np.full(len(table), np.nan))
    return Observations(frame, table.stack(("x", "y", "z")), covs, scores, has_covariance), table.warnings


def _has_covariance(table: Table) -> bool:
    there = [name for name in POINT_COV if name in table.columns]
    if there and len(there) < len(POINT_COV):
        missing = ", ".join(name for name in POINT_COV if name not in there)
        raise InputError(f"{table.path}: row 1: {there[0]} without {missing}, expected all six of the covariance")
    return bool(there)


def symmetric(upper: Array) -> Array:
    """Symmetric matrices (n, 3, 3) of their upper triangles ``xx xy xz yy yz zz`` (n, 6)."""
    return upper[:, [[0, 1, 2], [1, 3, 4], [2, 4, 5]]]


def check_covariances(table: Table, covs: Array) -> None:
    """Refuse covariances (n, 3, 3) that are not positive definite.

    Raises
    ------
    InputError
        Names the row and the smallest eigenvalue.
    """
    if not np.isfinite(covs).all():
        k = int((~np.isfinite(covs).all(axis=(1, 2))).argmax())
        raise table.refuse(k, "the covariance has an empty value, expected six finite numbers")
    eigenvalues = np.linalg.eigvalsh(covs)
    bad = eigenvalues[:, 0] <= MIN_CONDITION * np.abs(eigenvalues[:, 2])
    if bad.any():
        k = int(bad.argmax())
        low, high = eigenvalues[k, 0], eigenvalues[k, 2]
        text = f"covariance with eigenvalues from {low:.3g} to {high:.3g} m^2"
        raise table.refuse(k, f"{text}, expected a positive definite one")
