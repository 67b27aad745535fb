"""An imported recording becomes a session folder, whole or not at all."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from cluster_slam.io.importers.poses import rows_at
from cluster_slam.io.importers.recording import Imported, Picture, Pictures, check_overlap
from cluster_slam.io.importers.session_files import (
    camera_yaml,
    check_free,
    flowers_csv,
    image_list,
    new_folder,
    number,
    session_toml,
    trajectory,
)

MAX_TIME_DIFFERENCE_S = 0.02  # of a depth image from its frame
_FAR_M = 10.0  # no flower is so far away: a median depth beyond this is told
_MAX_TOLD = 5  # unreadable images are named so often; the rest is counted
Progress = Callable[[str, float], None]


@dataclass(slots=True)
class ImportReport:
    """What was written, and what was not."""

    n_frames: int = 0
    n_without_pose: int = 0
    n_colour: int = 0
    n_depth: int = 0
    n_points: int = 0
    n_points_without_pose: int = 0
    n_unreadable: int = 0
    median_depth_m: float | None = None
    warnings: list[str] = field(default_factory=list)

    def leave_out(self, text: str) -> None:
        """An image that cannot be read."""
        self.n_unreadable += 1
        if self.n_unreadable <= _MAX_TOLD:
            self.warnings.append(f"{text}; it is left out")


def write_imported(imported: Imported, out: Path, progress: Progress | None = None) -> ImportReport:
    """Write the session ``out``.

    Raises
    ------
    InputError
        Nothing to write: no frame has a pose; or images that do not fit together.
    OutputError
        ``out`` is taken or cannot be written; nothing on disk has been changed.
    """
    check_free(out)
    say = progress or (lambda _stage, _fraction: None)
    report = ImportReport(warnings=list(imported.warnings))
    stamps, rows = _frames(imported, report)
    with new_folder(out) as folder:
        colour = _write_pictures(imported, folder, "rgb", imported.colour, stamps, report, say)
        depth = _write_pictures(imported, folder, "depth", imported.depth, stamps, report, say)
        files = {"session.toml": session_toml(imported.head), "poses.txt": trajectory(stamps, rows)}
        if imported.camera is not None:
            files["camera.yaml"] = camera_yaml(imported.camera)
        for name, found in (("rgb", colour), ("depth", depth)):
            if found:
                files[f"{name}.txt"] = image_list(np.array([s for s, _ in found]), [f"{name}/{n}" for _, n in found])
        if imported.flowers is not None or not colour:
            files["flowers.csv"] = _flowers(imported, stamps, report)
        for name, content in files.items():
            (folder / name).write_text(content, "utf-8")
    if report.n_without_pose:
        report.warnings.append(f"{report.n_without_pose} frames have no pose around them and are left out")
    if report.n_unreadable > _MAX_TOLD:
        report.warnings.append(f"{report.n_unreadable} images in all could not be read and are left out")
    return report


def _frames(imported: Imported, report: ImportReport) -> tuple[Array, Array]:
    """Stamps (n,) and rows (n, 7) of the frames that have a pose."""
    if imported.frame_stamps is None:
        stamps, rows = imported.pose_stamps, imported.pose_rows
    else:
        stamps = np.unique(imported.frame_stamps)
        check_overlap(Path(imported.head.source or imported.head.id), stamps, imported.pose_stamps)
        rows = rows_at(imported.pose_stamps, imported.pose_rows, stamps)
    has_pose = np.isfinite(rows).all(axis=1)
    report.n_frames, report.n_without_pose = int(has_pose.sum()), int((~has_pose).sum())
    if not has_pose.any():
        raise InputError(f"{imported.head.source}: none of {len(stamps)} frames has a pose around it")
    return stamps[has_pose], rows[has_pose]


def _flowers(imported: Imported, stamps: Array, report: ImportReport) -> str:
    seen = imported.flowers
    if seen is None:
        return flowers_csv(np.zeros(0), np.zeros((0, 3)))
    keep = np.isin(seen.stamps, stamps)
    report.n_points, report.n_points_without_pose = int(keep.sum()), int((~keep).sum())
    covs = None if seen.covs is None else seen.covs[keep]
    scores = None if seen.scores is None else seen.scores[keep]
    return flowers_csv(seen.stamps[keep], seen.points[keep], covs=covs, scores=scores)


def _write_pictures(
    imported: Imported,
    folder: Path,
    name: str,
    pictures: Pictures | None,
    stamps: Array,
    report: ImportReport,
    say: Progress,
) -> list[tuple[float, str]]:
    """Stamps and names of the images written."""
    if pictures is None:
        return []
    (folder / name).mkdir()
    check = _PictureCheck(imported, name)
    written: dict[float, str] = {}
    for picture in pictures():
        done = picture if isinstance(picture, str) else check.look(picture)
        if isinstance(done, str):
            report.leave_out(done)
        elif _is_wanted(done.stamp, stamps, name):
            file = f"{number(done.stamp)}{done.suffix}"
            (folder / name / file).write_bytes(done.data)
            written[done.stamp] = file
            say(f"writing {name}", len(written) / max(len(stamps), 1))
    check.finish(report)
    setattr(report, "n_colour" if name == "rgb" else "n_depth", len(written))
    return sorted(written.items())


def _is_wanted(stamp: float, stamps: Array, name: str) -> bool:
    nearest = float(np.abs(stamps - stamp).min())
    return nearest <= (0.0 if name == "rgb" else MAX_TIME_DIFFERENCE_S)


class _PictureCheck:
    """Reads each image once: sizes, bits, depths."""

    def __init__(self, imported: Imported, name: str) -> None:
        self._imported, self._is_depth = imported, name == "depth"
        self._medians: list[float] = []

    def look(self, picture: Picture) -> Picture | str:
        """The picture, registered where that is needed, or why it cannot be read.

        Raises
        ------
        InputError
            Depth of 8 bits, or of another size than the camera's.
        """
        import cv2

        where = f"{'depth' if self._is_depth else 'colour'} image at {picture.stamp:.6f} s"
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # what is broken is told by us
        data = np.frombuffer(picture.data, np.uint8)
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
        if image is None:
            return f"{where} cannot be read"
        if self._is_depth:
            if image.dtype != np.uint16 or image.ndim != 2:
                shape = "x".join(map(str, image.shape))
                raise InputError(f"{where}: {image.dtype} of {shape}, expected one channel of 16 bits")
            if self._imported.register is not None:
                image = self._imported.register(image)
                picture = replace(picture, data=cv2.imencode(".png", image)[1].tobytes())
            known = image[image > 0]
            self._medians += [float(np.median(known))] if len(known) else []
        self._check_size(where, image.shape[1], image.shape[0])
        return picture

    def _check_size(self, where: str, width: int, height: int) -> None:
        camera = self._imported.camera
        if camera is None or camera.width is None or (camera.width, camera.height) == (width, height):
            return
        text = f"{where}: {width} x {height}, its camera's intrinsics are of {camera.width} x {camera.height}"
        raise InputError(f"{text}, expected one size" + (" (depth aligned to colour)" if self._is_depth else ""))

    def finish(self, report: ImportReport) -> None:
        """Say what the depths look like."""
        scale = self._imported.head.depth_scale
        if not self._is_depth or not self._medians or scale is None:
            return
        report.median_depth_m = float(np.median(self._medians)) * scale
        if report.median_depth_m > _FAR_M:
            text = f"median depth {report.median_depth_m:.4g} m with a scale of {scale:g} m a unit"
            report.warnings.append(f"{text}: is the scale right (--depth-scale)?")
