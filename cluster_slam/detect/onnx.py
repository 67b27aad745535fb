"""A detector that is an ONNX model: the only place that loads onnxruntime."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cluster_slam.detect import decode
from cluster_slam.detect.decode import RawBoxes
from cluster_slam.detect.preprocess import (
    IMAGENET_MEAN,
    IMAGENET_STD,
    Placement,
    Scaling,
    prepare,
    preprocessor_config,
    values_of,
)
from cluster_slam.detect.signature import Kind, Port, Signature, class_names, recognise
from cluster_slam.detect.text import Prompt, read_prompt
from cluster_slam.errors import ConfigError, InputError
from cluster_slam.geometry import Array
from cluster_slam.records import ImageDetections

_LONGEST = 1280  # side of a picture for a model of any size, px
_FLOWER_WORDS = ("flower", "blossom", "bloom")
_LEAST = {Kind.GROUNDING_DINO: 0.3, Kind.YOLO: 0.25, Kind.END_TO_END: 0.25}  # scores; others 0.4
_SIGMA = (0.7, 0.06)  # of a box's middle: pixels, and share of its size


def own_model() -> Path:
    """The detector that comes with the package."""
    return Path(str(files("cluster_slam.detect") / "models" / "flowers.onnx"))


def open_onnx(
    path: Path,
    *,
    prompt: str = "flower .",
    score: float | None = None,
    provider: str = "cpu",
    threads: int = 1,
) -> OnnxDetector:
    """A detector from a model's file; its kind follows from its signature.

    Raises
    ------
    InputError
        The file is missing, no ONNX, or of a kind that is not understood (the signature is shown).
    ConfigError
        The provider is not there.
    """
    session = _session(path, provider, threads)
    signature = Signature(
        path,
        tuple(Port(port.name, port.type, tuple(port.shape)) for port in session.get_inputs()),
        tuple(Port(port.name, port.type, tuple(port.shape)) for port in session.get_outputs()),
        dict(session.get_modelmeta().custom_metadata_map),
    )
    kind = recognise(signature)
    words = read_prompt(path, prompt) if kind is Kind.GROUNDING_DINO else None
    return OnnxDetector(session, signature, kind, words, score)


def _session(path: Path, provider: str, threads: int) -> Any:
    import onnxruntime

    if not path.is_file():
        raise InputError(f"{path}: {'is a folder' if path.is_dir() else 'missing'}, expected an ONNX model")
    by_name = {name.removesuffix("ExecutionProvider").lower(): name for name in onnxruntime.get_available_providers()}
    if provider.lower() not in by_name:
        raise ConfigError(f"provider {provider!r} is not there (known: {', '.join(sorted(by_name))})")
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads, options.inter_op_num_threads = threads, 1
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=[by_name[provider.lower()]])
    except Exception as error:  # onnxruntime's errors have no common base but this one
        text = " ".join(str(error).split())[:160]
        raise InputError(f"{path}: cannot be loaded ({text}), expected an ONNX model") from None


class OnnxDetector:
    """Flowers in pictures by an ONNX model."""

    def __init__(
        self, session: Any, signature: Signature, kind: Kind, prompt: Prompt | None, score: float | None
    ) -> None:
        """See :func:`open_onnx`."""
        self.kind, self.signature = kind, signature
        self._session, self._prompt = session, prompt
        self._config = preprocessor_config(signature.path)
        self._tensor: NDArray[np.float32] | None = None  # of the last picture
        self._classes = _flower_classes(signature, kind)
        stated = signature.metadata.get("score")
        self._least = score if score is not None else float(stated) if stated else _LEAST.get(kind, 0.4)
        self._sigma = _stated_sigma(signature)
        self._lean = float(signature.metadata.get("lean", "0"))

    def detect(self, image: NDArray[np.uint8]) -> ImageDetections:
        """Boxes of the flowers in a picture (h, w, 3), 8 bits, blue green red; best first."""
        scaling = self._scaling(image)
        tensor, placement = prepare(image, scaling, self._tensor)
        self._tensor = tensor
        raw = self._run(tensor, image, scaling)
        keep = raw.scores >= self._least
        if self._classes is not None:
            keep &= np.isin(raw.classes, self._classes)
        keep &= (raw.sizes > 0).all(1) & np.isfinite(raw.centres).all(1)
        kept = decode.suppressed(raw.take(keep))
        if self.kind is Kind.DETR_SIZES:  # pixels of the picture already
            placement = Placement((1.0, 1.0), (0.0, 0.0))
        corner = 0.0 if self._counts_from_middle else 0.5  # a box's edges count from the picture's corner
        centres, sizes = placement.back(kept.centres - corner, kept.sizes)
        return ImageDetections(centres, sizes, kept.scores)

    @property
    def lean(self) -> float:
        """How far its middles lie to where flowers face, as the model states it."""
        return self._lean

    def sigma_px(self, sizes: Array) -> Array:
        """Sigma (k,) of u and of v of the middles of boxes (k, 2), pixels."""
        sigma: Array = np.hypot(self._sigma[0], self._sigma[1] * np.sqrt(sizes.prod(1)))
        return sigma

    @property
    def _counts_from_middle(self) -> bool:
        return self.signature.metadata.get("pixel_origin") == "centre"

    def _scaling(self, image: NDArray[np.uint8]) -> Scaling:
        """How the model wants this picture."""
        plain = ((0.0, 0.0, 0.0), (1.0, 1.0, 1.0))
        is_normal = self.kind is Kind.GROUNDING_DINO or self.signature.output("dets") is not None
        values = values_of(self._config, (IMAGENET_MEAN, IMAGENET_STD) if is_normal else plain)
        height, width = self.signature.image.shape[2:4]
        keeps = self.kind in (Kind.YOLO, Kind.END_TO_END)
        if isinstance(height, int) and isinstance(width, int):
            return Scaling(width, height, keeps, values.mean, values.std)
        if values.width and values.height:
            return Scaling(values.width, values.height, keeps, values.mean, values.std)
        free = self._free_size(image, keeps)
        return Scaling(*free, keeps, values.mean, values.std)

    def _free_size(self, image: NDArray[np.uint8], keeps: bool) -> tuple[int, int]:
        """Width and height for a model that takes any: what it was trained at, else the picture's own."""
        stated = class_names(self.signature.metadata.get("imgsz", ""))  # height, width
        if stated or not keeps:
            side = int(stated.get(0, "640"))
            return int(stated.get(1, side)), side
        stride = int(self.signature.metadata.get("stride", "32"))
        height, width = image.shape[:2]
        share = min(1.0, _LONGEST / max(height, width))
        return -(-round(width * share) // stride) * stride, -(-round(height * share) // stride) * stride

    def _run(self, tensor: NDArray[np.float32], image: NDArray[np.uint8], scaling: Scaling) -> RawBoxes:
        """The model's candidates in pixels of its input."""
        given = self._session.run(None, self._feed(tensor, image))
        found = {port.name: value for port, value in zip(self.signature.outputs, given, strict=True)}
        width, height = scaling.width, scaling.height
        if self.kind is Kind.YOLO:
            return decode.yolo(given[0][0], self._least)
        if self.kind is Kind.END_TO_END:
            return decode.end_to_end(given[0][0])
        if self.kind is Kind.DETR_ROWS:
            return decode.shares(given[0][0, :, :4], given[0][0, :, 4:], width, height)
        if self.kind is Kind.DETR_SIZES:
            return decode.corners(
                found["boxes"][0].astype(float), found["scores"][0].astype(float), found["labels"][0].astype(float)
            )
        logits = found["logits"] if "logits" in found else found["labels"]
        boxes = found["pred_boxes"] if "pred_boxes" in found else found["dets"]
        scores = decode.sigmoid(logits[0])
        if self._prompt is not None:
            scores = scores[:, : len(self._prompt.is_word)][:, self._prompt.is_word]
        return decode.shares(boxes[0], scores, width, height)

    def _feed(self, tensor: NDArray[np.float32], image: NDArray[np.uint8]) -> dict[str, NDArray[Any]]:
        """All inputs that the model has, and no other."""
        names = {port.name for port in self.signature.inputs}
        is_half = "float16" in self.signature.image.kind
        feed: dict[str, NDArray[Any]] = {self.signature.image.name: tensor.astype(np.float16) if is_half else tensor}
        if "orig_target_sizes" in names:
            feed["orig_target_sizes"] = np.array([image.shape[1::-1]], np.int64)
        if "pixel_mask" in names:
            feed["pixel_mask"] = np.ones((1, *tensor.shape[2:]), np.int64)
        if self._prompt is not None:
            ids = self._prompt.ids
            words = {"input_ids": ids, "token_type_ids": np.zeros_like(ids), "attention_mask": np.ones_like(ids)}
            feed |= {name: value for name, value in words.items() if name in names}
        return feed


def _flower_classes(signature: Signature, kind: Kind) -> NDArray[np.int64] | None:
    """The classes that are flowers; None: all are.

    Raises
    ------
    InputError
        The model names its classes, and none is a flower.
    """
    names = signature.names
    if kind is Kind.GROUNDING_DINO or len(names) < 2:
        return None
    found = [k for k, name in sorted(names.items()) if any(word in name.lower() for word in _FLOWER_WORDS)]
    if not found:
        shown = ", ".join(list(names.values())[:8])
        raise InputError(f"{signature.path}: knows {len(names)} classes ({shown}), expected a flower among them")
    return np.array(found, np.int64)


def _stated_sigma(signature: Signature) -> tuple[float, float]:
    """What a model says of its boxes' middles (``sigma_px``: pixels, share of the size), else what is usual."""
    words = signature.metadata.get("sigma_px", "").split()
    return (float(words[0]), float(words[1])) if len(words) == 2 else _SIGMA
