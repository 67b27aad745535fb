"""What is known before a live session begins, and which camera it has."""

from __future__ import annotations

import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType
from typing import Self

import numpy as np

from cluster_slam.errors import ConfigError, InputError
from cluster_slam.geometry import Array, pose_from_tum, tum_from_pose
from cluster_slam.io.importers.session_files import DepthCamera, SessionHead
from cluster_slam.io.text import read_text
from cluster_slam.live.view import LiveCamera, View
from cluster_slam.records import Observations, Session, StatedNoise
from cluster_slam.sensors.camera import Camera

UNKNOWN_M, UNKNOWN_RAD = 1.0, 3.0  # sigmas of a hand-eye transform that nobody has measured
_NORM_TOLERANCE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Mount:
    """How the camera sits on the flange (on the active TCP), and how well that is known."""

    T_flange_camera: Array  # (4, 4)
    sigma_translation: float  # m
    sigma_rotation: float  # rad


UNKNOWN_MOUNT = Mount(np.eye(4), UNKNOWN_M, UNKNOWN_RAD)


def mount_of_numbers(numbers: Sequence[float]) -> Mount:
    """The mount of ``tx ty tz qx qy qz qw``, measured by hand.

    Raises
    ------
    ConfigError
        No seven numbers, or no unit quaternion.
    """
    row = np.array(numbers, dtype=float)
    if row.shape != (7,) or not np.isfinite(row).all() or abs(np.linalg.norm(row[3:]) - 1) > _NORM_TOLERANCE:
        raise ConfigError(f"hand-eye {list(numbers)}, expected tx ty tz qx qy qz qw with a unit quaternion")
    noise = StatedNoise()
    return Mount(pose_from_tum(row), noise.hand_eye_translation, noise.hand_eye_rotation)


def read_mount(path: Path) -> Mount:
    """The mount of a ``calibration.toml``, as ``smooth`` writes it, with its covariance.

    Raises
    ------
    InputError
        No TOML, no ``T_flange_camera``, or a covariance that is none.
    """
    try:
        content = tomllib.loads(read_text(path, "a calibration.toml"))
        mount = mount_of_numbers(content["T_flange_camera"])
        cov = np.array(content.get("covariance", np.diag([1e-4] * 3 + [2.5e-5] * 3)), dtype=float)
        np.linalg.cholesky(cov)
    except (tomllib.TOMLDecodeError, KeyError, TypeError, ValueError, ConfigError, np.linalg.LinAlgError) as error:
        expected = "expected T_flange_camera = [tx, ty, tz, qx, qy, qz, qw] and a covariance (6 x 6)"
        raise InputError(f"{path}: {type(error).__name__}: {error}, {expected}") from None
    variances = np.diag(cov)
    return replace(
        mount,
        sigma_rotation=float(np.sqrt(variances[:3].max())),
        sigma_translation=float(np.sqrt(variances[3:].max())),
    )


def live_header(mount: Mount, *, id: str | None = None, plant: str | None = None) -> Session:
    """A session without frames: what a live source and its tracker know beforehand."""
    noise = replace(StatedNoise(), hand_eye_translation=mount.sigma_translation, hand_eye_rotation=mount.sigma_rotation)
    none = Observations(np.zeros(0, np.int64), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))
    name = id or datetime.fromtimestamp(time.time(), UTC).strftime("live-%Y-%m-%dT%H-%M-%SZ")
    return Session(
        id=name,
        stamps=np.zeros(0),
        poses=np.zeros((0, 4, 4)),
        pose_frame="T_world_flange",
        pose_error="absolute",
        T_flange_camera=mount.T_flange_camera,
        noise=noise,
        observations=none,
        plant=plant,
    )


def head_of(header: Session, camera: LiveCamera, *, source: str | None = None) -> SessionHead:
    """What ``session.toml`` says of a live session."""
    T = header.T_flange_camera
    return SessionHead(
        header.id,
        header.plant,
        header.pose_frame,
        header.pose_error,
        None if T is None else tum_from_pose(T),
        (header.noise.hand_eye_translation, header.noise.hand_eye_rotation),
        (header.noise.pose_translation, header.noise.pose_rotation),
        depth_scale=camera.depth_scale,
        depth_camera=camera.depth_camera,
        source=source,
    )


class NoCamera:
    """A camera that is not there: the robot alone."""

    intrinsics: Camera | None = None
    depth_scale: float | None = None
    depth_camera: DepthCamera | None = None

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        return

    @property
    def is_over(self) -> bool:
        """Never: the robot goes on."""
        return False

    def take(self) -> list[View]:
        """Nothing."""
        return []

    def problems(self) -> list[str]:
        """None."""
        return []


def open_camera(name: str) -> LiveCamera:
    """The camera that a command names: ``none``, ``realsense`` (``realsense:SERIAL``), or a folder that grows.

    Raises
    ------
    InputError
        It is not there.
    """
    from cluster_slam.live.realsense import open_realsense
    from cluster_slam.live.watched import WatchedFolder

    if name == "none":
        return NoCamera()
    kind, _, serial = name.partition(":")
    if kind == "realsense":
        return open_realsense(serial=serial or None)
    return WatchedFolder(Path(name))
