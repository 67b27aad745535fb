"""A session as a TUM RGB-D folder, and trajectories as TUM files."""

from __future__ import annotations

import shutil
from pathlib import Path

from cluster_slam.errors import InputError
from cluster_slam.geometry import tum_from_pose
from cluster_slam.io.importers.poses import read_pose_file
from cluster_slam.io.importers.session_files import SessionHead, new_folder, session_toml, trajectory
from cluster_slam.io.metadata import read_metadata
from cluster_slam.records import Session

_COPIED = ("rgb.txt", "depth.txt", "camera.yaml")


def camera_trajectory(session: Session, folder: Path) -> str:
    """The camera's trajectory: as it was written where the session has the camera's poses, else by the mount."""
    if session.T_flange_camera is None:
        stamps, rows, _, _ = read_pose_file(folder / "poses.txt", 0.0)
        return trajectory(stamps, rows)
    return trajectory(session.stamps, tum_from_pose(session.T_world_camera))


def export_tum(session: Session, folder: Path, out: Path) -> int:
    """Write ``groundtruth.txt``, and the images with their lists where there are any; how many were copied.

    Images stay as they are; their unit of depth, which need not be TUM's 0.2 mm, stands in a ``session.toml`` beside.

    Raises
    ------
    InputError
        A list names an image that is not there.
    OutputError
        ``out`` cannot be written.
    """
    text = camera_trajectory(session, folder)
    n_images = 0
    with new_folder(out) as new:
        (new / "groundtruth.txt").write_text(text, "utf-8")
        for name in _COPIED:
            if (folder / name).is_file():
                shutil.copyfile(folder / name, new / name)
        if (new / "depth.txt").is_file():
            (new / "session.toml").write_text(_head(session, folder), "utf-8")
        for image in listed_images(folder):
            target = new / image.relative_to(folder)
            target.parent.mkdir(parents=True, exist_ok=True)
            shutil.copyfile(image, target)
            n_images += 1
    return n_images


def _head(session: Session, folder: Path) -> str:
    """``session.toml`` of the camera's trajectory and its depth images."""
    metadata, _ = read_metadata(folder / "session.toml")
    head = SessionHead(
        id=session.id,
        plant=session.plant,
        pose_error=session.pose_error,
        max_time_difference_s=metadata.frames.max_time_difference,
        depth_scale=metadata.depth.scale,
        depth_camera=metadata.depth.camera,
    )
    return session_toml(head)


def listed_images(folder: Path) -> list[Path]:
    """The images that a session's lists name.

    Raises
    ------
    InputError
        One is not there, or lies outside of the session.
    """
    found = []
    for name in ("rgb.txt", "depth.txt"):
        if not (folder / name).is_file():
            continue
        for i, line in enumerate((folder / name).read_text("utf-8").splitlines(), 1):
            cells = line.split("#", 1)[0].split()
            if not cells:
                continue
            image = folder / cells[-1]
            if not image.is_file() or ".." in Path(cells[-1]).parts or Path(cells[-1]).is_absolute():
                raise InputError(
                    f"{folder / name}: row {i}: {cells[-1]} is not there, expected an image in the session"
                )
            found.append(image)
    return found
