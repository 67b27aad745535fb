"""Calibration from pictures of a ChArUco board or of AprilTags that stand still."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from cluster_slam.errors import ConfigError, InputError
from cluster_slam.geometry import Array, pose_from_tum, skew, so3_exp, transform
from cluster_slam.io.camera_info import read_camera
from cluster_slam.io.images import read_colour, read_image_list
from cluster_slam.io.metadata import read_metadata
from cluster_slam.io.session import stated_noise
from cluster_slam.io.tables import TUM_POSE, read_tum
from cluster_slam.pipeline.calibrate import calibrate_by_board
from cluster_slam.pipeline.calibrate_report import CalibrationReport
from cluster_slam.records import IntArray, Observations, Session
from cluster_slam.sensors.camera import Camera

Progress = Callable[[str, float], None]
_MIN_CORNERS = 4


@dataclass(frozen=True, slots=True)
class BoardSpec:
    """A board as the command line names it."""

    kind: str  # charuco or apriltag
    columns: int
    rows: int
    square_m: float
    marker_m: float
    dictionary: str  # OpenCV's name without DICT_


def parse_board(text: str) -> BoardSpec:
    """``charuco:7x5:0.04:0.03:4X4_50`` or ``apriltag:36h11:0.08``.

    Raises
    ------
    ConfigError
        Neither of the two.
    """
    kind, *rest = text.split(":")
    try:
        if kind == "charuco" and len(rest) == 4:
            columns, rows = (int(n) for n in rest[0].lower().split("x"))
            spec = BoardSpec(kind, columns, rows, float(rest[1]), float(rest[2]), rest[3])
        elif kind == "apriltag" and len(rest) == 2:
            spec = BoardSpec(
                kind, 1, 1, float(rest[1]), float(rest[1]), f"APRILTAG_{rest[0].upper().replace('H', 'h')}"
            )
        else:
            raise ValueError
        if not (0 < spec.marker_m <= spec.square_m and min(spec.columns, spec.rows) >= 1):
            raise ValueError
        _dictionary(spec)
    except (ValueError, AttributeError):
        raise ConfigError(
            f"--board {text!r}, expected charuco:COLUMNSxROWS:SQUARE_M:MARKER_M:DICTIONARY (4X4_50, 5X5_100, ...) "
            "or apriltag:FAMILY:SIDE_M (36h11, 25h9, 16h5)"
        ) from None
    return spec


def _dictionary(spec: BoardSpec) -> Any:
    from cv2 import aruco

    return aruco.getPredefinedDictionary(getattr(aruco, f"DICT_{spec.dictionary}"))


def calibrate_pictures(
    path: Path, board: str, *, time_offset: bool = False, depth_scale: bool = False, progress: Progress | None = None
) -> CalibrationReport:
    """The hand-eye transform from the pictures of a session folder (``rgb.txt``, ``camera.yaml``, ``poses.txt``).

    Raises
    ------
    InputError
        A file is missing or wrong, or the board was seen too rarely or from one side only.
    ConfigError
        The board is none that is known.
    """
    say = progress or (lambda _stage, _fraction: None)
    spec = parse_board(board)
    session, camera, names = _pictures(path)
    finder = _finder(spec)
    seen: list[tuple[int, IntArray, Array, Array]] = []
    poses = np.full((session.n_frames, 4, 4), np.nan)
    for i, name in names:
        say("looking for the board", i / session.n_frames)
        image = read_colour(name)
        for label, corners, pixels in [] if image is None else finder(image):
            T = _board_pose(camera, corners, pixels)
            if T is None:
                continue
            if spec.kind == "charuco" or not np.isfinite(poses[i]).all():
                poses[i] = T
            var = np.full(len(label), _variance(camera, T, corners, session))
            seen.append((i, label, transform(T, corners), var))
    if not seen:
        raise InputError(f"{path / 'rgb.txt'}: the board {board} was found in none of {len(names)} pictures")
    frame = np.concatenate([np.full(len(label), i) for i, label, _, _ in seen])
    _, label = np.unique(np.concatenate([s[1] for s in seen]), return_inverse=True)
    points = np.concatenate([s[2] for s in seen])
    variances = np.concatenate([s[3] for s in seen])
    return calibrate_by_board(
        session,
        frame,
        label.astype(np.int64),
        points,
        variances,
        poses,
        time_offset=time_offset,
        depth_scale=depth_scale,
    )


def _pictures(path: Path) -> tuple[Session, Camera, list[tuple[int, Path]]]:
    """The session's poses, its camera, and the picture nearest to each frame, where one is near enough."""
    metadata, warnings = read_metadata(path / "session.toml")
    table = read_tum(path / "poses.txt", "a TUM trajectory with one row a frame")
    stamps = table.columns["timestamp"]
    images = read_image_list(path / "rgb.txt")
    nearest = np.abs(images.stamps[:, None] - stamps).argmin(0) if len(stamps) else np.zeros(0, np.int64)
    limit = metadata.frames.max_time_difference + np.spacing(np.abs(stamps))
    near = np.flatnonzero(np.abs(images.stamps[nearest] - stamps) <= limit)
    hand_eye = metadata.frames.T_flange_camera if metadata.frames.pose == "T_world_flange" else None
    session = Session(
        id=metadata.id,
        stamps=stamps,
        poses=pose_from_tum(table.stack(TUM_POSE)),
        pose_frame=metadata.frames.pose,
        pose_error=metadata.frames.pose_error,
        T_flange_camera=None if hand_eye is None else pose_from_tum(np.array(hand_eye)),
        noise=stated_noise(metadata),
        observations=Observations(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0)),
        plant=metadata.plant,
        path=path,
        level=1,
        warnings=tuple(warnings),
    )
    return session, read_camera(path / "camera.yaml"), [(i, path / images.names[nearest[i]]) for i in near.tolist()]


