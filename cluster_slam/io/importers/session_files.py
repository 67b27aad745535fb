"""The files of a session as text whose numbers read back bit by bit, and folders that appear when they are whole."""

from __future__ import annotations

import os
import secrets
import shutil
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from cluster_slam.errors import OutputError
from cluster_slam.geometry import Array
from cluster_slam.io.folder import check_writable
from cluster_slam.io.result import stamp_words
from cluster_slam.records import PoseError, PoseFrame
from cluster_slam.sensors.camera import Camera

DepthCamera = Literal["generic", "d405", "d435"]
COV_NAMES = ("cov_xx", "cov_xy", "cov_xz", "cov_yy", "cov_yz", "cov_zz")


@dataclass(frozen=True, slots=True, eq=False)
class SessionHead:
    """What ``session.toml`` says."""

    id: str
    plant: str | None = None
    pose_frame: PoseFrame = "T_world_camera"
    pose_error: PoseError = "absolute"
    T_flange_camera: Array | None = None  # (7,) tx ty tz qx qy qz qw
    hand_eye_sigmas: tuple[float, float] | None = None  # m, rad
    pose_sigmas: tuple[float, float] | None = None  # m, rad
    max_time_difference_s: float | None = None
    depth_scale: float | None = None  # m per unit of the images
    depth_camera: DepthCamera | None = None  # how its depths err
    source: str | None = None  # where it comes from, in words


def check_free(out: Path) -> None:
    """Refuse an output folder that holds anything: a recording is never replaced.

    Raises
    ------
    OutputError
        Names the folder and what stands in the way.
    """
    check_writable(out)
    if out.exists() and any(out.iterdir()):
        raise OutputError(f"{out}: holds {min(p.name for p in out.iterdir())}, expected a free name or an empty folder")


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A folder to fill, which takes the name ``out`` when the block ends, and is cleared away when it fails.

    Raises
    ------
    OutputError
        The disk is full, a permission is missing.
    """
    target = Path(os.path.realpath(out))
    new = target.parent / f".{target.name}.{os.getpid()}.{secrets.token_hex(4)}.new"
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        new.mkdir()
        yield new
        new.rename(target)
    except OSError as error:
        if isinstance(error, FileNotFoundError) and error.filename and not str(error.filename).startswith(str(new)):
            raise
        raise OutputError(f"{out}: cannot be written ({error.strerror}); what was there is untouched") from None
    finally:
        shutil.rmtree(new, ignore_errors=True)


def number(value: float) -> str:
    """The shortest decimal that reads back the same."""
    return repr(float(value))


def session_toml(head: SessionHead) -> str:
    """``session.toml``."""
    lines = [f"# {head.source}"] if head.source else []
    lines += ["format = 1", f"id = {_quoted(head.id)}"]
    lines += [f"plant = {_quoted(head.plant)}"] if head.plant is not None else []
    lines += ["", "[frames]", f'pose = "{head.pose_frame}"', f'pose_error = "{head.pose_error}"']
    if head.T_flange_camera is not None:
        lines.append(f"T_flange_camera = [{', '.join(number(x) for x in head.T_flange_camera)}]")
    if head.max_time_difference_s is not None:
        lines.append(f"max_time_difference = {number(head.max_time_difference_s)}")
    if head.depth_scale is not None:
        lines += ["", "[depth]", f"scale = {number(head.depth_scale)}", 'convention = "z"']
        lines += [f'camera = "{head.depth_camera}"'] if head.depth_camera is not None else []
    sigmas = {"pose": head.pose_sigmas, "hand_eye": head.hand_eye_sigmas}
    stated = {name: pair for name, pair in sigmas.items() if pair is not None}
    lines += ["", "[noise]"] if stated else []
    for name, (translation, rotation) in stated.items():
        lines += [f"{name}_translation = {number(translation)}", f"{name}_rotation = {number(rotation)}"]
    return text(lines)


def _quoted(word: str) -> str:
    """A TOML basic string."""
    plain = word.replace("\\", "\\\\").replace('"', '\\"')
    return '"' + "".join(c if c.isprintable() else f"\\U{ord(c):08x}" for c in plain) + '"'


def trajectory(stamps: Array, rows: Array) -> str:
    """A TUM trajectory of stamps (n,) and rows ``tx ty tz qx qy qz qw`` (n, 7)."""
    words = stamp_words(stamps)
    body = [" ".join([word, *map(number, row)]) for word, row in zip(words, rows.tolist(), strict=True)]
    return text(["# timestamp tx ty tz qx qy qz qw", *body])


def camera_yaml(camera: Camera, name: str = "camera") -> str:
    """``camera.yaml`` as ROS ``camera_calibration`` writes it."""
    k = [camera.fx, 0.0, camera.cx, 0.0, camera.fy, camera.cy, 0.0, 0.0, 1.0]
    is_rational = bool(np.any(camera.distortion[5:]))
    coefficients = camera.distortion.tolist() if is_rational else camera.distortion[:5].tolist()
    size = [("image_width", camera.width), ("image_height", camera.height)]
    return text(
        [
            *(f"{key}: {value}" for key, value in size if value is not None),
            f"camera_name: {name}",
            *_matrix("camera_matrix", 3, 3, k),
            f"distortion_model: {'rational_polynomial' if is_rational else 'plumb_bob'}",
            *_matrix("distortion_coefficients", 1, len(coefficients), coefficients),
        ]
    )


def _matrix(name: str, rows: int, cols: int, data: Sequence[float]) -> list[str]:
    return [f"{name}:", f"  rows: {rows}", f"  cols: {cols}", f"  data: [{', '.join(map(number, data))}]"]


def flowers_csv(stamps: Array, points: Array, *, covs: Array | None = None, scores: Array | None = None) -> str:
    """``flowers.csv`` of rows with stamps (m,), points (m, 3), and covariances (m, 3, 3) and scores (m,) if any."""
    names = ["timestamp", "x", "y", "z"]
    columns = [points]
    if scores is not None and np.isfinite(scores).any():
        names.append("score")
        columns.append(scores[:, None])
    if covs is not None:
        i, j = np.triu_indices(3)
        names += COV_NAMES
        columns.append(covs[:, i, j])
    values = np.concatenate(columns, axis=1).tolist() if len(points) else []
    words = stamp_words(stamps)
    body = [",".join([w, *("" if x != x else number(x) for x in row)]) for w, row in zip(words, values, strict=True)]
    return text([",".join(names), *body])


def image_list(stamps: Array, names: Sequence[str]) -> str:
    """``rgb.txt`` or ``depth.txt``: stamps (n,) and the files, relative to the session."""
    rows = [f"{word} {name}" for word, name in zip(stamp_words(stamps), names, strict=True)]
    return text(["# timestamp filename", *rows])


def text(lines: Iterable[str]) -> str:
    """Lines with an end each."""
    return "\n".join([*lines, ""])
