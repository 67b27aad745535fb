"""Folders of images: TUM RGB-D (lists with stamps) and Open3D's captures (numbered files and a JSON of intrinsics)."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, tum_from_pose
from cluster_slam.io.camera_info import read_camera
from cluster_slam.io.importers.poses import read_pose_file
from cluster_slam.io.importers.recording import Imported, ImportOptions, Picture, Stream
from cluster_slam.io.importers.session_files import SessionHead
from cluster_slam.io.metadata import read_metadata
from cluster_slam.io.text import read_text, shown
from cluster_slam.records import PoseFrame
from cluster_slam.sensors.camera import Camera

TUM_SCALE, OPEN3D_SCALE = 0.0002, 0.001  # m per unit of the depth images, by convention
_TRAJECTORIES = ("groundtruth.txt", "poses.txt", "trajectory.txt")
_COLOUR_FOLDERS, _DEPTH_FOLDERS = ("color", "rgb", "image"), ("depth",)
_SUFFIXES = (".png", ".jpg", ".jpeg")
_INTRINSICS = ("camera_intrinsic.json", "intrinsic.json", "intrinsics.json")


def is_tum(folder: Path) -> bool:
    """Whether a folder has TUM's list of colour images."""
    return (folder / "rgb.txt").is_file()


def is_open3d(folder: Path) -> bool:
    """Whether a folder has numbered images and a JSON of intrinsics."""
    has_images = any((folder / name).is_dir() for name in _COLOUR_FOLDERS)
    return has_images and any((folder / name).is_file() for name in _INTRINSICS)


def read_tum_folder(folder: Path, options: ImportOptions) -> Imported:
    """A TUM RGB-D folder: ``rgb.txt``, ``depth.txt``, ``groundtruth.txt``; intrinsics from ``camera.yaml``.

    Raises
    ------
    InputError
        A list or a trajectory is missing or wrong, or nobody knows the intrinsics.
    """
    lists = {name: _list(folder / f"{name}.txt") for name in ("rgb", "depth") if (folder / f"{name}.txt").is_file()}
    own = folder / "camera.yaml"
    if options.camera_file is None and not own.is_file():
        raise InputError(f"{folder}: no intrinsics (no camera.yaml), expected --camera FILE.yaml")
    there = [folder / name for name in _TRAJECTORIES if (folder / name).is_file()]
    options = _as_session(folder, options)
    return _imported(
        folder, "TUM RGB-D folder", options, lists, read_camera(options.camera_file or own), there, TUM_SCALE
    )


def _as_session(folder: Path, options: ImportOptions) -> ImportOptions:
    """What a ``session.toml`` in the folder says, where the options say nothing."""
    if not (folder / "session.toml").is_file():
        return options
    metadata, _ = read_metadata(folder / "session.toml")
    mount = metadata.frames.T_flange_camera if metadata.frames.pose == "T_world_flange" else None
    known = options.T_flange_camera is not None or mount is None
    return replace(
        options,
        id=options.id or metadata.id,
        plant=options.plant or metadata.plant,
        pose_frame=options.pose_frame or metadata.frames.pose,
        T_flange_camera=options.T_flange_camera if known else np.array(mount),
        depth_scale=options.depth_scale or metadata.depth.scale,
    )


def read_open3d_folder(folder: Path, options: ImportOptions) -> Imported:
    """An Open3D capture: ``color/``, ``depth/``, ``camera_intrinsic.json``, and poses as a Redwood ``.log``.

    The files have numbers and no stamps: frame i is at i / rate.

    Raises
    ------
    InputError
        Something is missing or wrong.
    """
    lists = {"rgb": _numbered(folder, _COLOUR_FOLDERS, options.rate_hz)}
    depth = _numbered(folder, _DEPTH_FOLDERS, options.rate_hz)
    lists |= {"depth": depth} if depth else {}
    file = next(folder / name for name in _INTRINSICS if (folder / name).is_file())
    camera = read_camera(options.camera_file) if options.camera_file else _json_camera(file)
    there = sorted([*folder.glob("*.log"), *folder.glob("*/trajectory.log")])
    return _imported(folder, "Open3D capture", options, lists, camera, there, OPEN3D_SCALE)


def _imported(
    folder: Path,
    format: str,
    options: ImportOptions,
    lists: dict[str, list[tuple[float, Path]]],
    camera: Camera,
    trajectories: Sequence[Path],
    scale: float,
) -> Imported:
    stamps = np.array([stamp for stamp, _ in lists["rgb"]])
    pose_stamps, rows, pose_frame, warnings = _poses(folder, options, trajectories, stamps)
    head = SessionHead(
        options.id or folder.resolve().name,
        options.plant,
        options.pose_frame or pose_frame,
        T_flange_camera=options.T_flange_camera,
        depth_scale=options.depth_scale or scale,
        source=f"imported from {folder.resolve().name}",
    )
    if head.pose_frame == "T_world_flange" and head.T_flange_camera is None:
        raise InputError(f"{folder}: poses of the flange, expected --hand-eye 'TX TY TZ QX QY QZ QW' beside them")
    streams = [Stream(name, "images", len(found), found[0][0], found[-1][0], name) for name, found in lists.items()]
    if len(pose_stamps):
        streams.append(Stream("poses", "trajectory", len(rows), float(pose_stamps[0]), float(pose_stamps[-1]), "pose"))
    depth = _reader(lists["depth"]) if "depth" in lists else None
    colour = _reader(lists["rgb"])
    return Imported(format, tuple(streams), head, pose_stamps, rows, stamps, camera, colour, depth, warnings=warnings)


