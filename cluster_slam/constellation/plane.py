"""Flat constellations: landmarks in one plane are matched in it, as three dimensions would allow a mirrored twin."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, inverse, transform

FLAT_SIGMAS = 1.5  # flat: spread across the plane below so many sigmas of a point ...
FLAT_SHARE = 0.01  # ... or below this share of the spread along it


def is_flat(points: Array, sigma: float) -> bool:
    """Whether points (n, 3) lie in one plane, as far as their sigma lets one see."""
    if len(points) < 3:
        return False
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(points.T)), 0.0))
    return bool(spread[0] < max(FLAT_SIGMAS * sigma, FLAT_SHARE * spread[2]))


def plane_frame(points: Array, viewpoint: Array | None, *, flipped: bool = False) -> Array:
    """T_plane_frame (4, 4): origin in the middle of points (n, 3), z across the plane towards the camera.

    Where no viewpoint is known the side is arbitrary; ``flipped`` gives the other one.
    """
    middle = points.mean(axis=0)
    _, _, Vt = np.linalg.svd(points - middle, full_matrices=False)
    normal = Vt[2]
    away = normal if viewpoint is None else viewpoint - middle
    if normal @ away < 0:
        normal = -normal
    if flipped:
        normal = -normal
    x = Vt[0]
    R = np.stack([x, np.cross(normal, x), normal])
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, -R @ middle
    return T


@dataclass(frozen=True, slots=True, eq=False)
class Space:
    """The space that is matched in: all of it, or two planes laid on one another."""

    d: int
    T_space_world: Array  # (4, 4)
    T_space_map: Array  # (4, 4)

    def session(self, points: Array) -> Array:
        """Points (n, 3) of the session in the space (n, d)."""
        return transform(self.T_space_world, points)[:, : self.d]

    def plant(self, points: Array) -> Array:
        """Points (n, 3) of the map in the space (n, d)."""
        return transform(self.T_space_map, points)[:, : self.d]

    def to_map(self, R: Array, t: Array, scale: float) -> Array:
        """T_map_world (4, 4) of a similarity found in the space: p_map = T_map_world * (scale * p_world)."""
        S = np.eye(4)
        S[: self.d, : self.d] = scale * R
        S[2, 2] = scale if self.d == 2 else S[2, 2]
        S[: self.d, 3] = t
        M = inverse(self.T_space_map) @ S @ self.T_space_world
        T = M.copy()
        T[:3, :3] = M[:3, :3] / scale
        return T


def spaces(
    session: Array, plant: Array, sigma: float, view_session: Array | None, view_plant: Array | None
) -> list[Space]:
    """The spaces to match in: one; two (mirrored) where both are flat and a side is not known."""
    if not (is_flat(session, sigma) and is_flat(plant, sigma)):
        return [Space(3, np.eye(4), np.eye(4))]
    T_map = plane_frame(plant, view_plant)
    known = view_session is not None and view_plant is not None
    sides = [False] if known else [False, True]
    return [Space(2, plane_frame(session, view_session, flipped=side), T_map) for side in sides]
