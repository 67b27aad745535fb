"""Which format a recording has, and its importer."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import tum_from_pose
from cluster_slam.io.importers.images_folder import is_open3d, is_tum, read_open3d_folder, read_tum_folder
from cluster_slam.io.importers.poses import log_stamps
from cluster_slam.io.importers.positions import read_positions
from cluster_slam.io.importers.recording import Imported, ImportOptions, Stream
from cluster_slam.io.importers.ros import read_bag
from cluster_slam.io.importers.ros_bag import is_bag
from cluster_slam.io.importers.rtde_csv import is_rtde_csv, read_rtde_csv
from cluster_slam.io.importers.session_files import SessionHead

KNOWN = (
    "a ROS 1 or 2 bag (.bag, .db3, .mcap or a folder), a RealSense recording (.db3, .bag), a TUM RGB-D folder, "
    "an Open3D capture, an RTDE log (.csv), or positions per frame (.csv, .mat)"
)


def read_source(path: Path, options: ImportOptions) -> Imported:
    """A recording of any known format, ready to be written.

    Raises
    ------
    InputError
        No known format, or the importer's own refusal.
    """
    if not path.exists():
        raise InputError(f"{path}: missing, expected {KNOWN}")
    if is_bag(path):
        return read_bag(path, options)
    if path.is_dir():
        if is_tum(path):
            return read_tum_folder(path, options)
        if is_open3d(path):
            return read_open3d_folder(path, options)
        names = ", ".join(sorted(entry.name for entry in path.iterdir())[:8])
        raise InputError(f"{path}: a folder with {names or 'nothing'}, expected {KNOWN}")
    if is_rtde_csv(path):
        return _rtde(path, options)
    if path.suffix.lower() in (".csv", ".mat", ".txt"):
        return read_positions(path, options)
    raise InputError(f"{path}: of no known format, expected {KNOWN}")


def _rtde(path: Path, options: ImportOptions) -> Imported:
    """The arm alone: a session whose frames saw nothing."""
    log = read_rtde_csv(path)
    stamps = log_stamps(log) + options.time_offset_s
    known = options.T_flange_camera
    head = SessionHead(
        options.id or path.stem,
        options.plant,
        "T_world_flange",
        T_flange_camera=np.array([0.0, 0, 0, 0, 0, 0, 1]) if known is None else known,
        hand_eye_sigmas=(1.0, 3.0) if known is None else None,
        source=f"imported from {path.name}",
    )
    begin, end = float(stamps[0]), float(stamps[-1])
    kinds = {"actual_TCP_pose": "pose"}
    streams = tuple(
        Stream(name, f"{column.shape[1]} numbers", len(column), begin, end, kinds.get(name, ""))
        for name, column in log.columns.items()
    )
    return Imported("RTDE log", streams, head, stamps, tum_from_pose(log.poses), warnings=log.warnings)
