"""A session of pictures as it is, without looking for flowers in them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cluster_slam.geometry import pose_from_tum
from cluster_slam.io.metadata import read_metadata
from cluster_slam.io.session import stated_noise
from cluster_slam.io.tables import TUM_POSE, read_tum
from cluster_slam.records import Observations, Session


def open_pictures(folder: Path) -> Session:
    """Metadata and poses of a session of level 1; nobody has seen a flower in it.

    Raises
    ------
    InputError
        Names file, row, value and what was expected.
    """
    metadata, warnings = read_metadata(folder / "session.toml")
    poses = read_tum(folder / "poses.txt", "a TUM trajectory with one row a frame")
    mount = metadata.frames.T_flange_camera if metadata.frames.pose == "T_world_flange" else None
    return Session(
        id=metadata.id,
        stamps=poses.columns["timestamp"],
        poses=pose_from_tum(poses.stack(TUM_POSE)),
        pose_frame=metadata.frames.pose,
        pose_error=metadata.frames.pose_error,
        T_flange_camera=None if mount is None else pose_from_tum(np.array(mount)),
        noise=stated_noise(metadata),
        observations=Observations(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0)),
        plant=metadata.plant,
        path=folder,
        level=1,
        warnings=(*warnings, *poses.warnings),
    )
