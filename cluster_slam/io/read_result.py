"""A result folder, read back for evaluation and figures."""

from __future__ import annotations

import tomllib
from dataclasses import replace
from pathlib import Path
from typing import cast, get_args

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, pose_from_tum
from cluster_slam.io.flowers import POINT_COV, symmetric
from cluster_slam.io.frames import frames_of
from cluster_slam.io.result import CLUSTER_COLUMNS, DRIFT_COLUMNS, FLOWER_COLUMNS
from cluster_slam.io.run_record import RunRecord, read_run
from cluster_slam.io.tables import NORM_TOLERANCE, TUM_POSE, Table, check_lengths, read_table, read_tum
from cluster_slam.io.text import read_text, shown
from cluster_slam.records import (
    Calibration,
    Clusters,
    Diagnostics,
    Drift,
    Flowers,
    IntArray,
    RejectReason,
    Result,
    Session,
    State,
)

DESCRIPTOR = ("inertia", "mean_distance", "cov_ii", "cov_id", "cov_dd")  # NaN for clusters that have none


def read_result(path: str | Path, session: Session) -> Result:
    """Read a result folder.

    Parameters
    ----------
    path
        The folder.
    session
        The session that it was made from.

    Raises
    ------
    InputError
        Names file, row, value and what was expected, also where the result is of another session.
    """
    folder = Path(path)
    if not folder.is_dir():
        raise InputError(f"{folder}: {'is a file' if folder.exists() else 'missing'}, expected a result folder")
    run = read_run(folder / "run.json")
    flower_ids, cluster_ids, diagnostics = _observations(folder / "observations.csv", session, run)
    clusters = _clusters(folder / "clusters.csv")
    return Result(
        session=session,
        T_world_camera=_trajectory(folder / "trajectory.txt", session),
        flower_ids=flower_ids,
        cluster_ids=cluster_ids,
        flowers=_flowers(folder / "flowers.csv", clusters),
        clusters=clusters,
        drift=_drift(folder / "drift.csv", session),
        calibration=_calibration(folder / "calibration.toml"),
        diagnostics=diagnostics,
        command=run.command,
        config=run.config,
        seed=run.seed or 0,
        timings_s=run.timings_s,
        counts=run.counts,
        warnings=run.warnings,
        merged=run.merged,
        status=run.status,
    )


def _trajectory(path: Path, session: Session) -> Array:
    table = read_tum(path)
    _same_length(table, session.n_frames, "frames of the session")
    off = np.abs(table.columns["timestamp"] - session.stamps) > 1e-5
    if off.any():
        k = int(off.argmax())
        stamp = table.columns["timestamp"][k]
        raise table.refuse(k, f"timestamp {stamp!s}, expected {session.stamps[k]!s} as in the session's poses.txt")
    return pose_from_tum(table.stack(TUM_POSE))


def _same_length(table: Table, n: int, what: str) -> None:
    if len(table) != n:
        raise InputError(f"{table.path}: {len(table)} rows, expected {n}: one for each of the {what}")


def _ints(table: Table, name: str) -> IntArray:
    values = table.columns[name]
    if (values != np.rint(values)).any():
        k = int((values != np.rint(values)).argmax())
        raise table.refuse(k, f"{name} is {values[k]!s}, expected a whole number")
    return values.astype(np.int64)


def _observations(path: Path, session: Session, run: RunRecord) -> tuple[IntArray, IntArray, Diagnostics]:
    table = read_table(path, ("timestamp", "flower_id", "cluster_id"), ("nis",), words=("reason",))
    m = len(session.observations)
    _same_length(table, m, "observations of the session")
    flowers = _ints(table, "flower_id")
    known = {reason.name.lower(): int(reason) for reason in RejectReason}
    default = np.where(flowers >= 0, int(RejectReason.ACCEPTED), int(RejectReason.UNCONFIRMED)).tolist()
    reasons = [known.get(word, d) for word, d in zip(table.words.get("reason", [""] * m), default, strict=True)]
    nis = table.columns.get("nis", np.full(m, np.nan))
    diagnostics = Diagnostics(nis, np.array(reasons, dtype=np.int64), run.estimated_noise)
    return flowers, _ints(table, "cluster_id"), diagnostics


def _columns(header: str) -> list[str]:
    return [name for name in header.split(",") if name not in ("state", *DESCRIPTOR)]


