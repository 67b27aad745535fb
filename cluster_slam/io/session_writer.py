"""A session folder, written whole or not at all."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cluster_slam.errors import OutputError
from cluster_slam.geometry import Array, tum_from_pose
from cluster_slam.io.folder import check_writable, recover, write_folder
from cluster_slam.io.result import stamp_words
from cluster_slam.records import IntArray, Session, Truth
from cluster_slam.sensors.camera import Camera

SESSION_FILES = frozenset(
    {"session.toml", "poses.txt", "flowers.csv", "detections.csv", "camera.yaml", "truth"}
    | {"rgb.txt", "depth.txt", "rgb", "depth"}
)
TRUTH_FILES = frozenset({"poses.txt", "observations.csv", "flowers.csv", "rest.csv", "boxes.csv"})
_TUM = "# timestamp tx ty tz qx qy qz qw"
_COV_NAMES = "cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
_UPPER = np.triu_indices(3)


@dataclass(frozen=True, slots=True, eq=False)
class Moments:
    """True positions of all flowers at chosen frames, for ``truth/flowers.csv``."""

    frame: IntArray  # (k,)
    positions: Array  # (k, f, 3) world, in the order of ``Truth.rest_flower_ids``


def check_session_output(out: Path) -> None:
    """Refuse an output folder that cannot be written or holds anything but an earlier session.

    Raises
    ------
    OutputError
        Names the folder and what stands in the way; nothing on disk has been changed.
    """
    check_writable(out)
    recover(out)
    names = sorted(entry.name for entry in out.iterdir()) if out.exists() else []
    if not names:
        return
    expected = "expected a free name, an empty folder or an earlier session"
    truth = out / "truth"
    inside = sorted(entry.name for entry in truth.iterdir()) if truth.is_dir() else []
    foreign = [name for name in names if name not in SESSION_FILES]
    foreign += [f"truth/{name}" for name in inside if name not in TRUTH_FILES]
    if foreign:
        raise OutputError(f"{out}: holds {foreign[0]}, which no written session has, {expected}")
    if "session.toml" not in names:
        raise OutputError(f"{out}: holds {names[0]} but no session.toml, {expected}")


def write_session(
    out: Path,
    session: Session,
    truth: Truth | None = None,
    *,
    camera: Camera | None = None,
    moments: Moments | None = None,
) -> None:
    """Write a session, and what truth there is, in place of an earlier one, whole or not at all.

    Parameters
    ----------
    out
        Absent, empty or an earlier session.
    session
        Level 3 is written as ``flowers.csv``; level 2 as ``detections.csv`` (depths along z), which needs ``camera``.
    truth, moments
        What is known; ``moments`` only where ``truth`` has the flowers at rest.

    Raises
    ------
    OutputError
        The folder cannot be written or holds something else; what was there is untouched.
    """
    check_session_output(out)
    write_folder(out, session_files(session, truth, camera=camera, moments=moments))


def session_files(
    session: Session, truth: Truth | None = None, *, camera: Camera | None = None, moments: Moments | None = None
) -> dict[str, str | bytes]:
    """The files of a session by name; at level 1 all but the pictures and their lists.

    Raises
    ------
    OutputError
        The session needs a camera to be written.
    """
    stamps = stamp_words(session.stamps)
    files: dict[str, str | bytes] = {
        "session.toml": _metadata(session, truth),
        "poses.txt": _trajectory(stamps, session.poses),
    }
    if session.level < 3:
        if camera is None:
            raise OutputError(f"{session.id}: a session of level {session.level} needs its camera to be written")
        files["camera.yaml"] = _camera_info(camera)
    if session.level == 2 and camera is not None:
        files["detections.csv"] = _detections(stamps, session, camera)
    elif session.level == 3:
        files["flowers.csv"] = _flowers(stamps, session)
    if truth is not None:
        files |= {f"truth/{name}": text for name, text in _truth(stamps, truth, moments).items()}
    return files


def observed_table(session: Session) -> str:
    """A session's observations as ``flowers.csv`` has them."""
    return _flowers(stamp_words(session.stamps), session)


def _metadata(session: Session, truth: Truth | None) -> str:
    lines = ["format = 1", f"id = {_quoted(session.id)}"]
    if session.plant is not None:
        lines.append(f"plant = {_quoted(session.plant)}")
    lines += ["", "[frames]", f'pose = "{session.pose_frame}"', f'pose_error = "{session.pose_error}"']
    if session.T_flange_camera is not None:
        lines.append(f"T_flange_camera = {_seven(session.T_flange_camera)}")
    lines += ["", "[depth]", 'convention = "z"'] if session.level < 3 else []
    lines += ["", "[noise]", *(f"{name} = {float(value)!r}" for name, value in asdict(session.noise).items())]
    if truth is not None and truth.T_map_world is not None:
        lines += ["", "[truth]", f"T_map_world = {_seven(truth.T_map_world)}"]
    return _text(lines)


