"""``detections.csv`` of a detector: of a session's pictures with depths, or of a folder of images without."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError, OutputError
from cluster_slam.geometry import pose_from_tum
from cluster_slam.io.folder import check_writable, recover, write_folder
from cluster_slam.io.images import read_colour
from cluster_slam.io.metadata import read_metadata
from cluster_slam.io.observed import Detector, Progress, observe_pictures
from cluster_slam.io.result import stamp_words
from cluster_slam.io.tables import TUM_POSE, read_tum

IMAGE_KINDS = (".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff")
SESSION_COLUMNS = "timestamp,u,v,depth,score,width,height,sigma_pixel,sigma_depth"
FOLDER_COLUMNS = "image,u,v,score,width,height"
_SESSION_ROW = "{:.3f},{:.3f},{:.6f},{:.4f},{:.2f},{:.2f},{:.3f},{:.6f}"
_FOLDER_ROW = "{:.3f},{:.3f},{:.4f},{:.2f},{:.2f}"
_OWN_FILES = ("detections.csv", "camera.yaml", "poses.txt", "session.toml")


@dataclass(frozen=True, slots=True)
class Detected:
    """What was done."""

    counts: dict[str, int]
    warnings: tuple[str, ...] = field(default=())


def check_detections_output(out: Path) -> None:
    """Refuse a folder that cannot be written or holds anything but earlier detections.

    Raises
    ------
    OutputError
        Names the folder and what stands in the way.
    """
    check_writable(out)
    recover(out)
    names = sorted(entry.name for entry in out.iterdir()) if out.exists() else []
    foreign = [name for name in names if name not in _OWN_FILES]
    if foreign or (names and "detections.csv" not in names):
        raise OutputError(
            f"{out}: holds {(foreign or names)[0]}, expected a free name, an empty folder or earlier detections"
        )


def detect_session(source: Path, out: Path, detector: Detector, progress: Progress | None = None) -> Detected:
    """Detections of a session's pictures; with its other files OUT is a session of level 2.

    Raises
    ------
    InputError
        The session is not what the format says.
    """
    metadata, warnings = read_metadata(source / "session.toml")
    poses = read_tum(source / "poses.txt", "a TUM trajectory with one row a frame")
    pose_from_tum(poses.stack(TUM_POSE))
    seen = observe_pictures(source, metadata, poses.columns["timestamp"], detector, progress)
    stamps = stamp_words(poses.columns["timestamp"])
    boxes = seen.boxes
    table = np.column_stack(
        [boxes.centres, seen.depths, boxes.scores, boxes.sizes, seen.sigma_px, seen.sigma_depths]
    ).tolist()
    lines = [f"{stamps[k]},{_SESSION_ROW.format(*row)}" for k, row in zip(seen.frame.tolist(), table, strict=True)]
    files: dict[str, str | bytes] = {"detections.csv": "\n".join([SESSION_COLUMNS, *lines, ""])}
    for name in _OWN_FILES[1:]:
        files[name] = (source / name).read_bytes()
    write_folder(out, files)
    return Detected(seen.counts, (*warnings, *poses.warnings, *seen.warnings))


def detect_images(source: Path, out: Path, detector: Detector, progress: Progress | None = None) -> Detected:
    """Detections of all images of a folder.

    Raises
    ------
    InputError
        The folder is missing or holds no image.
    """
    paths = _images(source)
    lines, skipped = [], []
    for k, path in enumerate(paths):
        if progress is not None:
            progress("looking for flowers", k / len(paths))
        image = read_colour(path)
        if image is None:
            skipped.append(path)
            continue
        found = detector.detect(image)
        values = np.column_stack([found.centres, found.scores, found.sizes]).tolist()
        lines += [f"{_quoted(path.name)},{_FOLDER_ROW.format(*row)}" for row in values]
    if len(skipped) == len(paths):
        raise InputError(f"{skipped[0]}: cannot be read as an image, nor any of the {len(paths)} of its folder")
    write_folder(out, {"detections.csv": "\n".join([FOLDER_COLUMNS, *lines, ""])})
    counts = {"images": len(paths) - len(skipped), "images_skipped": len(skipped), "detections": len(lines)}
    return Detected(counts, _skipped(skipped))


def _images(source: Path) -> list[Path]:
    if not source.is_dir():
        raise InputError(f"{source}: {'is a file' if source.exists() else 'missing'}, expected a folder of images")
    paths = sorted(path for path in source.iterdir() if path.suffix.lower() in IMAGE_KINDS)
    if not paths:
        raise InputError(f"{source}: no session.toml and no image, expected a session or a folder of images")
    return paths


def _quoted(name: str) -> str:
    return '"' + name.replace('"', '""') + '"' if set(name) & set(',"\n') else name


def _skipped(paths: Sequence[Path]) -> tuple[str, ...]:
    found = [f"{path}: cannot be read as an image; it is skipped" for path in paths[:3]]
    return (*found, f"{len(paths)} images in all are skipped") if len(paths) > 3 else tuple(found)
