"""The colour camera: blur of lens and motion, exposure, noise, eight bits."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array
from cluster_slam.simulate.render.config import LookConfig
from cluster_slam.simulate.render.raster import Float32

_LEVELS = 4096  # steps of the tone curve
_BRIGHTEST = 1.6  # linear value that saturates for good
_POOL = 1 << 22


def photograph(
    linear: Float32, look: LookConfig, light: float, flow_px: Array, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """The picture (h, w, 3), 8 bits, blue green red.

    Parameters
    ----------
    linear
        (h, w, 3) light.
    light
        Strength of this instant's light.
    flow_px
        (2,) how far the picture moves during the exposure.
    """
    import cv2

    image = cv2.GaussianBlur(linear, (0, 0), max(look.blur_px, 0.3))
    kernel = _streak(flow_px)
    if kernel is not None:
        image = cv2.filter2D(image, -1, kernel)
    image *= np.float32(1.25 * look.exposure * light)
    if look.noise > 0:
        pool = noise_pool()
        start = int(rng.integers(0, _POOL - image.size))
        noise = pool[start : start + image.size].reshape(image.shape)
        sigma = np.sqrt(image * np.float32(4e-4 * look.noise**2) + np.float32((0.006 * look.noise) ** 2))
        image += noise * sigma
    step = np.clip(image * np.float32((_LEVELS - 1) / _BRIGHTEST), 0, _LEVELS - 1).astype(np.uint16)
    picture: NDArray[np.uint8] = _tone()[step]
    return picture


@lru_cache(maxsize=1)
def noise_pool() -> Float32:
    """Standard normal numbers, drawn once: pictures take stretches of them."""
    return np.random.default_rng(7).standard_normal(_POOL, dtype=np.float32)


@lru_cache(maxsize=1)
def _tone() -> NDArray[np.uint8]:
    """The sRGB curve with a soft shoulder, for linear values up to ``_BRIGHTEST``."""
    x = np.linspace(0.0, _BRIGHTEST, _LEVELS)
    x = np.where(x < 0.7, x, 0.7 + 0.3 * np.tanh((x - 0.7) / 0.42))
    srgb = np.where(x < 0.0031308, 12.92 * x, 1.055 * x ** (1 / 2.4) - 0.055)
    table: NDArray[np.uint8] = np.clip(np.rint(srgb * 255), 0, 255).astype(np.uint8)
    return table


def _streak(flow_px: Array) -> Float32 | None:
    """A kernel that blurs along the motion, symmetric about the middle of the exposure; None below half a pixel."""
    length = float(np.hypot(*flow_px))
    if length < 0.5:
        return None
    half = int(np.ceil(min(length, 40.0) / 2)) + 1
    kernel = np.zeros((2 * half + 1, 2 * half + 1), np.float32)
    for share in np.linspace(-0.5, 0.5, 8 * half + 1):
        u, v = half + share * flow_px * min(1.0, 40.0 / length)
        i, j = int(v), int(u)
        a, b = v - i, u - j
        kernel[i, j] += (1 - a) * (1 - b)
        kernel[i + 1, j] += a * (1 - b)
        kernel[i, j + 1] += (1 - a) * b
        kernel[i + 1, j + 1] += a * b
    unit: Float32 = kernel / kernel.sum()
    return unit
