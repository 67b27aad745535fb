"""A session folder, read and checked: poses, flowers in the camera frame, and truth where there is any."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, pose_from_tum
from cluster_slam.io.detections import read_detections
from cluster_slam.io.flowers import read_flowers
from cluster_slam.io.metadata import Metadata, read_metadata
from cluster_slam.io.observed import Detector, Progress, observe_pictures
from cluster_slam.io.tables import TUM_POSE, read_tum
from cluster_slam.io.truth import open_truth
from cluster_slam.io.units import unit_warnings
from cluster_slam.records import Observations, Session, StatedNoise

__all__ = ["open_session", "open_truth"]

OBSERVED = "observed.csv"  # in a result that began with pictures: what the detector found, as flowers.csv has it
LEVEL_FILES = {3: "flowers.csv", 2: "detections.csv", 1: "rgb.txt"}


def open_session(
    path: str | Path,
    *,
    level: int | None = None,
    detector: Detector | None = None,
    observed: Path | None = None,
    progress: Progress | None = None,
) -> Session:
    """Read a session folder.

    Parameters
    ----------
    path
        The folder.
    level
        Where to start: 3 flowers, 2 detections, 1 pictures. None: the highest level that is there.
    detector
        Level 1: what finds flowers in the pictures.
    observed
        Level 1: flowers that a detector found earlier, as ``smooth`` writes them into its result; no picture is read.
    progress
        Level 1: called with the stage in words and a fraction 0..1.

    Returns
    -------
    Session
        All values checked; what looks odd but can be used is named in ``warnings``.

    Raises
    ------
    InputError
        Names file, row, value and what was expected.
    """
    folder = Path(path)
    _check_folder(folder)
    metadata, warnings = read_metadata(folder / "session.toml")
    poses = read_tum(folder / "poses.txt", "a TUM trajectory with one row a frame")
    if not len(poses):
        raise InputError(f"{poses.path}: row 1: no frame, expected rows of timestamp tx ty tz qx qy qz qw")
    noise = stated_noise(metadata)
    stamps = poses.columns["timestamp"]
    used = session_level(folder, level)
    if used == 1 and observed is None:
        observations, more = _look(folder, metadata, stamps, detector, progress)
    else:
        observations, more = _read_observations(folder, used, metadata, noise, stamps, observed)
    hand_eye = metadata.frames.T_flange_camera if metadata.frames.pose == "T_world_flange" else None
    session = Session(
        id=metadata.id,
        stamps=stamps,
        poses=pose_from_tum(poses.stack(TUM_POSE)),
        pose_frame=metadata.frames.pose,
        pose_error=metadata.frames.pose_error,
        T_flange_camera=None if hand_eye is None else pose_from_tum(np.array(hand_eye)),
        noise=noise,
        observations=observations,
        plant=metadata.plant,
        path=folder,
        level=used,
    )
    return replace(session, warnings=(*warnings, *poses.warnings, *more, *unit_warnings(session)))


def _check_folder(folder: Path) -> None:
    if not folder.exists():
        raise InputError(f"{folder}: missing, expected a session folder")
    if not folder.is_dir():
        raise InputError(f"{folder}: is a file, expected a session folder")


def stated_noise(metadata: Metadata) -> StatedNoise:
    """The sigmas that a session states, with defaults where it states none."""
    stated = metadata.noise.model_dump(include=set(type(metadata.noise).model_fields), exclude_none=True)
    return replace(StatedNoise(), **stated)


def session_level(folder: Path, level: int | None = None) -> int:
    """Where processing of a session starts: the level that is asked for, else the highest that is there.

    Raises
    ------
    InputError
        There is no such level.
    """
    there = [n for n, name in LEVEL_FILES.items() if (folder / name).exists()]
    if level is None:
        if not there:
            raise InputError(f"{folder}: no flowers.csv, detections.csv or rgb.txt, expected at least one of them")
        level = there[0]
    if level not in LEVEL_FILES:
        raise InputError(
            f"{folder}: level {level}, expected 1 (rgb.txt, depth.txt), 2 (detections.csv) or 3 (flowers.csv)"
        )
    if level not in there:
        raise InputError(f"{folder / LEVEL_FILES[level]}: missing, expected as level {level} was asked for")
    return level


def _look(
    folder: Path, metadata: Metadata, stamps: Array, detector: Detector | None, progress: Progress | None
) -> tuple[Observations, tuple[str, ...]]:
    """What a detector finds in the pictures."""
    if detector is None:
        raise InputError(f"{folder}: has images only (level 1), expected a detector for them, or flowers.csv beside")
    seen = observe_pictures(folder, metadata, stamps, detector, progress)
    return seen.observations, seen.warnings


def _read_observations(
    folder: Path, level: int, metadata: Metadata, noise: StatedNoise, stamps: Array, observed: Path | None
) -> tuple[Observations, tuple[str, ...]]:
    if level == 1 and observed is not None:
        return read_flowers(observed, noise, stamps)
    if level == 3:
        return read_flowers(folder / LEVEL_FILES[3], noise, stamps)
    return read_detections(folder, metadata.depth.convention, noise, stamps)
