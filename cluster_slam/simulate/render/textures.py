"""The atlas of patterns: what multiplies a facet's colour, by its local coordinates."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array
from cluster_slam.simulate.render.facets import Texture

SIZE = 128  # of one pattern, pixels
ONE = 160.0  # the value that leaves a colour as it is
_SEED = 20_260_504  # patterns are the same in all sessions


@lru_cache(maxsize=1)
def atlas() -> NDArray[np.uint8]:
    """Patterns (n, SIZE, SIZE, 3), rows along t and columns along s; ``ONE`` leaves a colour as it is."""
    rng = np.random.default_rng(_SEED)
    s, t = np.meshgrid((np.arange(SIZE) + 0.5) / SIZE, (np.arange(SIZE) + 0.5) / SIZE)
    made = {
        Texture.PLAIN: 1.0 + 0.15 * clouds(rng, 12),
        Texture.LEAF: _leaf(s, t, rng),
        Texture.PETAL: _petal(s, t - 0.5, rng),
        Texture.STEM: (0.55 + 0.6 * np.sqrt(np.maximum(1 - (2 * (t - 0.5)) ** 2, 0))) * (1 + 0.2 * clouds(rng, 16)),
        Texture.STAMENS: _stamens(s - 0.5, t - 0.5, rng),
        Texture.BACKDROP: _backdrop(rng),
        Texture.BERRY: 1.35 - 2.2 * ((s - 0.5) ** 2 + (t - 0.5) ** 2) + 0.1 * clouds(rng, 8),
        Texture.PALE_LEAF: 0.9 + 0.12 * clouds(rng, 14) - 0.2 * (np.abs(t) < 0.05),
    }
    full = [np.broadcast_to(p[..., None] if p.ndim == 2 else p, (SIZE, SIZE, 3)) for _, p in sorted(made.items())]
    return np.clip(np.stack(full) * ONE, 0, 255).astype(np.uint8)


def clouds(rng: np.random.Generator, cells: int) -> Array:
    """Smooth noise (SIZE, SIZE) of several octaves, about unit sigma, that continues over the border."""
    total = np.zeros((SIZE, SIZE))
    fx, fy = np.meshgrid(np.fft.fftfreq(SIZE), np.fft.fftfreq(SIZE))
    f = np.hypot(fx, fy) * SIZE
    shape = np.where((f > 0) & (f < cells * 4), 1.0 / (f + cells / 4), 0.0)
    total = np.fft.ifft2(np.fft.fft2(rng.normal(size=(SIZE, SIZE))) * shape).real
    smooth: Array = total / total.std()
    return smooth


def _leaf(s: Array, t: Array, rng: np.random.Generator) -> Array:
    """Half a leaf: midrib at t = 0, side veins that leave it at an angle, blotches."""
    phase = (s - 0.55 * t) * 8.0
    vein = np.exp(-((((phase + 0.5) % 1.0) - 0.5) ** 2) / 0.006)
    rib = np.exp(-(t**2) / 0.002)
    bulge = 0.10 * np.cos(2 * np.pi * phase)
    value = 1.0 - bulge + 0.10 * clouds(rng, 10) + 0.28 * vein * (1 - t) + 0.5 * rib
    return np.stack([value, value, value * (1 + 0.08 * clouds(rng, 6))], axis=-1)


def _petal(s: Array, t: Array, rng: np.random.Generator) -> Array:
    """Greenish and darker at the base, fine lines along, a soft shade towards the sides."""
    lines = 0.03 * np.sin(40 * np.arctan2(t, s + 0.1)) + 0.02 * clouds(rng, 10)
    value = 0.72 + 0.38 * np.minimum(s / 0.6, 1.0) - 0.9 * t**2 - 0.25 * np.maximum(s - 0.85, 0.0) / 0.15 + lines
    base = np.exp(-((s / 0.22) ** 2))
    return np.stack([value - 0.25 * base, value, value - 0.12 * base], axis=-1)


def _stamens(s: Array, t: Array, rng: np.random.Generator) -> Array:
    """A green middle and a ring of anthers."""
    r, angle = np.hypot(s, t), np.arctan2(t, s)
    dots = 0.5 + 0.5 * np.sin(22 * angle + 5 * np.sin(30 * r))
    value = 0.85 + 0.35 * dots * (r > 0.2) + 0.1 * clouds(rng, 20)
    middle = np.exp(-((r / 0.17) ** 2))
    return np.stack([value * (1 + 0.5 * middle), value, value * (1 - 0.35 * middle)], axis=-1)


def _backdrop(rng: np.random.Generator) -> Array:
    """Leaves, gaps and light far behind, out of focus."""
    value = np.exp(0.4 * clouds(rng, 5) + 0.12 * clouds(rng, 12))
    tint = clouds(rng, 4)
    return np.stack([value * (1 - 0.12 * tint), value, value * (1 + 0.12 * tint)], axis=-1) * 0.9
