"""Write a session folder: whole or not at all."""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np

from cluster_slam.errors import OutputError
from cluster_slam.geometry import Array, tum_from_pose
from cluster_slam.records import IntArray, Session, Truth

_COV_NAMES = "cov_xx,cov_xy,cov_xz,cov_yy,cov_yz,cov_zz"
_UPPER = np.triu_indices(3)


@dataclass(frozen=True, slots=True)
class Intrinsics:
    """A pinhole camera without distortion; pixel centres at whole numbers."""

    fx: float  # px
    fy: float  # px
    cx: float  # px
    cy: float  # px
    width: int
    height: int

    def project(self, points: Array) -> Array:
        """u, v (px) and depth (m) (..., 3) of points (..., 3) in the camera frame."""
        x, y, z = points[..., 0], points[..., 1], points[..., 2]
        return np.stack([self.fx * x / z + self.cx, self.fy * y / z + self.cy, z], axis=-1)

    def lift(self, pixels: Array) -> Array:
        """Points (..., 3) in the camera frame of u, v (px) and depth along the optical axis (m) (..., 3)."""
        u, v, z = pixels[..., 0], pixels[..., 1], pixels[..., 2]
        return np.stack([(u - self.cx) / self.fx * z, (v - self.cy) / self.fy * z, z], axis=-1)

    def point_covs(self, pixels: Array, sigma_px: float, sigma_depth: float) -> Array:
        """Covariances (m, 3, 3) of lifted points, to first order; sigma of the depth = sigma_depth * z^2."""
        z = pixels[:, 2]
        J = np.zeros((len(z), 3, 3))
        J[:, 0, 0], J[:, 1, 1] = z / self.fx, z / self.fy
        J[:, :, 2] = self.lift(np.column_stack([pixels[:, :2], np.ones(len(z))]))
        sigma = np.stack([np.full(len(z), sigma_px), np.full(len(z), sigma_px), sigma_depth * z**2], axis=1)
        half = J * sigma[:, None, :]
        covs: Array = half @ np.swapaxes(half, 1, 2)
        return covs


def write_session(
    out: Path,
    session: Session,
    truth: Truth | None = None,
    *,
    intrinsics: Intrinsics | None = None,
    timed_frames: IntArray | None = None,
    timed_positions: Array | None = None,
) -> None:
    """Write a session, and what truth there is, as the folder ``out``.

    Parameters
    ----------
    session
        With ``level = 2`` the observations are written as pixels and depths, which needs ``intrinsics``.
    timed_frames, timed_positions
        Frames (k,) and true flower positions (k, f, 3) in the world for ``truth/flowers.csv``, in the order of
        ``truth.rest_flower_ids``.

    Raises
    ------
    OutputError
        ``out`` holds anything but an earlier session, or cannot be written; what was there is unchanged.
    """
    out = Path(out)
    _refuse(out)
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        new = Path(tempfile.mkdtemp(prefix=f".{out.name}-", dir=out.parent))
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}") from error
    try:
        new.chmod(0o755)
        _write_input(new, session, truth, intrinsics)
        if truth is not None:
            _write_truth(new / "truth", session, truth, timed_frames, timed_positions)
        _replace(new, out)
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror}") from error
    finally:
        shutil.rmtree(new, ignore_errors=True)


def _refuse(out: Path) -> None:
    """Only nothing, an empty folder or an earlier session is overwritten."""
    if not out.exists():
        return
    if not out.is_dir():
        raise OutputError(f"{out} is a file: name a new or empty folder, or an earlier session")
    if any(out.iterdir()) and not (out / "session.toml").is_file():
        raise OutputError(f"{out} holds something that is no session: name a new or empty folder")


def _replace(new: Path, out: Path) -> None:
    """Put the new folder in the place of the old; a rename of a folder needs the old one out of the way."""
    if not out.exists():
        os.rename(new, out)
        return
    old = Path(tempfile.mkdtemp(prefix=f".{out.name}-old-", dir=out.parent))
    os.rename(out, old / "session")
    os.rename(new, out)
    shutil.rmtree(old)


def _write_input(folder: Path, session: Session, truth: Truth | None, intrinsics: Intrinsics | None) -> None:
    (folder / "session.toml").write_text(_metadata(session, truth))
    stamps = _stamps(session.stamps)
    _write_tum(folder / "poses.txt", stamps, session.poses)
    if session.level == 2:
        if intrinsics is None:
            raise OutputError("a session of level 2 needs the camera's intrinsics")
        (folder / "camera.yaml").write_text(_camera_info(intrinsics))
        _write_detections(folder / "detections.csv", stamps, session, intrinsics)
    else:
        _write_flowers(folder / "flowers.csv", stamps, session)


def _metadata(session: Session, truth: Truth | None) -> str:
    lines = ["format = 1", f"id = {_toml(session.id)}"]
    if session.plant is not None:
        lines.append(f"plant = {_toml(session.plant)}")
    lines += ["[frames]", f'pose = "{session.pose_frame}"', f'pose_error = "{session.pose_error}"']
    if session.T_flange_camera is not None:
        lines.append(f"T_flange_camera = {_seven(session.T_flange_camera)}")
    if session.level == 2:
        lines += ["[depth]", 'convention = "z"']
    lines.append("[noise]")
    lines += [f"{name} = {float(value)!r}" for name, value in asdict(session.noise).items()]
    if truth is not None and truth.T_map_world is not None:
        lines += ["[truth]", f"T_map_world = {_seven(truth.T_map_world)}"]
    return "\n".join(lines) + "\n"


