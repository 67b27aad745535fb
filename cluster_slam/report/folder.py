"""A result folder read back for figures, with or without the session that it was made from."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cluster_slam.geometry import pose_from_tum
from cluster_slam.io.frames import frames_of
from cluster_slam.io.read_result import read_result
from cluster_slam.io.tables import TUM_POSE, read_table, read_tum
from cluster_slam.records import Observations, Result, Session, StatedNoise


def open_result(folder: Path, session: Session | None = None) -> Result:
    """A result folder as a record.

    Parameters
    ----------
    folder : Path
        The result.
    session : Session, optional
        What it was made from. Without it, the session's part is what the result itself knows: its frames and which of
        them each observation belongs to. The given poses are then the estimated ones, points and covariances are NaN.

    Raises
    ------
    InputError
        The folder is no result, is damaged, or is of another session.
    """
    return read_result(folder, session or _session_of(folder))


def _session_of(folder: Path) -> Session:
    trajectory = read_tum(folder / "trajectory.txt")
    stamps = trajectory.columns["timestamp"]
    rows = read_table(folder / "observations.csv", ("timestamp", "flower_id", "cluster_id"), words=("reason",))
    unknown = np.full((len(rows), 3, 3), np.nan)
    observations = Observations(frames_of(rows, stamps), unknown[:, 0], unknown, unknown[:, 0, 0])
    return Session(
        id=folder.resolve().name,
        stamps=stamps,
        poses=pose_from_tum(trajectory.stack(TUM_POSE)),
        pose_frame="T_world_camera",
        pose_error="absolute",
        T_flange_camera=None,
        noise=StatedNoise(),
        observations=observations,
    )
