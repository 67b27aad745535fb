"""Level 1: the flowers of a session's pictures, found by a detector and lifted by the depth images."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array
from cluster_slam.io.images import FAR_M, FramePictures, ImageFolder, open_images, pictures
from cluster_slam.io.metadata import Metadata
from cluster_slam.lift import LiftedBoxes, lift_boxes
from cluster_slam.records import ImageDetections, IntArray, Observations
from cluster_slam.sensors.depth import depth_model

Progress = Callable[[str, float], None]
_SHOWN = 3  # problems that are told one by one


class Detector(Protocol):
    """Finds flowers in a picture."""

    @property
    def lean(self) -> float:
        """How far its middles lie to where flowers face: widths for each unit of the tangent of their tilt."""
        ...

    def detect(self, image: NDArray[np.uint8]) -> ImageDetections:
        """Boxes of the flowers in a picture (h, w, 3), 8 bits, blue green red; best first."""
        ...

    def sigma_px(self, sizes: Array) -> Array:
        """Sigma (k,) of u and of v of the middles of boxes (k, 2), pixels."""
        ...


@dataclass(frozen=True, slots=True, eq=False)
class PictureDetections:
    """All that a detector found in a session's pictures; m rows, in the order of the frames."""

    frame: IntArray  # (m,)
    boxes: ImageDetections  # (m,)
    depths: Array  # (m,) m, as the depth images measure them
    sigma_px: Array  # (m,)
    sigma_depths: Array  # (m,) m
    observations: Observations
    warnings: tuple[str, ...]
    counts: dict[str, int] = field(default_factory=dict)


def observe_pictures(
    folder: Path, metadata: Metadata, stamps: Array, detector: Detector, progress: Progress | None = None
) -> PictureDetections:
    """Run a detector over a session's pictures and lift what it finds.

    Boxes without a depth are counted and left out; so are frames whose pictures cannot be read.

    Raises
    ------
    InputError
        The pictures, or what is said about them, are not what the format says.
    """
    limit = metadata.frames.max_time_difference
    images = open_images(folder, stamps, scale=metadata.depth.scale, max_time_difference=limit)
    focal = (images.camera.fx + images.camera.fy) / 2
    model = depth_model(metadata.depth.camera or "generic", focal_px=focal, coefficient=metadata.noise.depth)
    rows, seen = [], _Seen(images)
    for k, shot in enumerate(pictures(images)):
        if progress is not None:
            progress("looking for flowers", k / len(images.frame))
        if shot.colour is None or shot.depth is None:
            seen.problems.append(shot.problem)
            continue
        seen.note(shot)
        boxes = detector.detect(shot.colour)
        sigma_px = _sigma_px(detector, boxes, metadata)
        lifted = lift_boxes(
            images.camera,
            boxes,
            shot.depth,
            convention=metadata.depth.convention,
            model=model,
            sigma_px=sigma_px,
            image=shot.colour,
            lean=detector.lean,
        )
        rows.append((shot.frame, boxes, lifted))
    return _together(rows, seen)


def _sigma_px(detector: Detector, boxes: ImageDetections, metadata: Metadata) -> Array:
    """What the session states, else what the detector knows of itself."""
    if metadata.noise.pixel is not None:
        return np.full(len(boxes), metadata.noise.pixel)
    return detector.sigma_px(boxes.sizes)


@dataclass(slots=True, eq=False)
class _Seen:
    """What is noticed on the way."""

    images: ImageFolder
    problems: list[str] = field(default_factory=list)
    medians: list[float] = field(default_factory=list)

    def note(self, shot: FramePictures) -> None:
        depth = shot.depth if shot.depth is not None else np.zeros((1, 1))
        valid = depth[::7, ::7]
        valid = valid[valid > 0]
        self.medians.append(float(np.median(valid)) if len(valid) else np.nan)

    def warnings(self, n_boxes: int, n_lifted: int) -> list[str]:
        found = [f"{text}; the frame is skipped" for text in self.problems[:_SHOWN]]
        if len(self.problems) > _SHOWN:
            found.append(f"{len(self.problems)} frames in all are skipped, as an image of theirs cannot be read")
        if self.images.n_without:
            found.append(f"rgb.txt: {self.images.n_without} frames of poses.txt have no pictures near them in time")
        median = float(np.nanmedian(self.medians)) if np.isfinite(self.medians).any() else 0.0
        if median > FAR_M:
            text = f"median depth {median:.3g} m with scale = {self.images.scale:g}"
            found.append(f"depth.txt: {text}, expected a plant within reach of an arm: is the scale right?")
        elif not self.medians or median == 0.0:
            found.append("depth.txt: no pixel with a depth in any image")
        elif median < 0.02:
            found.append(f"depth.txt: median depth {median:.3g} m, expected metres: is depth.scale right?")
        if n_boxes and n_lifted < 0.5 * n_boxes:
            found.append(f"{n_boxes - n_lifted} of {n_boxes} detections have no depth and are left out")
        return found


def _together(rows: list[tuple[int, ImageDetections, LiftedBoxes]], seen: _Seen) -> PictureDetections:
    def column(values: list[Array], shape: tuple[int, ...]) -> Array:
        return np.concatenate([*values, np.empty((0, *shape))])

    frame = np.concatenate([np.full(len(b), k) for k, b, _ in rows] + [np.empty(0, np.int64)]).astype(np.int64)
    keep = np.concatenate([lifted.is_lifted for *_, lifted in rows] + [np.empty(0, bool)])
    boxes = [b for _, b, _ in rows]
    scores = column([b.scores for b in boxes], ())[keep]
    n_boxes, n_lifted = len(keep), int(keep.sum())
    points = column([lifted.points for *_, lifted in rows], (3,))[keep]
    covs = column([lifted.covs for *_, lifted in rows], (3, 3))[keep]
    return PictureDetections(
        frame[keep],
        ImageDetections(
            column([lifted.centres for *_, lifted in rows], (2,))[keep],
            column([b.sizes for b in boxes], (2,))[keep],
            scores,
        ),
        column([lifted.depths for *_, lifted in rows], ())[keep],
        column([lifted.sigma_px for *_, lifted in rows], ())[keep],
        column([lifted.sigma_depths for *_, lifted in rows], ())[keep],
        Observations(frame[keep], points, covs, scores, True),
        tuple(seen.warnings(n_boxes, n_lifted)),
        {
            "images": len(rows),
            "images_skipped": len(seen.problems),
            "detections": n_boxes,
            "detections_without_depth": n_boxes - n_lifted,
        },
    )
