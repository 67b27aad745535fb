"""Flowers by colour alone: bright petals of little colour, split where they touch. Needs no model, and knows no better.

It serves as a baseline and for first steps; whatever is white is a flower to it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array
from cluster_slam.records import ImageDetections


@dataclass(frozen=True, slots=True)
class ColourDetector:
    """Finds bright pale blobs."""

    brightness: float = 0.55  # of a petal, 0 to 1 ...
    saturation: float = 0.35  # ... and its strongest colour
    min_radius_px: float = 2.5
    max_radius_px: float = 120.0
    min_score: float = 0.0  # least roundness
    split: float = 0.75  # a dip of the distance to the border to this share separates two flowers

    def detect(self, image: NDArray[np.uint8]) -> ImageDetections:
        """Boxes of pale blobs, best first; their score is how round they are."""
        import cv2

        mask = self._petals(image)
        distance = cv2.distanceTransform(mask, cv2.DIST_L2, 5)
        n, label, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
        rows: list[tuple[float, float, float, float, float]] = []
        for k in range(1, n):
            x, y, w, h, area = (int(value) for value in stats[k])
            if min(w, h) < 2 * self.min_radius_px or max(w, h) > 8 * self.max_radius_px:
                continue
            patch = np.where(label[y : y + h, x : x + w] == k, distance[y : y + h, x : x + w], 0)
            boxes = self._split(patch, area)
            rows += [(x + u, y + v, a, b, s) for u, v, a, b, s in boxes if s >= self.min_score]
        return _sorted(rows)

    @property
    def lean(self) -> float:
        """None: a blob's middle is that of the petals that are seen."""
        return 0.0

    def sigma_px(self, sizes: Array) -> Array:
        """An eighth of a box: what is hidden of a flower moves its blob."""
        sigma: Array = np.hypot(0.5, 0.125 * np.sqrt(sizes.prod(1)))
        return sigma

    def _petals(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        import cv2

        high = image.max(axis=2)
        low = image.min(axis=2)
        pale = (high >= 255 * self.brightness) & (high.astype(np.int16) - low <= self.saturation * high)
        mask = cv2.morphologyEx(pale.astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8))
        return _without_holes(mask)

    def _split(self, distance: NDArray[np.float32], area: int) -> list[tuple[float, float, float, float, float]]:
        """One box a hill of the distance to the border; hills that hardly dip between are one."""
        import cv2

        peak = float(distance.max())
        if peak < self.min_radius_px * 0.5 or peak > self.max_radius_px:
            return []
        tops = (distance >= self.split * peak).astype(np.uint8)
        n, _, _, centroids = cv2.connectedComponentsWithStats(tops, connectivity=8)
        if n <= 2:
            return [_box(distance > 0, area)]
        inside = np.column_stack(np.nonzero(distance > 0))
        owner = np.linalg.norm(inside[:, None, ::-1] - centroids[None, 1:], axis=2).argmin(1)
        found = []
        for k in range(n - 1):
            part = np.zeros(distance.shape, bool)
            part[tuple(inside[owner == k].T)] = True
            box = _box(part, int(part.sum()))
            if min(box[2], box[3]) >= 2 * self.min_radius_px:
                found.append(box)
        return found


def _without_holes(mask: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Petals with their stamens: small dark places inside are filled."""
    import cv2

    outlines, _ = cv2.findContours(mask, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_SIMPLE)
    filled = np.zeros_like(mask)
    cv2.drawContours(filled, outlines, -1, 1, cv2.FILLED)
    return filled


def _box(part: NDArray[np.bool_], area: int) -> tuple[float, float, float, float, float]:
    v, u = np.nonzero(part)
    w, h = float(np.ptp(u) + 1), float(np.ptp(v) + 1)
    roundness = min(1.0, area / (0.785 * w * h)) * min(w, h) / max(w, h)
    return float(u.min()) + (w - 1) / 2, float(v.min()) + (h - 1) / 2, w, h, roundness


def _sorted(rows: list[tuple[float, float, float, float, float]]) -> ImageDetections:
    table = np.array(sorted(rows, key=lambda row: -row[4]), dtype=float).reshape(-1, 5)
    return ImageDetections(table[:, :2], table[:, 2:4], table[:, 4])
