"""From facets to pixels: which facet each pixel shows, and where on it.

Facets are painted from far to near, each as its number. What a pixel shows follows from that number alone: a facet
``origin + s e1 + t e2`` is seen along the ray (x, y, 1) where [e1 e2 origin] (s, t, 1)' = z (x, y, 1)', so that the
inverse of that matrix, applied to (x, y, 1)', is (s, t, 1)' / z.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array, so3_exp
from cluster_slam.records import IntArray
from cluster_slam.sensors.camera import Camera
from cluster_slam.simulate.render.facets import Facets

Float32 = NDArray[np.float32]
_SHIFT = 3  # fractional bits of a corner's place
_NEAR_M = 0.02
_FAR_PX = 4000.0  # corners beyond are cut off there: OpenCV's coordinates are 16.16


@dataclass(frozen=True, slots=True, eq=False)
class Placed:
    """Facets at one instant in one frame."""

    index: IntArray  # (k,) which of the scene's facets
    origins: Array  # (k, 3)
    e1: Array  # (k, 3)
    e2: Array  # (k, 3)


@dataclass(frozen=True, slots=True, eq=False)
class Rays:
    """The directions of all pixels, computed once for a camera."""

    camera: Camera
    x: Float32  # (h, w)
    y: Float32  # (h, w)


@dataclass(frozen=True, slots=True, eq=False)
class Painted:
    """What each pixel shows."""

    facet: NDArray[np.int32]  # (h, w) index into ``placed``, -1 nothing
    s: Float32  # (h, w)
    t: Float32  # (h, w)
    z: Float32  # (h, w) depth, m, inf where there is nothing


def rays_of(camera: Camera) -> Rays:
    """Normalised coordinates of all pixels, without distortion."""
    height, width = camera.height or 480, camera.width or 640
    v, u = np.mgrid[:height, :width]
    xy, _ = camera.normalise(np.column_stack([u.ravel(), v.ravel()]).astype(float))
    x, y = xy.T.astype(np.float32).reshape(2, height, width)
    return Rays(camera, np.ascontiguousarray(x), np.ascontiguousarray(y))


def moved(facets: Facets, centroids: Array, displacements: Array, rotations: Array | None) -> Placed:
    """All facets in the world at one instant.

    Parameters
    ----------
    facets
        At rest.
    centroids
        (c, 3) of the clusters, about which they turn.
    displacements
        (b, 3) of all bodies: clusters, then leaves.
    rotations
        (c, 3) rotation vectors of the clusters; None: none turns.
    """
    still = np.concatenate([displacements, np.zeros((1, 3))])[facets.bodies]
    first, last = facets.weights[:, :1] * still, facets.weights[:, 1:] * still
    origins, e1, e2 = facets.origins + first, facets.e1 + (last - first), facets.e2
    if rotations is not None:
        turns = (facets.flowers >= 0).nonzero()[0]
        body = facets.bodies[turns]
        R = so3_exp(rotations)[body]
        pivot = centroids[body]
        e1, e2 = e1.copy(), e2.copy()
        arm = facets.origins[turns] - pivot
        origins[turns] += (R @ arm[..., None])[..., 0] - arm
        e1[turns] = (R @ e1[turns, :, None])[..., 0]
        e2[turns] = (R @ e2[turns, :, None])[..., 0]
    return Placed(np.arange(len(facets)), origins, e1, e2)


def seen_from(facets: Facets, placed: Placed, T_view_world: Array) -> Placed:
    """Facets in a viewer's frame, strips turned to it (it sits at the origin)."""
    R, t = T_view_world[:3, :3], T_view_world[:3, 3]
    origins, e1, e2 = placed.origins @ R.T + t, placed.e1 @ R.T, placed.e2 @ R.T
    strip = facets.is_strip[placed.index]
    across = np.cross(e1[strip], origins[strip])
    wide = facets.e2[placed.index[strip], :1]
    e2[strip] = wide * across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    return Placed(placed.index, origins, e1, e2)


def paint(facets: Facets, seen: Placed, rays: Rays) -> tuple[Placed, Painted]:
    """Paint what a camera sees; the facets that are in view, and what each pixel shows of them."""
    corners = _corners(facets, seen)
    near, far = corners[..., 2].min(1), corners[..., 2].mean(1)
    z = np.maximum(corners[..., 2], _NEAR_M)
    pixels = rays.camera.project(np.stack([corners[..., 0], corners[..., 1], z], axis=-1).reshape(-1, 3)).reshape(
        *z.shape, 2
    )
    pixels = np.clip(pixels, -_FAR_PX, _FAR_PX)
    height, width = rays.x.shape
    low, high = pixels.min(1), pixels.max(1)
    inside = (high > -0.5).all(1) & (low[:, 0] < width - 0.5) & (low[:, 1] < height - 0.5) & (near > _NEAR_M)
    order = np.flatnonzero(inside)
    order = order[np.argsort(-far[order], kind="stable")]
    kept = Placed(seen.index[order], seen.origins[order], seen.e1[order], seen.e2[order])
    number = _fill(pixels[order], (height, width))
    return kept, _where(kept, number, rays)


def _corners(facets: Facets, seen: Placed) -> Array:
    """Corners (k, N_CORNERS, 3) of all outlines."""
    outline = facets.outlines[seen.index]
    corners: Array = seen.origins[:, None] + outline[..., :1] * seen.e1[:, None] + outline[..., 1:] * seen.e2[:, None]
    return corners


def _fill(pixels: Array, shape: tuple[int, int]) -> NDArray[np.int32]:
    """The number of the last outline (k, n, 2) that covers each pixel."""
    import cv2

    number = np.full(shape, -1, np.int32)
    fixed = np.rint(pixels * (1 << _SHIFT)).astype(np.int32)
    for k, outline in enumerate(fixed):
        cv2.fillPoly(number, [outline], k, cv2.LINE_8, _SHIFT)
    return number


def _where(kept: Placed, number: NDArray[np.int32], rays: Rays) -> Painted:
    """Local coordinates and depth of each pixel on its facet."""
    M = np.stack([kept.e1, kept.e2, kept.origins], axis=2)
    with np.errstate(all="ignore"):
        H = _inverse3(M)
    H = np.concatenate([np.where(np.isfinite(H), H, 0.0), np.zeros((1, 3, 3))]).astype(np.float32)
    rows = H.reshape(-1, 9).T.copy()  # one contiguous table a coefficient
    flat, x, y = number.ravel(), rays.x.ravel(), rays.y.ravel()
    w = rows[6][flat] * x + rows[7][flat] * y + rows[8][flat]
    with np.errstate(divide="ignore"):
        z = np.where(w > 1e-4, 1.0 / w, np.inf).astype(np.float32)
    depth = np.where(np.isfinite(z), z, 0.0).astype(np.float32)
    s = (rows[0][flat] * x + rows[1][flat] * y + rows[2][flat]) * depth
    t = (rows[3][flat] * x + rows[4][flat] * y + rows[5][flat]) * depth
    shape = number.shape
    return Painted(number, s.reshape(shape), t.reshape(shape), z.reshape(shape))


def _inverse3(M: Array) -> Array:
    """Inverses of (k, 3, 3) by cross products; not finite where a facet is seen edge-on."""
    a, b, c = M[..., 0], M[..., 1], M[..., 2]
    rows = np.stack([np.cross(b, c), np.cross(c, a), np.cross(a, b)], axis=1)
    determinant = (a * rows[:, 0]).sum(1)
    inverse: Array = rows / determinant[:, None, None]
    return inverse
