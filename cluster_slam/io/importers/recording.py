"""What an importer finds in a recording, and what it hands over to be written as a session."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.io.importers.session_files import SessionHead
from cluster_slam.records import PoseFrame
from cluster_slam.sensors.camera import Camera


@dataclass(frozen=True, slots=True)
class ImportOptions:
    """What the user says of a recording; None: guessed."""

    id: str | None = None
    plant: str | None = None
    colour: str | None = None  # topic of colour images
    depth: str | None = None  # topic of depth images
    camera_info: str | None = None  # topic of intrinsics
    pose: str | None = None  # topic of poses; or of tf: "PARENT>CHILD"
    flowers: str | None = None  # topic of points, or variable of a .mat file
    camera_file: Path | None = None  # camera.yaml in place of what the recording has
    poses_file: Path | None = None  # TUM trajectory or RTDE log in place of what the recording has
    is_still: bool = False  # the camera does not move; no poses are needed
    pose_frame: PoseFrame | None = None
    T_flange_camera: Array | None = None  # (7,) tx ty tz qx qy qz qw
    depth_scale: float | None = None  # m per unit
    time_offset_s: float = 0.0  # added to the stamps of the poses
    rate_hz: float = 30.0  # of frames without stamps
    unit_m: float | None = None  # metres per unit of positions without a unit: 1 or 0.001


@dataclass(frozen=True, slots=True)
class Stream:
    """One topic, folder, column or variable of a recording."""

    name: str
    kind: str  # its type in the words of the format
    n: int
    begin_s: float  # NaN without stamps
    end_s: float
    role: str = ""  # what it is used for: colour, depth, camera, pose, flowers


@dataclass(frozen=True, slots=True, eq=False)
class Picture:
    """One image as it is to lie in the session."""

    stamp: float  # s
    data: bytes  # of the file
    suffix: str  # .png, .jpg


Register = Callable[[NDArray[np.uint16]], NDArray[np.uint16]]
Pictures = Callable[[], Iterator[Picture | str]]  # an image, or in words why there is none


@dataclass(frozen=True, slots=True, eq=False)
class FlowerRows:
    """Points with the stamps of their frames."""

    stamps: Array  # (m,) s
    points: Array  # (m, 3) m
    covs: Array | None = None  # (m, 3, 3) m^2
    scores: Array | None = None  # (m,)


@dataclass(frozen=True, slots=True, eq=False)
class Imported:
    """A recording, ready to be written; images are read when they are."""

    format: str
    streams: tuple[Stream, ...]
    head: SessionHead
    pose_stamps: Array  # (p,) s, increasing
    pose_rows: Array  # (p, 7) tx ty tz qx qy qz qw
    frame_stamps: Array | None = None  # (n,) of images or points; None: the poses' own
    camera: Camera | None = None
    colour: Pictures | None = None
    depth: Pictures | None = None
    flowers: FlowerRows | None = None
    register: Register | None = None  # brings depth images into the colour camera's pixels
    warnings: tuple[str, ...] = field(default=())


ImportFormat = Literal["ros", "tum", "open3d", "rtde", "mat", "csv"]


def choose(path: Path, role: str, wanted: str | None, there: list[str], guesses: list[str]) -> str | None:
    """The stream for a role: the one that is asked for, else the best guess that is there, else None.

    Raises
    ------
    InputError
        What is asked for is not there; the message lists what is.
    """
    if wanted is not None:
        if wanted not in there:
            raise InputError(f"{path}: no {role} {wanted!r}, expected one of {', '.join(there) or 'none'}")
        return wanted
    return guesses[0] if guesses else None


def check_overlap(path: Path, stamps: Array, pose_stamps: Array) -> None:
    """Refuse poses that are of another time than the frames.

    Raises
    ------
    InputError
        Names both times, and the offset that would bring them together.
    """
    if not len(stamps) or not len(pose_stamps):
        return
    if stamps[-1] >= pose_stamps[0] and stamps[0] <= pose_stamps[-1]:
        return
    a, b = f"{stamps[0]:.3f} to {stamps[-1]:.3f}", f"{pose_stamps[0]:.3f} to {pose_stamps[-1]:.3f}"
    hint = f"--time-offset {stamps[0] - pose_stamps[0]:.3f} would let them begin together"
    raise InputError(f"{path}: frames from {a} s, poses from {b} s: no time in common ({hint})")


def joined(rows: list[Array], width: int) -> Array:
    """Rows (k, width) stacked, also none."""
    return np.concatenate(rows) if rows else np.zeros((0, width))
