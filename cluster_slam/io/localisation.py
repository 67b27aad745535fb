"""A result folder of ``localise``, written whole or not at all."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

from cluster_slam.geometry import tum_from_pose
from cluster_slam.io.folder import write_folder
from cluster_slam.io.result import check_output, stamp_words
from cluster_slam.records import SessionLocalisation

_UPPER = np.triu_indices(6)
COLUMNS = "timestamp,state,reason,plant,n_inliers,probability," + ",".join(
    f"cov_{i}{j}" for i, j in zip(*_UPPER, strict=True)
)


def write_localisation(
    found: SessionLocalisation, out: Path, *, extra_files: Mapping[str, str | bytes] | None = None
) -> None:
    """Write a result folder of ``localise`` in place of an earlier result, whole or not at all.

    Raises
    ------
    OutputError
        The folder cannot be written or holds something else; what was there is untouched.
    """
    check_output(out)
    stamps = stamp_words(found.session.stamps)
    files: dict[str, str | bytes] = {
        "localisation.txt": _trajectory(stamps, found),
        "localisation.csv": _frames(stamps, found),
        "localisation_observations.csv": _observations(stamps, found),
        "hypotheses.csv": _hypotheses(stamps, found),
    }
    files |= dict(extra_files or {})
    files["run.json"] = json.dumps(run_record(found, [*files, "run.json"]), indent=2, allow_nan=False) + "\n"
    write_folder(out, files)


def run_record(found: SessionLocalisation, files: list[str]) -> dict[str, Any]:
    """What ``run.json`` says about the run, ready for JSON."""
    session = found.session
    lost = {reason: found.reasons.count(reason) for reason in ("ambiguous", "too_few", "no_match")}
    return {
        "version": version("cluster-slam"),
        "command": "localise",
        "session": session.id,
        "session_path": None if session.path is None else os.path.abspath(session.path),
        "level": session.level,
        "config": found.config,
        "seed": found.seed,
        "timings_s": {name: round(float(value), 4) for name, value in found.timings_s.items()},
        "counts": {"frames": session.n_frames, "located": int(found.is_located.sum()), **lost},
        "estimated_noise": {k: float(v) for k, v in found.estimated_noise.items() if np.isfinite(v)},
        "warnings": list(found.warnings),
        "merged": [],
        "status": found.status,
        "files": sorted(files),
    }


def _trajectory(stamps: list[str], found: SessionLocalisation) -> str:
    if not found.is_located.any():
        return ""  # readers of TUM files stumble over one with comments only
    lines = ["# timestamp tx ty tz qx qy qz qw (T_map_camera, located frames only)"]
    for i in np.flatnonzero(found.is_located).tolist():
        row = tum_from_pose(found.T_map_camera[i])
        lines.append(" ".join([stamps[i], *(f"{x:.9f}" for x in row[:3]), *(f"{x:.12f}" for x in row[3:])]))
    return "\n".join([*lines, ""])


def _frames(stamps: list[str], found: SessionLocalisation) -> str:
    lines = [COLUMNS]
    located = found.is_located.tolist()
    for i, stamp in enumerate(stamps):
        cov = [f"{x:.12g}" for x in found.covs[i][_UPPER].tolist()] if located[i] else [""] * 21
        state = "located" if located[i] else "lost"
        head = [stamp, state, found.reasons[i], _cell(found.plants[i]), str(int(found.n_inliers[i]))]
        lines.append(",".join([*head, f"{found.probability[i]:.9f}", *cov]))
    return "\n".join([*lines, ""])


def _cell(text: str) -> str:
    return '"' + text.replace('"', '""') + '"' if any(c in text for c in ',"\n') else text


def _observations(stamps: list[str], found: SessionLocalisation) -> str:
    frames = found.session.observations.frame.tolist()
    ids = zip(frames, found.flower_ids.tolist(), found.cluster_ids.tolist(), strict=True)
    return "\n".join(["timestamp,flower_map_id,cluster_map_id", *(f"{stamps[i]},{f},{c}" for i, f, c in ids), ""])


def _hypotheses(stamps: list[str], found: SessionLocalisation) -> str:
    h = found.hypotheses
    lines = ["timestamp,rank,probability,tx,ty,tz,qx,qy,qz,qw"]
    rows = tum_from_pose(h.T_map_camera) if len(h.frame) else np.zeros((0, 7))
    for i, rank, p, row in zip(h.frame.tolist(), h.rank.tolist(), h.probability.tolist(), rows.tolist(), strict=True):
        place = [f"{x:.9f}" for x in row[:3]] + [f"{x:.12f}" for x in row[3:]]
        lines.append(",".join([stamps[i], str(rank), f"{p:.9g}", *place]))
    return "\n".join([*lines, ""])