def _toml(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\u{ord(c):04x}" for c in escaped) + '"'


def _seven(T: Array) -> str:
    return "[" + ", ".join(repr(float(x)) for x in tum_from_pose(T)) + "]"


def _camera_info(camera: Intrinsics) -> str:
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    p = [camera.fx, 0.0, camera.cx, 0.0, 0.0, camera.fy, camera.cy, 0.0, 0.0, 0.0, 1.0, 0.0]
    return "\n".join(
        [
            f"image_width: {camera.width}",
            f"image_height: {camera.height}",
            "camera_name: camera",
            _matrix("camera_matrix", 3, 3, k),
            "distortion_model: plumb_bob",
            _matrix("distortion_coefficients", 1, 5, [0.0] * 5),
            _matrix("rectification_matrix", 3, 3, [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0]),
            _matrix("projection_matrix", 3, 4, p),
            "",
        ]
    )


def _matrix(name: str, rows: int, cols: int, data: list[float]) -> str:
    return f"{name}:\n  rows: {rows}\n  cols: {cols}\n  data: [{', '.join(repr(float(x)) for x in data)}]"


def _stamps(stamps: Array) -> list[str]:
    return [f"{t:.6f}" for t in stamps]


def _write_tum(path: Path, stamps: list[str], poses: Array) -> None:
    """Positions to 1e-10 m and quaternions to 1e-12: reading gives the same motions to 1e-9."""
    line = "%s %.10f %.10f %.10f %.12f %.12f %.12f %.12f\n"
    rows = tum_from_pose(poses).tolist()
    _write_lines(
        path, "# timestamp tx ty tz qx qy qz qw\n", (line % (t, *r) for t, r in zip(stamps, rows, strict=True))
    )


def _write_flowers(path: Path, stamps: list[str], session: Session) -> None:
    seen = session.observations
    names, formats, columns = "timestamp,x,y,z", ["%.10f"] * 3, [seen.points]
    if np.isfinite(seen.scores).any():
        names, formats, columns = names + ",score", [*formats, "%.6f"], [*columns, seen.scores[:, None]]
    if seen.has_covariance:
        names, formats = f"{names},{_COV_NAMES}", formats + ["%.11e"] * 6
        columns = [*columns, seen.covs[:, _UPPER[0], _UPPER[1]]]
    _write_table(path, names, formats, stamps, seen.frame, np.concatenate(columns, axis=1))


def _write_detections(path: Path, stamps: list[str], session: Session, intrinsics: Intrinsics) -> None:
    seen = session.observations
    names, formats, columns = "timestamp,u,v,depth", ["%.8f", "%.8f", "%.10f"], [intrinsics.project(seen.points)]
    if np.isfinite(seen.scores).any():
        names, formats, columns = names + ",score", [*formats, "%.6f"], [*columns, seen.scores[:, None]]
    _write_table(path, names, formats, stamps, seen.frame, np.concatenate(columns, axis=1))


def _write_table(path: Path, names: str, formats: list[str], stamps: list[str], frame: IntArray, values: Array) -> None:
    line = "%s," + ",".join(formats) + "\n"
    lines = (line % (stamps[i], *row) for i, row in zip(frame.tolist(), values.tolist(), strict=True))
    _write_lines(path, names + "\n", lines)


def _write_truth(
    folder: Path, session: Session, truth: Truth, timed_frames: IntArray | None, timed_positions: Array | None
) -> None:
    folder.mkdir()
    if truth.T_world_camera is not None:
        _write_tum(folder / "poses.txt", _stamps(session.stamps), truth.T_world_camera)
    if truth.flower_ids is not None and truth.cluster_ids is not None:
        pairs = zip(truth.flower_ids.tolist(), truth.cluster_ids.tolist(), strict=True)
        _write_lines(folder / "observations.csv", "flower_id,cluster_id\n", (f"{f},{c}\n" for f, c in pairs))
    if truth.rest_positions is None or truth.rest_flower_ids is None or truth.rest_cluster_ids is None:
        return
    ids = [f"{f},{c}" for f, c in zip(truth.rest_flower_ids.tolist(), truth.rest_cluster_ids.tolist(), strict=True)]
    rows = (
        f"{i},{x:.10f},{y:.10f},{z:.10f}\n" for i, (x, y, z) in zip(ids, truth.rest_positions.tolist(), strict=True)
    )
    _write_lines(folder / "rest.csv", "flower_id,cluster_id,x,y,z\n", rows)
    if timed_frames is not None and timed_positions is not None:
        moments = zip(_stamps(session.stamps[timed_frames]), timed_positions.tolist(), strict=True)
        timed = (
            f"{t},{i},{x:.10f},{y:.10f},{z:.10f}\n"
            for t, points in moments
            for i, (x, y, z) in zip(ids, points, strict=True)
        )
        _write_lines(folder / "flowers.csv", "timestamp,flower_id,cluster_id,x,y,z\n", timed)


def _write_lines(path: Path, header: str, lines: Iterable[str]) -> None:
    with path.open("w", encoding="utf-8", newline="\n") as file:
        file.write(header)
        file.writelines(lines)
