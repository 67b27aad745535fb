"""What a map takes in: a result folder of ``smooth`` or ``track``, or a table of landmarks."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, inverse, pose_from_tum, transform
from cluster_slam.io.flowers import POINT_COV, check_covariances, symmetric
from cluster_slam.io.metadata import read_metadata
from cluster_slam.io.run_record import read_run
from cluster_slam.io.tables import TUM_POSE, Table, check_lengths, read_table, read_tum
from cluster_slam.records import Constellation, IntArray

LANDMARK_SIGMA_M = 0.001  # of a landmark without a covariance
_POINT = ("x", "y", "z")


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """Where the cameras of a session were and what they could see: a box of directions and depths."""

    T_world_camera: Array  # (n, 4, 4)
    low: Array  # (3,) x/z, y/z, z
    high: Array  # (3,)


@dataclass(frozen=True, slots=True, eq=False)
class Incoming:
    """A session on its way into a map."""

    constellation: Constellation
    kind: str  # result or landmarks
    digest: str  # SHA-256 of the tables
    view: View | None = None
    warnings: tuple[str, ...] = ()


def read_incoming(folder: str | Path) -> Incoming:
    """A result folder as a constellation.

    Raises
    ------
    InputError
        It is no result, or one of its tables is wrong.
    """
    folder = Path(folder)
    if not folder.is_dir():
        raise InputError(f"{folder}: {'is a file' if folder.exists() else 'missing'}, expected a result folder")
    run = read_run(folder / "run.json")
    session, plant, warnings = names_of(folder, run.session_path, run.session)
    flowers = read_table(
        folder / "flowers.csv", ["flower_id", "cluster_id", *_POINT, *POINT_COV, "first_seen", "last_seen"]
    )
    clusters = read_table(
        folder / "clusters.csv", ["cluster_id", *_POINT], ("inertia", "mean_distance", "cov_ii", "cov_id", "cov_dd")
    )
    trajectory = read_tum(folder / "trajectory.txt")
    stamps = trajectory.columns["timestamp"]
    if not len(stamps):
        raise InputError(f"{folder / 'trajectory.txt'}: row 1: no frame, expected at least one")
    T_world_camera = pose_from_tum(trajectory.stack(TUM_POSE))
    view = T_world_camera[:, :3, 3].mean(axis=0)
    constellation = _constellation(flowers, session, plant, float(stamps[0]), float(stamps[-1]), view)
    descriptors, covs = _descriptors(clusters, constellation.cluster_ids)
    constellation = _with_descriptors(constellation, descriptors, covs)
    seen = _view(folder / "observations.csv", stamps, T_world_camera, constellation)
    digest = hashlib.sha256((folder / "flowers.csv").read_bytes() + (folder / "clusters.csv").read_bytes()).hexdigest()
    return Incoming(constellation, "result", digest, seen, warnings)


def names_of(folder: Path, session_path: Path | None, session: str | None) -> tuple[str, str | None, tuple[str, ...]]:
    """Id of the session and name of its plant, from the session's own metadata where it is still there."""
    if session_path is not None and (session_path / "session.toml").exists():
        metadata, _ = read_metadata(session_path / "session.toml")
        return metadata.id, metadata.plant, ()
    name = session or folder.resolve().name
    return name, None, (f"{folder}: its session is not where it was, so the plant's name is not known",)


def read_landmarks(path: str | Path, *, time: float | None, session: str | None = None) -> Incoming:
    """A table ``flower_id,cluster_id,x,y,z`` (and the six columns of a covariance, where known) as a constellation.

    Parameters
    ----------
    time
        s, when they stood there. None: that of the session whose ``truth/`` the file lies in; unknown elsewhere.
    session
        Its id in the map. None: that of the session whose ``truth/`` it lies in, else the name of the file.

    Raises
    ------
    InputError
        Names file, row, value and what was expected.
    """
    path = Path(path)
    table = read_table(path, ("flower_id", "cluster_id", *_POINT), POINT_COV)
    if not len(table):
        raise InputError(f"{path}: row 1: no landmark, expected rows of flower_id,cluster_id,x,y,z")
    start, end, name = _around(path)
    if time is not None:
        start = end = time
    constellation = _constellation(table, session or name, None, start, end, None)
    return Incoming(constellation, "landmarks", hashlib.sha256(path.read_bytes()).hexdigest())


