"""A crop as it may also look: turned, scaled, before another backdrop, in other light."""

from __future__ import annotations

import cv2
import numpy as np
from backdrops import add_pale_things, backdrop
from numpy.typing import NDArray
from pictures import SEEN, Example

Float32 = NDArray[np.float32]
_PALE = 0.3  # share of crops with pale things that are no flowers


def plain(
    example: Example, size: int, zoom: tuple[float, float], rng: np.random.Generator
) -> tuple[Float32, NDArray[np.float32]]:
    """A crop (3, size, size), red green blue, 0..1, and its boxes, in its own light."""
    image, behind, boxes = _placed(example, size, zoom, rng)
    image, _, boxes = _turned(image, behind, boxes, rng)
    return np.ascontiguousarray(image[:, :, ::-1].transpose(2, 0, 1), np.float32) / np.float32(255.0), boxes


def altered(
    example: Example, size: int, zoom: tuple[float, float], rng: np.random.Generator, *, other: float
) -> tuple[Float32, NDArray[np.float32]]:
    """A crop (3, size, size), red green blue, 0..1, and its boxes; a share ``other`` has another backdrop."""
    image, behind, boxes = _placed(example, size, zoom, rng)
    image, behind, boxes = _turned(image, behind, boxes, rng)
    x = image[:, :, ::-1].astype(np.float32) / 255.0
    if rng.random() < other:
        far = cv2.GaussianBlur(behind.astype(np.float32), (0, 0), rng.uniform(0.3, 0.9))[..., None]
        x = x * np.float32(rng.uniform(0.3, 1.1)) if rng.random() < 0.4 else x  # against the light
        x = x * (1 - far) + backdrop(size, rng) * far
    if rng.random() < _PALE:
        x = np.ascontiguousarray(x)
        add_pale_things(x, boxes, rng)
    return _recoloured(x, rng), boxes


def _placed(
    example: Example, size: int, zoom: tuple[float, float], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float32]]:
    """Another part of the crop at another scale."""
    image, behind, boxes = example.image, example.is_backdrop, example.boxes.copy()
    cut = len(image)
    side = min(int(size / np.exp(rng.uniform(*np.log(zoom)))), cut) if rng.random() < 0.6 else size
    low = rng.integers(0, cut - side + 1, 2)
    inside = boxes[(boxes[:, 4] > SEEN) & (np.abs(boxes[:, :2] - cut / 2) < cut / 2).all(1), :2]
    if len(inside) and rng.random() < 0.85:
        place = inside[rng.integers(len(inside))] - rng.uniform(0.1, 0.9, 2) * side
        low = np.clip(np.rint(place), 0, cut - side).astype(int)
    image = image[low[1] : low[1] + side, low[0] : low[0] + side]
    behind = behind[low[1] : low[1] + side, low[0] : low[0] + side]
    boxes[:, :2] -= low
    if side != size:
        scale = size / side
        image = cv2.resize(image, (size, size), interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        behind = cv2.resize(behind.astype(np.uint8), (size, size), interpolation=cv2.INTER_NEAREST).astype(bool)
        boxes[:, :2] = (boxes[:, :2] + 0.5) * scale - 0.5
        boxes[:, 2:4] *= scale
    return image, behind, boxes


def _turned(
    image: NDArray[np.uint8], behind: NDArray[np.bool_], boxes: NDArray[np.float32], rng: np.random.Generator
) -> tuple[NDArray[np.uint8], NDArray[np.bool_], NDArray[np.float32]]:
    """Mirrored and turned by quarters."""
    last = len(image) - 1
    if rng.random() < 0.5:
        image, behind = image[:, ::-1], behind[:, ::-1]
        boxes[:, 0] = last - boxes[:, 0]
    if rng.random() < 0.5:
        image, behind = image[::-1], behind[::-1]
        boxes[:, 1] = last - boxes[:, 1]
    if rng.random() < 0.5:
        image, behind = image.transpose(1, 0, 2), behind.T
        boxes[:, :4] = boxes[:, [1, 0, 3, 2]]
    return image, behind, boxes


def _recoloured(x: Float32, rng: np.random.Generator) -> Float32:
    """Another white balance, contrast, saturation, gamma, sharpness; (3, s, s)."""
    saturation = rng.uniform(0.4, 1.6)
    balance = rng.uniform(0.85, 1.15, 3)
    mixed = cv2.transform(x, balance[:, None] * (saturation * np.eye(3) + (1 - saturation) / 3))
    tone = (np.arange(256) / 255.0) ** np.exp(rng.normal(0.0, 0.3)) * rng.uniform(0.6, 1.3) + rng.normal(0.0, 0.04)
    x = cv2.LUT(np.clip(255.0 * mixed, 0, 255).astype(np.uint8), tone.astype(np.float32))
    if rng.random() < 0.2:
        x = cv2.GaussianBlur(x, (0, 0), rng.uniform(0.3, 1.2))
    if rng.random() < 0.3:
        x = x + np.float32(rng.uniform(0.005, 0.04)) * rng.standard_normal(x.shape, np.float32)
    return np.ascontiguousarray(np.clip(x, 0.0, 1.0).transpose(2, 0, 1), np.float32)