def _by_id(table: Table, name: str) -> Table:
    """The rows in the order of their ids, each of which stands there once."""
    ids = _ints(table, name)
    order = np.argsort(ids, kind="stable")
    again = np.flatnonzero(np.diff(ids[order]) == 0)
    if len(again):
        raise table.refuse(int(order[again[0] + 1]), f"{name} {ids[order[again[0]]]} again, expected each id once")
    columns = {column: values[order] for column, values in table.columns.items()}
    words = {column: [values[k] for k in order] for column, values in table.words.items()}
    return replace(table, columns=columns, rows=table.rows[order], words=words)


def _flowers(path: Path, clusters: Clusters) -> Flowers:
    table = _by_id(read_table(path, _columns(FLOWER_COLUMNS)), "flower_id")
    check_lengths(table, ("x", "y", "z"))
    cluster_ids = _ints(table, "cluster_id")
    strange = np.flatnonzero(~np.isin(cluster_ids, clusters.ids))
    if len(strange):
        k = int(strange[0])
        raise table.refuse(k, f"cluster_id is {cluster_ids[k]}, expected one of those in clusters.csv")
    return Flowers(
        ids=_ints(table, "flower_id"),
        cluster_ids=cluster_ids,
        positions=table.stack(("x", "y", "z")),
        covs=symmetric(table.stack(POINT_COV)),
        first_seen=table.columns["first_seen"],
        last_seen=table.columns["last_seen"],
        n_observations=_ints(table, "n_observations"),
    )


def _clusters(path: Path) -> Clusters:
    table = _by_id(read_table(path, _columns(CLUSTER_COLUMNS), DESCRIPTOR, words=("state",)), "cluster_id")
    check_lengths(table, ("x", "y", "z"))
    for name in DESCRIPTOR:
        if name not in table.columns:
            raise InputError(f"{path}: row 1: no column '{name}', expected {CLUSTER_COLUMNS}")
    states = table.words.get("state", ["confirmed"] * len(table))
    for k, state in enumerate(states):
        if state not in get_args(State):
            raise table.refuse(k, f"state is {shown(state)}, expected {', '.join(get_args(State))}")
    return Clusters(
        ids=_ints(table, "cluster_id"),
        positions=table.stack(("x", "y", "z")),
        covs=symmetric(table.stack(POINT_COV)),
        n_flowers=_ints(table, "n_flowers"),
        descriptors=table.stack(("inertia", "mean_distance")),
        descriptor_covs=table.stack(("cov_ii", "cov_id", "cov_dd"))[:, [[0, 1], [1, 2]]],
        first_seen=table.columns["first_seen"],
        last_seen=table.columns["last_seen"],
        n_observations=_ints(table, "n_observations"),
        states=cast("tuple[State, ...]", tuple(states)),
    )


def _drift(path: Path, session: Session) -> Drift:
    table = read_table(path, _columns(DRIFT_COLUMNS))
    return Drift(
        frame=frames_of(table, session.stamps),
        cluster_ids=_ints(table, "cluster_id"),
        positions=table.stack(("x", "y", "z")),
        covs=symmetric(table.stack(POINT_COV)),
    )


def read_calibration(path: str | Path) -> Calibration:
    """A hand-eye transform with its covariance, as ``smooth`` writes it.

    Raises
    ------
    InputError
        The file is missing, is no TOML, or a value is none.
    """
    found = _calibration(Path(path))
    if found is None:
        raise InputError(f"{path}: missing, expected a calibration.toml as smooth writes it")
    return found


def _calibration(path: Path) -> Calibration | None:
    if not path.exists():
        return None
    refusal = InputError(
        f"{path}: expected T_flange_camera (7 numbers, a unit quaternion) and covariance (6 rows of 6)"
    )
    try:
        content = tomllib.loads(read_text(path, "a calibration"))
        T = np.array(content["T_flange_camera"], dtype=np.float64).reshape(7)
        cov = np.array(content["covariance"], dtype=np.float64).reshape(6, 6)
        words = tuple(str(word) for word in content.get("unobserved", ()))
    except (tomllib.TOMLDecodeError, KeyError, ValueError, TypeError):
        raise refusal from None
    if not (np.isfinite(T).all() and np.isfinite(cov).all() and abs(np.linalg.norm(T[3:]) - 1) < NORM_TOLERANCE):
        raise refusal
    return Calibration(pose_from_tum(T), cov, words)
