"""What else may stand behind a plant or beside its flowers: sky, gravel, walls, nets, labels; pale things of all kinds.

Renderings have one kind of backdrop. A detector that has seen nothing else takes pebbles and gaps of bright sky for
flowers.
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Float32 = NDArray[np.float32]


def backdrop(size: int, rng: np.random.Generator) -> Float32:
    """A picture (size, size, 3) in 0..1, of one kind or of two that meet along a line."""
    first = _one(size, rng)
    if rng.random() < 0.5:
        return first
    y, x = np.mgrid[:size, :size].astype(np.float32) / size - 0.5
    angle, shift = rng.uniform(0, 2 * np.pi), rng.uniform(-0.3, 0.3)
    beyond = np.cos(angle) * x + np.sin(angle) * y > shift
    return np.where(beyond[..., None], _one(size, rng), first)


def _one(size: int, rng: np.random.Generator) -> Float32:
    kinds = (_sky, _gravel, _clouds, _net, _label, _walls)
    return kinds[rng.integers(len(kinds))](size, rng)


def _colour(rng: np.random.Generator, strong: float = 0.15) -> Float32:
    """Mostly grey, of any brightness."""
    return np.clip(rng.uniform(0.05, 1.0) * (1 + rng.normal(0.0, strong, 3)), 0, 1).astype(np.float32)


def _noise(size: int, cell: float, rng: np.random.Generator, channels: int = 1) -> Float32:
    """Normal noise of cells of so many pixels, smooth between them."""
    n = max(int(np.ceil(size / cell)), 2)
    small = rng.normal(size=(n, n, channels)).astype(np.float32)
    return cv2.resize(small, (size, size), interpolation=cv2.INTER_LINEAR).reshape(size, size, channels)


def _sky(size: int, rng: np.random.Generator) -> Float32:
    return np.clip(rng.uniform(0.75, 1.1) + 0.15 * _noise(size, size / 3, rng, 3), 0, 1)


def _gravel(size: int, rng: np.random.Generator) -> Float32:
    grains = _noise(size, rng.uniform(1.5, 9.0), rng) + 0.6 * _noise(size, 2.0, rng)
    return np.clip(_colour(rng) * (1 + rng.uniform(0.15, 0.6) * grains), 0, 1)


def _clouds(size: int, rng: np.random.Generator) -> Float32:
    total = sum(_noise(size, size / n, rng, 3) * (1.5 / np.sqrt(n)) for n in (3, 7, 17))
    return np.clip(_colour(rng, 0.4) * np.exp(0.4 * total), 0, 1).astype(np.float32)


def _net(size: int, rng: np.random.Generator) -> Float32:
    y, x = np.mgrid[:size, :size].astype(np.float32)
    made = np.ones((size, size), bool)
    for _ in range(rng.integers(1, 3)):
        angle, period = rng.uniform(0, np.pi), rng.uniform(5, 40)
        made &= ((np.cos(angle) * x + np.sin(angle) * y) / period) % 1.0 > rng.uniform(0.15, 0.6)
    return np.where(made[..., None], _colour(rng), _colour(rng))


def _label(size: int, rng: np.random.Generator) -> Float32:
    cell = int(rng.integers(3, 13))
    bits = (rng.random((size // cell + 1,) * 2) < 0.5).repeat(cell, 0).repeat(cell, 1)[:size, :size]
    return np.where(bits[..., None], _colour(rng, 0.05), 0.15 * _colour(rng, 0.05))


def _walls(size: int, rng: np.random.Generator) -> Float32:
    image = np.ascontiguousarray(np.broadcast_to(_colour(rng), (size, size, 3)))
    for _ in range(rng.integers(2, 9)):
        corners = (rng.normal(rng.uniform(0, 1, 2), rng.uniform(0.05, 0.5), (4, 2)) * size).astype(np.int32)
        cv2.fillConvexPoly(image, cv2.convexHull(corners), _colour(rng).tolist(), cv2.LINE_AA)
    for _ in range(rng.integers(0, 5)):
        a, b = (rng.uniform(-0.2, 1.2, (2, 2)) * size).astype(int)
        cv2.line(image, a.tolist(), b.tolist(), _colour(rng).tolist(), int(rng.integers(1, 7)), cv2.LINE_AA)
    return image


def add_pale_things(image: Float32, boxes: NDArray[np.float32], rng: np.random.Generator) -> None:
    """Draw pale discs, scraps and strips, none of them a flower, clear of the flowers (k, 5)."""
    size = image.shape[0]
    for _ in range(rng.integers(1, 7)):
        place, reach = rng.uniform(0, size, 2), np.exp(rng.uniform(np.log(2.0), np.log(22.0)))
        away = np.abs(boxes[:, :2] - place) - boxes[:, 2:4] / 2 - 1.3 * reach
        if (away < 0).all(1).any():
            continue
        pale = np.clip(rng.uniform(0.55, 1.1) * (1 + rng.normal(0.0, 0.06, 3)), 0, 1)
        if rng.random() < 0.4:
            axes = (1000, int(rng.uniform(300, 1000)))
            outline = cv2.ellipse2Poly((0, 0), axes, int(rng.integers(180)), 0, 360, 20)
            corners = outline / 1000 * reach
        else:
            corners = cv2.convexHull(rng.uniform(-1, 1, (int(rng.integers(3, 6)), 2)).astype(np.float32))[:, 0] * reach
        fixed = np.rint((place + corners) * 8).astype(np.int32)
        cv2.fillPoly(image, [fixed], pale.tolist(), cv2.LINE_AA, 3)
