"""Poses of a recording at the stamps of its frames, and pose files beside it."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, pose_from_tum, tum_from_pose
from cluster_slam.io.importers.rtde_csv import RtdeLog, is_rtde_csv, read_rtde_csv
from cluster_slam.io.tables import read_tum
from cluster_slam.io.text import read_text
from cluster_slam.records import PoseFrame
from cluster_slam.sensors.clock import fit_clock
from cluster_slam.sensors.interpolation import interpolate

MAX_GAP_S = 0.5  # between two poses; across a longer gap none is made up


def rows_at(stamps: Array, rows: Array, at: Array) -> Array:
    """Rows ``tx ty tz qx qy qz qw`` (n, 7) at the times ``at`` (n,), NaN where no poses lie around.

    A pose of exactly that time is taken over bit by bit; between two, their motion is interpolated.
    """
    out = np.full((len(at), 7), np.nan)
    if not len(stamps):
        return out
    i = np.searchsorted(stamps, at)
    after, before = np.clip(i, 0, len(stamps) - 1), np.clip(i - 1, 0, len(stamps) - 1)
    is_hit = stamps[after] == at
    is_between = ~is_hit & (i > 0) & (i < len(stamps)) & (stamps[after] - stamps[before] <= MAX_GAP_S)
    out[is_hit] = rows[after[is_hit]]
    if is_between.any():
        out[is_between] = tum_from_pose(interpolate(stamps, pose_from_tum(rows), at[is_between]))
    return out


def read_pose_file(path: Path, offset_s: float) -> tuple[Array, Array, PoseFrame, tuple[str, ...]]:
    """Stamps (p,), rows (p, 7), the frame they are of, and warnings, of a TUM trajectory or an RTDE log.

    Raises
    ------
    InputError
        Neither, or no pose in it.
    """
    if is_rtde_csv(path):
        log = read_rtde_csv(path)
        return log_stamps(log) + offset_s, tum_from_pose(log.poses), "T_world_flange", log.warnings
    table = read_tum(path, "a TUM trajectory or an RTDE log as CSV")
    if not len(table):
        raise InputError(f"{path}: row 1: no pose, expected rows of timestamp tx ty tz qx qy qz qw")
    return table.columns["timestamp"] + offset_s, _as_written(path), "T_world_camera", table.warnings


def _as_written(path: Path) -> Array:
    """The poses (p, 7) of a trajectory that has been checked, bit by bit: quaternions are not normalised."""
    lines = (line.split("#", 1)[0] for line in read_text(path, "a TUM trajectory").split("\n"))
    return np.array([[float(x) for x in line.split()[1:]] for line in lines if line.strip()])


def log_stamps(log: RtdeLog) -> Array:
    """Unix times (n,) of a log's samples, by a fit of both clocks, where it has the host's; else the controller's."""
    if log.host is None:
        return log.stamps
    return fit_clock(log.stamps, log.host).arrival(log.stamps)