def _quoted(text: str) -> str:
    """A TOML basic string."""
    plain = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in plain) + '"'


def _seven(T: Array) -> str:
    return "[" + ", ".join(repr(float(x)) for x in tum_from_pose(T)) + "]"


def _camera_info(camera: Camera) -> str:
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    p = [camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    is_rational = bool(np.any(camera.distortion[5:]))
    coefficients = camera.distortion.tolist() if is_rational else camera.distortion[:5].tolist()
    lines = [f"image_width: {camera.width}"] if camera.width is not None else []
    lines += [f"image_height: {camera.height}"] if camera.height is not None else []
    return _text(
        [
            *lines,
            "camera_name: camera",
            *_matrix("camera_matrix", 3, 3, k),
            f"distortion_model: {'rational_polynomial' if is_rational else 'plumb_bob'}",
            *_matrix("distortion_coefficients", 1, len(coefficients), coefficients),
            *_matrix("rectification_matrix", 3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
            *_matrix("projection_matrix", 3, 4, p),
        ]
    )


def _matrix(name: str, rows: int, cols: int, data: list[float]) -> list[str]:
    numbers = ", ".join(repr(float(x)) for x in data)
    return [f"{name}:", f"  rows: {rows}", f"  cols: {cols}", f"  data: [{numbers}]"]


def _trajectory(stamps: list[str], poses: Array) -> str:
    """Positions to 1e-10 m, quaternions to 1e-12: reading gives the same motions within 1e-9."""
    return _table(_TUM, "%s %.10f %.10f %.10f %.12f %.12f %.12f %.12f", stamps, tum_from_pose(poses))


def _flowers(stamps: list[str], session: Session) -> str:
    seen = session.observations
    covs = seen.covs[:, _UPPER[0], _UPPER[1]]
    return _observations(
        stamps, session, "x,y,z", "%.10f,%.10f,%.10f", seen.points, covs if seen.has_covariance else None
    )


def _detections(stamps: list[str], session: Session, camera: Camera) -> str:
    """Pixels and depths whose lifted points are the session's."""
    points = session.observations.points
    values = np.column_stack([camera.project(points), points[:, 2]])
    return _observations(stamps, session, "u,v,depth", "%.8f,%.8f,%.10f", values, None)


def _observations(
    stamps: list[str], session: Session, names: str, pattern: str, values: Array, covs: Array | None
) -> str:
    seen = session.observations
    columns: list[Any] = [values]
    if np.isfinite(seen.scores).any():
        names, pattern = f"{names},score", f"{pattern},%.6f"
        columns.append(seen.scores[:, None])
    if covs is not None:
        names, pattern = f"{names},{_COV_NAMES}", pattern + ",%.9e" * 6
        columns.append(covs)
    when = [stamps[i] for i in seen.frame.tolist()]
    return _table(f"timestamp,{names}", f"%s,{pattern}", when, np.concatenate(columns, axis=1)).replace(",nan", ",")


def _truth(stamps: list[str], truth: Truth, moments: Moments | None) -> dict[str, str]:
    """Content of the files of ``truth/`` by name."""
    files = {}
    if truth.T_world_camera is not None:
        files["poses.txt"] = _trajectory(stamps, truth.T_world_camera)
    if truth.flower_ids is not None and truth.cluster_ids is not None:
        files["observations.csv"] = _text(["flower_id,cluster_id", *_pairs(truth.flower_ids, truth.cluster_ids)])
    if truth.rest_positions is None or truth.rest_flower_ids is None or truth.rest_cluster_ids is None:
        return files
    ids = _pairs(truth.rest_flower_ids, truth.rest_cluster_ids)
    files["rest.csv"] = _table("flower_id,cluster_id,x,y,z", "%s,%.10f,%.10f,%.10f", ids, truth.rest_positions)
    if moments is not None:
        when = [f"{stamps[i]},{pair}" for i in moments.frame.tolist() for pair in ids]
        positions = moments.positions.reshape(-1, 3)
        files["flowers.csv"] = _table("timestamp,flower_id,cluster_id,x,y,z", "%s,%.10f,%.10f,%.10f", when, positions)
    return files


def _pairs(a: IntArray, b: IntArray) -> list[str]:
    return [f"{x},{y}" for x, y in zip(a.tolist(), b.tolist(), strict=True)]


def _table(header: str, pattern: str, first: list[str], values: Array) -> str:
    """Rows of a word and numbers (n, k)."""
    return _text([header, *map(pattern.__mod__, zip(first, *values.T.tolist(), strict=True))])


def _text(lines: Iterable[str]) -> str:
    return "\n".join([*lines, ""])