def _poses(
    folder: Path, options: ImportOptions, trajectories: Sequence[Path], stamps: Array
) -> tuple[Array, Array, PoseFrame, tuple[str, ...]]:
    if options.is_still:
        return stamps, np.tile([0.0, 0, 0, 0, 0, 0, 1], (len(stamps), 1)), "T_world_camera", ()
    file = options.poses_file or next(iter(trajectories), None)
    if file is None:
        raise InputError(
            f"{folder}: no trajectory, expected one of {', '.join(_TRAJECTORIES)}, --poses FILE or --still"
        )
    if file.suffix == ".log":
        rows = _redwood(file)
        return np.arange(len(rows)) / options.rate_hz + options.time_offset_s, rows, "T_world_camera", ()
    return read_pose_file(file, options.time_offset_s)


def _list(path: Path) -> list[tuple[float, Path]]:
    """Stamps and files of a TUM list."""
    found = []
    for i, line in enumerate(read_text(path, "a list of images").split("\n"), 1):
        cells = line.split("#", 1)[0].split()
        if not cells:
            continue
        try:
            stamp, name = float(cells[0]), cells[1]
        except (ValueError, IndexError):
            raise InputError(f"{path}: row {i}: {shown(line)}, expected timestamp and filename") from None
        found.append((stamp, path.parent / name))
    if not found:
        raise InputError(f"{path}: row 1: no image, expected rows of timestamp and filename")
    return sorted(found)


def _numbered(folder: Path, names: Sequence[str], rate_hz: float) -> list[tuple[float, Path]]:
    """Images by their number over the rate."""
    place = next((folder / name for name in names if (folder / name).is_dir()), None)
    files = [] if place is None else sorted(p for p in place.iterdir() if p.suffix.lower() in _SUFFIXES)
    numbers = [re.search(r"(\d+)$", path.stem) for path in files]
    bad = [path for path, number in zip(files, numbers, strict=True) if number is None]
    if bad:
        raise InputError(f"{bad[0]}: no number at the end of its name, expected one")
    return sorted((int(n.group(1)) / rate_hz, path) for n, path in zip(numbers, files, strict=True) if n)


def _json_camera(path: Path) -> Camera:
    """Open3D's intrinsics: ``intrinsic_matrix`` column by column."""
    try:
        content = json.loads(read_text(path, "intrinsics as JSON"))
        k = np.array(content["intrinsic_matrix"], float).reshape(3, 3).T
        size = int(content["width"]), int(content["height"])
    except (ValueError, KeyError, TypeError) as error:
        text = f"{type(error).__name__}: {error}"
        raise InputError(f"{path}: {text}, expected width, height and intrinsic_matrix (9 numbers)") from None
    if not (k[0, 0] > 0 and k[1, 1] > 0):
        raise InputError(f"{path}: fx {k[0, 0]:g}, fy {k[1, 1]:g}, expected both above 0")
    return Camera(k[0, 0], k[1, 1], k[0, 2], k[1, 2], np.zeros(8), *size)


def _redwood(path: Path) -> Array:
    """Rows ``tx ty tz qx qy qz qw`` (n, 7) of a Redwood log: a line of three numbers, then a 4 x 4 camera-to-world."""
    lines = [line.split() for line in read_text(path, "a Redwood trajectory").split("\n") if line.strip()]
    if not lines or len(lines) % 5:
        raise InputError(f"{path}: {len(lines)} rows, expected five for each pose")
    try:
        numbers = [[float(x) for x in line] for k, line in enumerate(lines) if k % 5]
        T = np.array(numbers).reshape(-1, 4, 4)
    except ValueError:
        raise InputError(f"{path}: rows that are no 4 x 4 matrices, expected four numbers a row") from None
    error = np.abs(T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2) - np.eye(3)).max(axis=(1, 2))
    if not (error < 1e-3).all():
        k = int((~(error < 1e-3)).argmax())
        raise InputError(f"{path}: row {5 * k + 2}: no rotation (off by {error[k]:.3g}), expected one")
    return tum_from_pose(T)


def _reader(images: list[tuple[float, Path]]) -> Callable[[], Iterator[Picture | str]]:
    def read() -> Iterator[Picture | str]:
        for stamp, path in images:
            try:
                yield Picture(stamp, path.read_bytes(), path.suffix.lower())
            except OSError as error:
                yield f"{path}: cannot be read ({error.strerror})"

    return read