def _around(path: Path) -> tuple[float, float, str]:
    """First and last stamp and id of the session whose ``truth/`` a file lies in; unknown (NaN) elsewhere."""
    folder = path.resolve().parent.parent
    if path.resolve().parent.name != "truth" or not (folder / "session.toml").exists():
        return float("nan"), float("nan"), f"landmarks-{path.stem}"
    name = read_metadata(folder / "session.toml")[0].id
    stamps = read_tum(folder / "poses.txt").columns["timestamp"]
    return float(stamps[0]), float(stamps[-1]), f"landmarks-{name}"


def _constellation(
    table: Table, session: str, plant: str | None, start: float, end: float, viewpoint: Array | None
) -> Constellation:
    check_lengths(table, _POINT)
    if all(name in table.columns for name in POINT_COV):
        covs = symmetric(table.stack(POINT_COV))
        check_covariances(table, covs)
    else:
        covs = np.tile(LANDMARK_SIGMA_M**2 * np.eye(3), (len(table), 1, 1))
    flower, cluster = _ids(table, "flower_id"), _ids(table, "cluster_id")
    order = np.argsort(flower, kind="stable")
    if (np.diff(flower[order]) == 0).any():
        k = int(order[1:][np.diff(flower[order]) == 0][0])
        raise table.refuse(k, f"flower_id {flower[k]} a second time, expected each once")
    names = np.unique(cluster)
    none = np.zeros((len(names), 2)), np.zeros((len(names), 2, 2))
    points = table.stack(_POINT)[order]
    return Constellation(
        session, start, end, flower[order], cluster[order], points, covs[order], names, *none, plant, viewpoint
    )


def _ids(table: Table, name: str) -> IntArray:
    values = table.columns[name]
    bad = (values != np.rint(values)) | (values < 0) | (values > 2**53)
    if bad.any():
        k = int(bad.argmax())
        raise table.refuse(k, f"{name} is {values[k]!s}, expected a whole number from 0")
    return values.astype(np.int64)


def _descriptors(table: Table, cluster_ids: IntArray) -> tuple[Array, Array]:
    """Descriptors (c, 2) and covariances (c, 2, 2) of the clusters that have flowers."""
    known = ("inertia", "mean_distance", "cov_ii", "cov_id", "cov_dd")
    ids = _ids(table, "cluster_id")
    missing = np.setdiff1d(cluster_ids, ids)
    if len(missing):
        raise InputError(f"{table.path}: no row for cluster {missing[0]}, which flowers.csv names")
    if not all(name in table.columns for name in known):
        return np.zeros((len(cluster_ids), 2)), np.zeros((len(cluster_ids), 2, 2))
    order = np.argsort(ids)
    row = order[np.searchsorted(ids[order], cluster_ids)]
    values = np.nan_to_num(table.stack(known)[row])
    return values[:, :2], values[:, 2:][:, [[0, 1], [1, 2]]]


def _with_descriptors(constellation: Constellation, descriptors: Array, covs: Array) -> Constellation:
    from dataclasses import replace

    return replace(constellation, descriptors=descriptors, descriptor_covs=covs)


def _view(path: Path, stamps: Array, T_world_camera: Array, constellation: Constellation) -> View | None:
    """The field of view, as the flowers that were seen show it."""
    table = read_table(path, ("timestamp", "flower_id"), ignored=("cluster_id", "reason", "nis"))
    flower = table.columns["flower_id"].astype(np.int64)
    frame = np.clip(np.searchsorted(stamps, table.columns["timestamp"] - 1e-5), 0, len(stamps) - 1)
    row = np.searchsorted(constellation.flower_ids, flower)
    row = np.clip(row, 0, max(len(constellation.flower_ids) - 1, 0))
    known = np.isin(flower, constellation.flower_ids)
    if not known.any():
        return None
    points = transform(inverse(T_world_camera)[frame[known]], constellation.flowers[row[known]])
    points = points[points[:, 2] > 1e-3]
    if not len(points):
        return None
    rays = np.column_stack([points[:, :2] / points[:, 2:], points[:, 2]])
    return View(T_world_camera, rays.min(axis=0), rays.max(axis=0))