def _finder(spec: BoardSpec) -> Callable[[Any], list[tuple[IntArray, Array, Array]]]:
    """What finds rigid sets of corners in a picture: labels (k,), places on the board (k, 3), pixels (k, 2)."""
    from cv2 import aruco

    if spec.kind == "charuco":
        board = aruco.CharucoBoard((spec.columns, spec.rows), spec.square_m, spec.marker_m, _dictionary(spec))
        charuco = aruco.CharucoDetector(board)
        places = np.asarray(board.getChessboardCorners(), dtype=np.float64).reshape(-1, 3)

        def find_board(image: Any) -> list[tuple[IntArray, Array, Array]]:
            corners, ids, *_ = charuco.detectBoard(image)
            if ids is None or len(np.ravel(ids)) < _MIN_CORNERS:
                return []
            label = np.ravel(ids).astype(np.int64)
            return [(label, places[label], np.asarray(corners, dtype=np.float64).reshape(-1, 2))]

        return find_board
    tags = aruco.ArucoDetector(_dictionary(spec))
    half = spec.marker_m / 2.0
    square = np.array([[-half, half, 0.0], [half, half, 0.0], [half, -half, 0.0], [-half, -half, 0.0]])

    def find_tags(image: Any) -> list[tuple[IntArray, Array, Array]]:
        corners, ids, _ = tags.detectMarkers(image)
        found = [] if ids is None else zip(np.ravel(ids).tolist(), corners, strict=True)
        each = [(4 * i + np.arange(4), square, np.asarray(c, dtype=np.float64).reshape(4, 2)) for i, c in found]
        return sorted(each, key=lambda one: int(one[0][0]))

    return find_tags


def _board_pose(camera: Camera, corners: Array, pixels: Array) -> Array | None:
    """``T_camera_board`` (4, 4) by PnP; None where the corners do not determine it."""
    import cv2

    K = np.array([[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]])
    method = cv2.SOLVEPNP_IPPE_SQUARE if len(corners) == 4 and _is_square(corners) else cv2.SOLVEPNP_ITERATIVE
    try:
        good, turn, shift = cv2.solvePnP(corners, pixels, K, camera.distortion, flags=method)
    except cv2.error:
        return None
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = so3_exp(np.ravel(turn).astype(np.float64)), np.ravel(shift)
    return T if good and np.isfinite(T).all() and T[2, 3] > 0 else None


def _is_square(corners: Array) -> bool:
    sides = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    return bool(np.allclose(sides, sides[0]) and np.allclose(corners.sum(0), 0.0))


def _variance(camera: Camera, T: Array, corners: Array, session: Session) -> float:
    """Mean variance (m^2, an axis) of the corners in the camera, by the pixels' errors through the board's pose."""
    sigma = session.noise.pixel
    p = transform(T, corners)
    J = np.concatenate([-skew(p - T[:3, 3]), np.broadcast_to(np.eye(3), (len(p), 3, 3))], axis=-1)
    z = p[:, 2]
    zero = np.zeros(len(p))
    projection = np.stack(
        [
            np.stack([camera.fx / z, zero, -camera.fx * p[:, 0] / z**2], axis=-1),
            np.stack([zero, camera.fy / z, -camera.fy * p[:, 1] / z**2], axis=-1),
        ],
        axis=1,
    )
    A = (projection @ J).reshape(-1, 6) / sigma
    cov = np.linalg.solve(A.T @ A + 1e-9 * np.trace(A.T @ A) * np.eye(6), np.eye(6))
    return float(np.trace(J @ cov @ np.swapaxes(J, 1, 2), axis1=1, axis2=2).mean() / 3.0)
