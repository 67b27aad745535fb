"""A session folder, read and checked: poses, flowers in the camera frame, and truth where there is any."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, pose_from_tum
from cluster_slam.io.metadata import Metadata, read_metadata
from cluster_slam.io.tables import Table, check_lengths, check_stamps, read_table, read_tum
from cluster_slam.records import IntArray, Observations, Session, StatedNoise, Truth

STAMP_TOLERANCE = 1e-6  # s; a row belongs to the frame whose stamp agrees within this
MIN_CONDITION = 1e-12  # smallest to largest eigenvalue of a covariance that is still one
POINT_COV = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")
LEVEL_FILES = {3: "flowers.csv", 2: "detections.csv", 1: "rgb.txt"}
TUM_POSE = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")


def open_session(path: str | Path, *, level: int | None = None) -> Session:
    """Read a session folder.

    Parameters
    ----------
    path
        The folder.
    level
        Where to start: 3 flowers, 2 detections. None: the highest level that is there.

    Returns
    -------
    Session
        All values checked; what looks odd but can be used is named in ``warnings``.

    Raises
    ------
    InputError
        Names file, row, value and what was expected.
    """
    folder = Path(path)
    _check_folder(folder)
    metadata, warnings = read_metadata(folder / "session.toml")
    poses = read_tum(folder / "poses.txt", "a TUM trajectory with one row a frame")
    if not len(poses):
        raise InputError(f"{poses.path}: row 1: no frame, expected rows of timestamp tx ty tz qx qy qz qw")
    noise = stated_noise(metadata)
    stamps = poses.columns["timestamp"]
    used = _level(folder, level)
    observations, more = _read_observations(folder, used, metadata, noise, stamps)
    hand_eye = metadata.frames.T_flange_camera if metadata.frames.pose == "T_world_flange" else None
    session = Session(
        id=metadata.id,
        stamps=stamps,
        poses=pose_from_tum(poses.stack(TUM_POSE)),
        pose_frame=metadata.frames.pose,
        pose_error=metadata.frames.pose_error,
        T_flange_camera=None if hand_eye is None else pose_from_tum(np.array(hand_eye)),
        noise=noise,
        observations=observations,
        plant=metadata.plant,
        path=folder,
        level=used,
    )
    return replace(session, warnings=(*warnings, *poses.warnings, *more, *unit_warnings(session)))


def _check_folder(folder: Path) -> None:
    if not folder.exists():
        raise InputError(f"{folder}: missing, expected a session folder")
    if not folder.is_dir():
        raise InputError(f"{folder}: is a file, expected a session folder")


def stated_noise(metadata: Metadata) -> StatedNoise:
    """The sigmas that a session states, with defaults where it states none."""
    stated = metadata.noise.model_dump(include=set(type(metadata.noise).model_fields), exclude_none=True)
    return replace(StatedNoise(), **stated)


def _level(folder: Path, level: int | None) -> int:
    there = [n for n, name in LEVEL_FILES.items() if (folder / name).exists()]
    if level is None:
        if not there:
            raise InputError(f"{folder}: no flowers.csv, detections.csv or rgb.txt, expected at least one of them")
        level = there[0]
    if level not in LEVEL_FILES:
        raise InputError(f"{folder}: level {level}, expected 2 (detections.csv) or 3 (flowers.csv)")
    if level not in there:
        raise InputError(f"{folder / LEVEL_FILES[level]}: missing, expected as level {level} was asked for")
    if level == 1:
        raise InputError(f"{folder}: has images only (level 1), expected flowers.csv or detections.csv beside them")
    return level


def _read_observations(
    folder: Path, level: int, metadata: Metadata, noise: StatedNoise, stamps: Array
) -> tuple[Observations, tuple[str, ...]]:
    if level == 3:
        return read_flowers(folder / LEVEL_FILES[3], noise, stamps)
    from cluster_slam.io.detections import read_detections

    return read_detections(folder, metadata.depth.convention, noise, stamps)


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


def frames_of(table: Table, stamps: Array) -> IntArray:
    """Index of the frame (m,) of each row, by its stamp.

    Raises
    ------
    InputError
        A row belongs to no frame.
    """
    check_stamps(table)
    times = table.columns["timestamp"]
    after = np.clip(np.searchsorted(stamps, times), 0, len(stamps) - 1)
    before = np.maximum(after - 1, 0)
    nearest = np.where(np.abs(stamps[after] - times) <= np.abs(stamps[before] - times), after, before)
    off = np.abs(stamps[nearest] - times)
    lost = off > STAMP_TOLERANCE + np.spacing(np.abs(times))  # what two decimal stamps lose as float64
    if lost.any():
        k = int(lost.argmax())
        text = f"timestamp {times[k]!s} belongs to no frame of poses.txt (nearest {stamps[nearest[k]]!s})"
        raise table.refuse(k, f"{text}, expected one within 1 microsecond")
    return nearest.astype(np.int64)


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


def unit_warnings(session: Session) -> tuple[str, ...]:
    """What suggests that a length is not in metres, in words."""
    return ()


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
        k = np.clip(np.searchsorted(times, stamps - STAMP_TOLERANCE - np.spacing(np.abs(stamps))), 0, len(times) - 1)
        fits = np.abs(times[k] - stamps) <= STAMP_TOLERANCE + np.spacing(np.abs(stamps))
        T[fits] = pose_from_tum(table.stack(TUM_POSE))[k[fits]]
    return T
