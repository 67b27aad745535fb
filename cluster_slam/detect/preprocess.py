"""Pictures as models want them, and boxes back in the picture's own pixels.

Pixel centres are at whole numbers: a place x in one picture is (x + 0.5) scale - 0.5 + offset in the other.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array

PAD = 114  # grey that YOLO's own letterbox fills with
IMAGENET_MEAN, IMAGENET_STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


@dataclass(frozen=True, slots=True)
class Scaling:
    """How big the picture is for the model, and what is done to its values."""

    width: int
    height: int
    keeps_aspect: bool  # letterbox, else stretched
    mean: tuple[float, ...] = (0.0, 0.0, 0.0)
    std: tuple[float, ...] = (1.0, 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Placement:
    """From the picture's pixels to the model's: scale and offset, for u and v."""

    scale: tuple[float, float]
    offset: tuple[float, float]

    def back(self, centres: Array, sizes: Array) -> tuple[Array, Array]:
        """Boxes (k, 2), (k, 2) of the model in the picture's pixels."""
        scale = np.array(self.scale)
        return (centres - self.offset + 0.5) / scale - 0.5, sizes / scale


def prepare(
    image: NDArray[np.uint8], scaling: Scaling, out: NDArray[np.float32] | None = None
) -> tuple[NDArray[np.float32], Placement]:
    """The tensor (1, 3, h, w), red green blue, of a picture (h, w, 3), blue green red.

    It is written into ``out`` where that has its shape: fresh memory costs several times what the numbers do.
    """
    import cv2

    height, width = image.shape[:2]
    if scaling.keeps_aspect:
        share = min(scaling.width / width, scaling.height / height)
        inner = (round(width * share), round(height * share))
    else:
        inner = (scaling.width, scaling.height)
    resized = image if inner == (width, height) else _resized(image, inner)
    left, top = (scaling.width - inner[0]) // 2, (scaling.height - inner[1]) // 2
    if inner != (scaling.width, scaling.height):
        right, bottom = scaling.width - inner[0] - left, scaling.height - inner[1] - top
        resized = cv2.copyMakeBorder(resized, top, bottom, left, right, cv2.BORDER_CONSTANT, value=(PAD,) * 3)
    shape = (1, 3, scaling.height, scaling.width)
    tensor = out if out is not None and out.shape == shape else np.empty(shape, np.float32)
    for plane, values, mean, std in zip(cv2.split(resized)[::-1], tensor[0], scaling.mean, scaling.std, strict=True):
        np.multiply(plane, np.float32(1.0 / (255.0 * std)), out=values)
        if mean:
            values -= np.float32(mean / std)
    placement = Placement((inner[0] / width, inner[1] / height), (float(left), float(top)))
    return tensor, placement


def _resized(image: NDArray[np.uint8], size: tuple[int, int]) -> NDArray[np.uint8]:
    import cv2

    smaller = size[0] < image.shape[1]
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA if smaller else cv2.INTER_LINEAR))


def preprocessor_config(model: Path) -> dict[str, Any]:
    """``preprocessor_config.json`` beside a model, or a folder above; empty where there is none.

    Raises
    ------
    InputError
        It is no JSON.
    """
    path = beside(model, "preprocessor_config.json")
    if path is None:
        return {}
    try:
        content = json.loads(path.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: {error}, expected JSON") from None
    if not isinstance(content, dict):
        raise InputError(f"{path}: {type(content).__name__}, expected a table")
    return content


def beside(model: Path, name: str) -> Path | None:
    """A file in a model's folder, or the one above (exports keep models in ``onnx/``)."""
    return next((path for folder in (model.parent, model.parent.parent) if (path := folder / name).is_file()), None)


def values_of(config: dict[str, Any], default: tuple[tuple[float, ...], tuple[float, ...]]) -> Scaling:
    """Mean, deviation and size of a preprocessor's configuration; sizes 0 where it has none."""
    mean, std = default
    if "do_normalize" in config or "image_mean" in config:
        is_normal = config.get("do_normalize", True)
        mean = tuple(config.get("image_mean", IMAGENET_MEAN)) if is_normal else (0.0, 0.0, 0.0)
        std = tuple(config.get("image_std", IMAGENET_STD)) if is_normal else (1.0, 1.0, 1.0)
    size = config.get("size", {})
    size = size if isinstance(size, dict) else {}
    return Scaling(int(size.get("width", 0)), int(size.get("height", 0)), False, mean, std)
