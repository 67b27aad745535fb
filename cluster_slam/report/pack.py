"""Arrays as base64 in JSON, and positions as 16-bit steps of a box: what keeps the page small."""

from __future__ import annotations

import base64
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array

OUTSIDE = -32768  # the step of a position outside the box; not drawn
_STEPS = 32000


def pack(array: NDArray[np.generic], dtype: str) -> dict[str, object]:
    """JSON of an array as little-endian bytes: ``t`` type (``u1 u2 u4 i2 f4``), ``s`` shape, ``b`` base64."""
    data = np.ascontiguousarray(array, dtype=np.dtype(dtype).newbyteorder("<"))
    return {"t": dtype, "s": list(data.shape), "b": base64.b64encode(data.tobytes()).decode("ascii")}


@dataclass(frozen=True, slots=True, eq=False)
class Box:
    """A cube of the world, divided into 2 x 32,000 steps an axis."""

    centre: Array  # (3,)
    half: float  # m, half its side

    def steps(self, points: Array) -> NDArray[np.int16]:
        """Positions (n, 3) as steps; ``OUTSIDE`` in all three where a point is outside or not finite."""
        scaled = (points - self.centre) / self.half
        inside = (np.abs(scaled) <= 1.0).all(-1)
        out = np.full(points.shape, OUTSIDE, dtype=np.int16)
        out[inside] = np.round(scaled[inside] * _STEPS).astype(np.int16)
        return out

    def as_json(self) -> dict[str, object]:
        """Centre and size of a step."""
        return {"centre": self.centre.tolist(), "step": self.half / _STEPS}


def box_around(points: Array, margin: float = 0.25) -> Box:
    """The cube that holds all points (n, 3), with a margin as a share of its size."""
    points = points[np.isfinite(points).all(-1)]
    if not len(points):
        return Box(np.zeros(3), 1.0)
    low, high = points.min(0), points.max(0)
    half = float((high - low).max()) / 2 * (1 + margin)
    return Box((low + high) / 2, max(half, 1e-3))


def upper(covs: Array) -> list[list[float]]:
    """Upper triangles (xx, xy, xz, yy, yz, zz) of covariances (n, 3, 3), seven digits."""
    rows = covs[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return [[float(f"{v:.6g}") for v in row] for row in rows]


def rounded(values: Array, decimals: int = 6) -> list[object]:
    """Nested lists with so many decimals (default: micrometres)."""
    out: list[object] = np.round(values, decimals).tolist()
    return out
