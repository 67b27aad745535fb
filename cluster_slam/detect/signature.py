"""Which kind of detector an ONNX model is, by the names and shapes of what goes in and out."""

from __future__ import annotations

import ast
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import Enum, auto
from pathlib import Path

from cluster_slam.errors import InputError


class Kind(Enum):
    """Detectors whose outputs are understood."""

    YOLO = auto()  # (1, 4 + classes, cells): cx cy w h in pixels of the input, scores; overlaps are ours to remove
    END_TO_END = auto()  # (1, n, 6): x1 y1 x2 y2 score class, in pixels of the input
    DETR_ROWS = auto()  # (1, n, 4 + classes): cx cy w h in 0..1, scores, as RT-DETR of ultralytics
    DETR_LOGITS = auto()  # (1, n, classes) logits and (1, n, 4) cx cy w h in 0..1
    DETR_SIZES = auto()  # takes orig_target_sizes; labels, boxes in pixels of the picture, scores
    GROUNDING_DINO = auto()  # takes a text; (1, n, tokens) logits and (1, n, 4) cx cy w h in 0..1


@dataclass(frozen=True, slots=True)
class Port:
    """An input or output of a model."""

    name: str
    kind: str  # "tensor(float)"
    shape: tuple[int | str | None, ...]

    def __str__(self) -> str:
        sizes = ", ".join("?" if size is None else str(size) for size in self.shape)
        return f"{self.name} {self.kind.removeprefix('tensor(').removesuffix(')')} [{sizes}]"


@dataclass(frozen=True, slots=True)
class Signature:
    """What goes in and out of a model, and what it says about itself."""

    path: Path
    inputs: tuple[Port, ...]
    outputs: tuple[Port, ...]
    metadata: Mapping[str, str]

    def __str__(self) -> str:
        return f"{'; '.join(map(str, self.inputs))} -> {'; '.join(map(str, self.outputs))}"

    @property
    def image(self) -> Port:
        """The input that takes the picture: the one of four dimensions."""
        found = [port for port in self.inputs if len(port.shape) == 4]
        if len(found) != 1 or found[0].shape[1] not in (3, "num_channels", None):
            raise self.refusal("no input of (1, 3, height, width)")
        return found[0]

    @property
    def names(self) -> dict[int, str]:
        """Names of the classes by number, from the metadata; empty where it has none."""
        return class_names(self.metadata.get("names", ""))

    def output(self, *names: str) -> Port | None:
        """The output of one of these names."""
        return next((port for port in self.outputs if port.name in names), None)

    def refusal(self, why: str) -> InputError:
        """The error that shows the signature, to be raised."""
        return InputError(
            f"{self.path}: {why}; the model's signature is {self}, expected YOLOv8 or 11, an end-to-end export "
            "[1, N, 6], RT-DETR, D-FINE, RF-DETR or Grounding DINO"
        )


def class_names(text: str) -> dict[int, str]:
    """Names by number of a Python literal, ``{0: 'flower'}`` or ``['flower']``; empty where it is none."""
    try:
        value = ast.literal_eval(text)
    except (ValueError, SyntaxError):
        return {}
    items = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, Sequence) else ()
    return {int(key): str(name) for key, name in items}


def recognise(signature: Signature) -> Kind:
    """The kind of a model.

    Raises
    ------
    InputError
        It is none that is understood; the message shows the signature.
    """
    image = signature.image
    inputs = {port.name for port in signature.inputs}
    if "input_ids" in inputs:
        if signature.output("logits") and signature.output("pred_boxes"):
            return Kind.GROUNDING_DINO
        raise signature.refusal("takes a text, but gives no logits and pred_boxes")
    if "orig_target_sizes" in inputs:
        if all(signature.output(name) for name in ("labels", "boxes", "scores")):
            return Kind.DETR_SIZES
        raise signature.refusal("takes orig_target_sizes, but gives no labels, boxes and scores")
    if inputs != {image.name}:
        raise signature.refusal(f"needs more than a picture: {', '.join(sorted(inputs - {image.name}))}")
    if signature.output("logits", "labels") and signature.output("pred_boxes", "dets"):
        return Kind.DETR_LOGITS
    if len(signature.outputs) == 1:
        return _one_output(signature)
    raise signature.refusal(f"{len(signature.outputs)} outputs that are not known")


def _one_output(signature: Signature) -> Kind:
    """YOLO and its like: one table, of which the shape tells what it is."""
    shape = signature.outputs[0].shape
    if len(shape) != 3:
        raise signature.refusal("one output, but not of three dimensions")
    _, rows, columns = shape
    n_classes = len(signature.names)
    is_detr = "rtdetr" in signature.metadata.get("description", "").lower().replace("-", "")
    if is_detr or (isinstance(columns, int) and columns != 6 and columns == 4 + n_classes and n_classes):
        return Kind.DETR_ROWS
    if columns == 6:
        return Kind.END_TO_END
    if isinstance(rows, int) and rows >= 5 and (not n_classes or rows == 4 + n_classes):
        if isinstance(columns, int) and columns < rows:
            raise signature.refusal("one output, with more columns than rows wanted (YOLOv5 exports are not read)")
        return Kind.YOLO
    raise signature.refusal("one output, but neither 4 + classes rows nor 6 columns")
