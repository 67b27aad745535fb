"""A result folder, written whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from cluster_slam.errors import EstimationError, OutputError
from cluster_slam.geometry import Array, tum_from_pose
from cluster_slam.io.folder import check_writable, recover, write_folder
from cluster_slam.records import Calibration, Clusters, Drift, Flowers, RejectReason, Result

COV = "cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
CLUSTER_COLUMNS = (
    f"cluster_id,x,y,z,{COV},n_flowers,inertia,mean_distance,cov_ii,cov_id,cov_dd"
    ",first_seen,last_seen,n_observations,state"
)
FLOWER_COLUMNS = f"flower_id,cluster_id,x,y,z,{COV},first_seen,last_seen,n_observations"
DRIFT_COLUMNS = f"timestamp,cluster_id,x,y,z,{COV}"
OBSERVATION_COLUMNS = "timestamp,flower_id,cluster_id,reason,nis"
RESULT_FILES = frozenset(
    {
        "trajectory.txt",
        "observations.csv",
        "clusters.csv",
        "flowers.csv",
        "drift.csv",
        "calibration.toml",
        "identities.csv",
        "flower_identities.csv",
        "localisation.txt",
        "localisation.csv",
        "localisation_observations.csv",
        "hypotheses.csv",
        "matches.csv",
        "run.json",
        "metrics.json",
        "report.html",
    }
)
_POINT = "%.9f,%.9f,%.9f"
_COV = ",".join(["%.12g"] * 6)


def check_output(out: Path) -> None:
    """Refuse an output folder that cannot be written or holds anything but an earlier result.

    Raises
    ------
    OutputError
        Names the folder and what stands in the way; nothing on disk has been changed.
    """
    check_writable(out)
    recover(out)
    if not out.exists():
        return
    names = sorted(entry.name for entry in out.iterdir())
    if not names:
        return
    expected = "expected a free name, an empty folder or an earlier result"
    if "run.json" not in names:
        raise OutputError(f"{out}: holds {names[0]} but no run.json, {expected}")
    foreign = [name for name in names if name not in RESULT_FILES | _written_before(out / "run.json", expected)]
    if foreign:
        raise OutputError(f"{out}: holds {foreign[0]}, which is no part of a result, {expected}")


def _written_before(run: Path, expected: str) -> frozenset[str]:
    """The names that an earlier result says it wrote."""
    try:
        content = json.loads(run.read_text("utf-8"))
    except (OSError, ValueError):
        raise OutputError(f"{run}: cannot be read as a result's, {expected}") from None
    if not (isinstance(content, dict) and {"version", "command", "status"} <= content.keys()):
        raise OutputError(f"{run}: is no result's (no version, command and status), {expected}")
    files = content.get("files", [])
    return frozenset(name for name in files if isinstance(name, str)) if isinstance(files, list) else frozenset()


def write_result(result: Result, out: Path, *, extra_files: Mapping[str, str | bytes] | None = None) -> None:
    """Write a result folder in place of an earlier one, whole or not at all.

    Parameters
    ----------
    result
        What was found.
    out
        Absent, empty or an earlier result.
    extra_files
        Further files by name: ``metrics.json``, ``report.html``.

    Raises
    ------
    OutputError
        The folder cannot be written or holds something else; what was there is untouched.
    EstimationError
        The result is not finite; nothing has been written.
    """
    check_output(out)
    _check_finite(result)
    stamps = stamp_words(result.session.stamps)
    files: dict[str, str | bytes] = {
        "trajectory.txt": _trajectory(stamps, result.T_world_camera),
        "observations.csv": _observations(stamps, result),
        "clusters.csv": _clusters(result.clusters),
        "flowers.csv": _flowers(result.flowers),
        "drift.csv": _drift(stamps, result.drift),
    }
    if result.calibration is not None:
        files["calibration.toml"] = _calibration(result.calibration)
    files |= dict(extra_files or {})
    files["run.json"] = json.dumps(run_record(result, [*files, "run.json"]), indent=2, allow_nan=False) + "\n"
    write_folder(out, files)


def _check_finite(result: Result) -> None:
    parts = {
        "camera pose": result.T_world_camera,
        "flower position": result.flowers.positions,
        "flower covariance": result.flowers.covs,
        "cluster position": result.clusters.positions,
        "cluster covariance": result.clusters.covs,
        "drift position": result.drift.positions,
        "drift covariance": result.drift.covs,
    }
    for name, values in parts.items():
        if not np.isfinite(values).all():
            k = int((~np.isfinite(values.reshape(len(values), -1)).all(axis=1)).argmax())
            raise EstimationError(f"{name} {k} is not finite: the data do not determine it; nothing has been written")


def run_record(result: Result, files: list[str]) -> dict[str, Any]:
    """What ``run.json`` says about the run, ready for JSON."""
    return {
        "version": version("cluster-slam"),
        "command": result.command,
        "session": result.session.id,
        "session_path": None if result.session.path is None else os.path.abspath(result.session.path),
        "level": result.session.level,
        "config": result.config,
        "seed": result.seed,
        "timings_s": {name: round(float(value), 4) for name, value in result.timings_s.items()},
        "counts": {name: int(value) for name, value in result.counts.items()},
        "estimated_noise": {k: float(v) for k, v in result.diagnostics.estimated_noise.items() if np.isfinite(v)},
        "warnings": list(result.warnings),
        "merged": [[int(a), int(b)] for a, b in result.merged],
        "status": result.status,
        "files": sorted(files),
    }


def stamp_words(stamps: Array) -> list[str]:
    """Stamps as text, six decimals or as many more as it takes to read back the same number."""
    short = [f"{t:.6f}" for t in stamps.tolist()]
    same = [float(s) == t for s, t in zip(short, stamps.tolist(), strict=True)]
    return [s if ok else np.format_float_positional(t) for s, ok, t in zip(short, same, stamps, strict=True)]


def _table(header: str, pattern: str, *columns: list[Any]) -> str:
    return "\n".join([header, *map(pattern.__mod__, zip(*columns, strict=True)), ""])


def _spread(values: Array) -> list[list[float]]:
    """The columns of an array (n, k)."""
    return [column.tolist() for column in values.T]


def _point(positions: Array, covs: Array) -> list[list[float]]:
    i, j = np.triu_indices(3)
    return _spread(np.concatenate([positions, covs[:, i, j]], axis=1))


def _trajectory(stamps: list[str], T_world_camera: Array) -> str:
    pattern = "%s " + " ".join(["%.9f"] * 3 + ["%.12f"] * 4)
    return _table("# timestamp tx ty tz qx qy qz qw", pattern, stamps, *_spread(tum_from_pose(T_world_camera)))


def _observations(stamps: list[str], result: Result) -> str:
    words = {int(reason): reason.name.lower() for reason in RejectReason}
    when = [stamps[i] for i in result.session.observations.frame.tolist()]
    why = [words[reason] for reason in result.diagnostics.reasons.tolist()]
    nis = ["" if x != x else f"{x:.5g}" for x in result.diagnostics.nis.tolist()]
    ids = (result.flower_ids.tolist(), result.cluster_ids.tolist())
    return _table(OBSERVATION_COLUMNS, "%s,%d,%d,%s,%s", when, *ids, why, nis)


def _clusters(clusters: Clusters) -> str:
    i, j = np.triu_indices(2)
    return _table(
        CLUSTER_COLUMNS,
        f"%d,{_POINT},{_COV},%d,%.12g,%.12g,%.12g,%.12g,%.12g,%s,%s,%d,%s",
        clusters.ids.tolist(),
        *_point(clusters.positions, clusters.covs),
        clusters.n_flowers.tolist(),
        *_spread(clusters.descriptors),
        *_spread(clusters.descriptor_covs[:, i, j]),
        stamp_words(clusters.first_seen),
        stamp_words(clusters.last_seen),
        clusters.n_observations.tolist(),
        list(clusters.states),
    )


def _flowers(flowers: Flowers) -> str:
    return _table(
        FLOWER_COLUMNS,
        f"%d,%d,{_POINT},{_COV},%s,%s,%d",
        flowers.ids.tolist(),
        flowers.cluster_ids.tolist(),
        *_point(flowers.positions, flowers.covs),
        stamp_words(flowers.first_seen),
        stamp_words(flowers.last_seen),
        flowers.n_observations.tolist(),
    )


def _drift(stamps: list[str], drift: Drift) -> str:
    when = [stamps[i] for i in drift.frame.tolist()]
    columns = (drift.cluster_ids.tolist(), *_point(drift.positions, drift.covs))
    return _table(DRIFT_COLUMNS, f"%s,%d,{_POINT},{_COV}", when, *columns)


def _calibration(calibration: Calibration) -> str:
    T = ", ".join(f"{x:.12g}" for x in tum_from_pose(calibration.T_flange_camera).tolist())
    rows = [f"  [{', '.join(f'{x:.12g}' for x in row)}]," for row in calibration.cov.tolist()]
    unobserved = ", ".join(json.dumps(words) for words in calibration.unobserved)
    return "\n".join(
        [
            "# tx ty tz qx qy qz qw; the covariance is of [rx ry rz tx ty tz], applied on the right",
            f"T_flange_camera = [{T}]",
            "covariance = [",
            *rows,
            "]",
            "# directions that the session could not show; they stay at the prior",
            f"unobserved = [{unobserved}]",
            "",
        ]
    )
