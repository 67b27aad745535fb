"""Depth of one camera in the pixels of another: each depth pixel is lifted, moved and projected; the nearest wins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array, transform
from cluster_slam.records import IntArray
from cluster_slam.sensors.camera import Camera


@dataclass(frozen=True, slots=True, eq=False)
class Registration:
    """From the depth camera to the colour camera."""

    depth: Camera
    colour: Camera
    T_colour_depth: Array  # (4, 4)
    scale: float  # m per unit

    def __call__(self, image: NDArray[np.uint16]) -> NDArray[np.uint16]:
        """The depth image (h, w) in the colour camera's pixels, 0 where nothing falls, in the same unit."""
        v, u = np.nonzero(image)
        xy, _ = self.depth.normalise(np.stack([u, v], axis=1).astype(float))
        z = image[v, u].astype(float) * self.scale
        points = transform(self.T_colour_depth, np.column_stack([xy * z[:, None], z]))
        points = points[(points[:, 2] > 0) & np.isfinite(points).all(axis=1)]
        pixels = self.colour.project(points)
        half = 0.5 * np.array([self.colour.fx / self.depth.fx, self.colour.fy / self.depth.fy])
        low = np.ceil(pixels - half - 1e-9).astype(int)
        high = np.maximum(np.ceil(pixels + half - 1e-9).astype(int) - 1, low)
        units = np.minimum(np.rint(points[:, 2] / self.scale), 65535).astype(np.int64)
        return self._splat(low, high, units).astype(np.uint16)

    def _splat(self, low: IntArray, high: IntArray, units: IntArray) -> IntArray:
        """The nearest of all that cover a pixel; each covers the footprint of its own pixel, low to high."""
        width, height = int(self.colour.width or 0), int(self.colour.height or 0)
        empty = np.iinfo(np.int64).max
        out = np.full((height, width), empty)
        spans = (high - low).max(axis=0, initial=0) if len(low) else np.zeros(2, int)
        for dx in range(int(spans[0]) + 1):
            for dy in range(int(spans[1]) + 1):
                at = low + np.array([dx, dy])
                ok = (at <= high).all(axis=1) & (at >= 0).all(axis=1) & (at < [width, height]).all(axis=1)
                np.minimum.at(out, (at[ok, 1], at[ok, 0]), units[ok])
        out[out == empty] = 0
        return out
