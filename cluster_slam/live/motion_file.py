"""Files that an emulated arm can play: TUM trajectories and RTDE logs."""

from __future__ import annotations

from pathlib import Path

from cluster_slam.errors import InputError
from cluster_slam.geometry import pose_from_tum
from cluster_slam.io.importers.rtde_csv import is_rtde_csv, read_rtde_csv
from cluster_slam.io.tables import TUM_POSE, read_tum
from cluster_slam.sensors.rtde.motion import Motion, motion_of_poses


def read_motion(path: Path, *, goes_back: bool = False) -> Motion:
    """The motion in a file, or in the ``poses.txt`` of a session.

    Raises
    ------
    InputError
        The file is neither, or holds no pose.
    """
    if path.is_dir():
        path = path / "poses.txt"
    if is_rtde_csv(path):
        log = read_rtde_csv(path)
        return Motion(log.stamps - log.stamps[0], log.columns, goes_back)
    table = read_tum(path, "a TUM trajectory or an RTDE log as CSV")
    if not len(table):
        raise InputError(f"{path}: row 1: no pose, expected rows of timestamp tx ty tz qx qy qz qw")
    return motion_of_poses(table.columns["timestamp"], pose_from_tum(table.stack(TUM_POSE)), goes_back=goes_back)
