"""``truth/`` of a session: for evaluation and simulation only."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, pose_from_tum
from cluster_slam.io.frames import tolerance
from cluster_slam.io.metadata import read_metadata
from cluster_slam.io.tables import TUM_POSE, Table, check_lengths, read_table, read_tum
from cluster_slam.records import IntArray, Session, Truth


def open_truth(path: str | Path, session: Session) -> Truth | None:
    """Ground truth of a session folder; None where there is none.

    Raises
    ------
    InputError
        A file of ``truth/`` is wrong or does not fit the session.
    """
    folder = Path(path) / "truth"
    metadata, _ = read_metadata(Path(path) / "session.toml")
    T_map_world = metadata.truth.T_map_world
    if not folder.is_dir() and T_map_world is None:
        return None
    flower_ids, cluster_ids = _true_ids(folder / "observations.csv", len(session.observations))
    rest = _true_rest(folder / "rest.csv")
    return Truth(
        T_world_camera=_true_poses(folder / "poses.txt", session.stamps),
        flower_ids=flower_ids,
        cluster_ids=cluster_ids,
        rest_flower_ids=None if rest is None else _ids(rest, "flower_id"),
        rest_cluster_ids=None if rest is None else _ids(rest, "cluster_id"),
        rest_positions=None if rest is None else rest.stack(("x", "y", "z")),
        T_map_world=None if T_map_world is None else pose_from_tum(np.array(T_map_world)),
    )


def _true_ids(path: Path, n_observations: int) -> tuple[IntArray | None, IntArray | None]:
    if not path.exists():
        return None, None
    table = read_table(path, ("flower_id", "cluster_id"))
    if len(table) != n_observations:
        raise InputError(f"{path}: {len(table)} rows, expected {n_observations}: one for each row of the input")
    return _ids(table, "flower_id"), _ids(table, "cluster_id")


def _ids(table: Table, name: str) -> IntArray:
    values = table.columns[name]
    bad = (values != np.rint(values)) | (np.abs(values) > 2**53)
    if bad.any():
        k = int(bad.argmax())
        raise table.refuse(k, f"{name} is {values[k]!s}, expected a whole number")
    return values.astype(np.int64)


def _true_rest(path: Path) -> Table | None:
    if not path.exists():
        return None
    table = read_table(path, ("flower_id", "cluster_id", "x", "y", "z"))
    check_lengths(table, ("x", "y", "z"))
    return table


def _true_poses(path: Path, stamps: Array) -> Array | None:
    """True camera poses (n, 4, 4) of the frames, NaN where truth has none for a frame."""
    if not path.exists():
        return None
    table = read_tum(path)
    times = table.columns["timestamp"]
    T = np.full((len(stamps), 4, 4), np.nan)
    if len(times):
        k = np.clip(np.searchsorted(times, stamps - tolerance(stamps)), 0, len(times) - 1)
        fits = np.abs(times[k] - stamps) <= tolerance(stamps)
        T[fits] = pose_from_tum(table.stack(TUM_POSE))[k[fits]]
    return T
