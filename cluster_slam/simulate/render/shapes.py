"""Outlines of petals, leaves and their like, in local coordinates: s along, t across."""

from __future__ import annotations

import numpy as np

from cluster_slam.geometry import Array

_PETAL_S = np.array([0.04, 0.30, 0.62, 0.86, 0.99])
_PETAL_T = np.array([0.06, 0.30, 0.47, 0.44, 0.16])
HALF_LEAF = np.array(
    [
        [0.0, 0.0], [0.07, 0.30], [0.20, 0.66], [0.25, 0.62], [0.37, 0.93], [0.43, 0.87],
        [0.55, 0.97], [0.61, 0.85], [0.74, 0.74], [0.79, 0.60], [0.91, 0.33], [1.0, 0.0],
    ]
)  # fmt: skip
SEPAL = np.array([[0.0, -0.3], [0.35, -0.5], [1.0, 0.0], [0.35, 0.5], [0.0, 0.3]])
SQUARE = np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]])


def petal(rng: np.random.Generator) -> Array:
    """An outline (11, 2) of a petal, no two alike: s 0 at the flower's centre, 1 at the tip; t from -0.5 to 0.5."""
    s = _PETAL_S + rng.normal(0.0, 0.015, 5)
    left, right = _PETAL_T * rng.normal(1.0, 0.06, (2, 5))
    outward = np.column_stack([s, -left])
    back = np.column_stack([s + rng.normal(0.0, 0.02, 5), right])[::-1]
    notch = np.array([[0.95 + rng.normal(0.0, 0.03), rng.normal(0.0, 0.03)]])
    return np.concatenate([outward, notch, back])


def half_leaf(rng: np.random.Generator) -> Array:
    """A serrated outline (12, 2) of half a leaf: s along the midrib, t from 0 there to 1."""
    jitter = rng.normal(0.0, 0.03, HALF_LEAF.shape)
    jitter[[0, -1]] = 0.0
    return HALF_LEAF + jitter


def disc(rng: np.random.Generator, n: int = 9) -> Array:
    """A rough disc (n, 2) of radius 0.5 about 0, 0."""
    angle = np.arange(n) * 2 * np.pi / n + rng.uniform(0, 1)
    radius = 0.5 * rng.normal(1.0, 0.06, n)
    return np.column_stack([np.cos(angle), np.sin(angle)]) * radius[:, None]


def frame_about(direction: Array, rng: np.random.Generator) -> tuple[Array, Array, Array]:
    """Unit vectors: the direction, and two across it, turned at random about it."""
    normal = direction / np.linalg.norm(direction)
    across = np.cross(normal, rng.normal(size=3))
    across /= np.linalg.norm(across)
    return normal, across, np.cross(normal, across)
