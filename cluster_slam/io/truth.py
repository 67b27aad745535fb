"""``truth/`` of a session: for evaluation and simulation only."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, pose_from_tum
from cluster_slam.io.camera_info import read_camera
from cluster_slam.io.frames import frames_of, tolerance
from cluster_slam.io.metadata import read_metadata
from cluster_slam.io.tables import TUM_POSE, Table, check_lengths, read_table, read_tum
from cluster_slam.records import IntArray, Session, Truth
from tracking.assignment import assign

BOX_REACH = 0.4  # of a flower's width: a detection farther from its middle does not show it
_BOX = ("u", "v", "width", "height")


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
    if session.level == 1:
        flower_ids, cluster_ids = ids_from_boxes(folder / "boxes.csv", session)
    else:
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


def ids_from_boxes(path: Path, session: Session) -> tuple[IntArray | None, IntArray | None]:
    """Which flower each observation of a session of pictures shows: the box whose middle it is nearest to.

    One-to-one in each frame; -1 where no box is so near as ``BOX_REACH`` of its size.

    Parameters
    ----------
    path
        ``truth/boxes.csv``: ``timestamp,flower_id,cluster_id,u,v,width,height,visible``.
    session
        Of level 1, with its observations.
    """
    if not path.exists() or session.path is None:
        return None, None
    table = read_table(path, ("timestamp", "flower_id", "cluster_id", *_BOX, "visible"), ("depth",))
    camera, seen = read_camera(session.path / "camera.yaml"), session.observations
    pixels, boxes = camera.project(seen.points), table.stack(_BOX)
    box_frame = frames_of(table, session.stamps)
    flower_ids, cluster_ids = np.full(len(seen), -1), np.full(len(seen), -1)
    is_visible = table.columns["visible"] > 0
    for k in np.unique(seen.frame).tolist():
        i, j = np.flatnonzero(seen.frame == k), np.flatnonzero((box_frame == k) & is_visible)
        away = np.linalg.norm(pixels[i, None] - boxes[None, j, :2], axis=2)
        rows, columns = assign(away / np.sqrt(boxes[j, 2] * boxes[j, 3]), BOX_REACH)
        flower_ids[i[rows]] = _ids(table, "flower_id")[j[columns]]
        cluster_ids[i[rows]] = _ids(table, "cluster_id")[j[columns]]
    return flower_ids, cluster_ids


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
