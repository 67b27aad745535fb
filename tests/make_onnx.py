"""Writes the tiny models of ``tests/onnx``: exact signatures of detectors, answers computed from the picture.

    python tests/make_onnx.py

Each finds white discs: from the moments of what is white in a window come its middle and its size. Needs ``onnx``.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import onnx
from onnx import TensorProto, helper, numpy_helper

OUT = Path(__file__).parent / "onnx"
MEAN, STD = [0.485, 0.456, 0.406], [0.229, 0.224, 0.225]
FLOWER = 5  # number of the word in the little vocabulary
VOCABULARY = ("[PAD]", "[UNK]", "[CLS]", "[SEP]", ".", "flower", "##s", "dog", "a", "cluster", "blossom")


class Graph:
    """Nodes in the order in which they are added; a name for every value."""

    def __init__(self) -> None:
        self.nodes: list[onnx.NodeProto] = []
        self.constants: list[onnx.TensorProto] = []

    def __call__(self, op: str, *inputs: str | float | list[int] | np.ndarray, **attributes: object) -> str:
        names = [value if isinstance(value, str) else self.constant(value) for value in inputs]
        name = f"v{len(self.nodes)}"
        self.nodes.append(helper.make_node(op, names, [name], **attributes))
        return name

    def constant(self, value: float | list[int] | np.ndarray) -> str:
        kind = np.int64 if isinstance(value, list) else np.float32
        array = value if isinstance(value, np.ndarray) else np.array(value, kind)
        name = f"c{len(self.constants)}"
        self.constants.append(numpy_helper.from_array(array, name))
        return name

    def named(self, value: str, name: str) -> None:
        self.nodes.append(helper.make_node("Identity", [value], [name]))

    def save(
        self,
        path: str,
        inputs: dict[str, tuple[int, list[int | str]]],
        outputs: dict[str, tuple[int, list[int | str]]],
        metadata: dict[str, str] | None = None,
    ) -> None:
        graph = helper.make_graph(
            self.nodes,
            "discs",
            [helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in inputs.items()],
            [helper.make_tensor_value_info(name, kind, shape) for name, (kind, shape) in outputs.items()],
            self.constants,
        )
        model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
        helper.set_model_props(model, metadata or {})
        onnx.checker.check_model(model, full_check=True)
        onnx.save(model, OUT / path)


def discs(g: Graph, image: str, height: int, width: int) -> tuple[str, str]:
    """Boxes (1, 4, n), cx cy w h in pixels, and scores (1, 1, n), n over the strides 8, 16 and 32."""
    white = g("Clip", g("Mul", g("Sub", g("ReduceMin", image, [1]), 0.6), 10.0), 0.0, 1.0)
    small = g("AveragePool", white, kernel_shape=[4, 4], strides=[4, 4])
    x = np.arange(width // 4, dtype=np.float32).reshape(1, 1, 1, -1) * 4 + 2
    y = np.arange(height // 4, dtype=np.float32).reshape(1, 1, -1, 1) * 4 + 2
    parts = [small, *(g("Mul", small, value) for value in (x, y, x * x, y * y))]
    stack = g("Concat", *parts, axis=1)
    boxes, scores = zip(*(at_stride(g, stack, s, height, width) for s in (8, 16, 32)), strict=True)
    return g("Concat", *boxes, axis=2), g("Concat", *scores, axis=2)


def at_stride(g: Graph, stack: str, stride: int, height: int, width: int) -> tuple[str, str]:
    """The moments of windows six strides wide."""
    s = stride // 4
    pad = (6 * s - s) // 2
    m = g("AveragePool", stack, kernel_shape=[6 * s] * 2, strides=[s, s], pads=[pad] * 4, count_include_pad=1)
    mass, mx, my, mxx, myy = (g("Slice", m, [k], [k + 1], [1]) for k in range(5))
    safe = g("Add", mass, 1e-6)
    cx, cy = g("Div", mx, safe), g("Div", my, safe)
    spread = [g("Sub", g("Div", a, safe), g("Mul", b, b)) for a, b in ((mxx, cx), (myy, cy))]
    w, h = (g("Mul", g("Sqrt", g("Add", g("Relu", value), 1e-6)), 4.0) for value in spread)
    gx = (np.arange(width // stride, dtype=np.float32).reshape(1, 1, 1, -1) + 0.5) * stride
    gy = (np.arange(height // stride, dtype=np.float32).reshape(1, 1, -1, 1) + 0.5) * stride
    dx, dy = g("Sub", cx, gx), g("Sub", cy, gy)
    away = g("Add", g("Mul", dx, dx), g("Mul", dy, dy))
    near = g("Exp", g("Mul", away, -1.0 / (0.75 * stride) ** 2))
    there = g("Clip", g("Mul", mass, 200.0), 0.0, 1.0)
    fits = g("Clip", g("Div", g("Sub", 4.2 * stride, g("Max", w, h)), float(stride)), 0.0, 1.0)
    score = g("Mul", g("Mul", g("Mul", near, there), fits), 0.98)
    n = height * width // stride**2
    return g("Reshape", g("Concat", cx, cy, w, h, axis=1), [1, 4, n]), g("Reshape", score, [1, 1, n])


def best(g: Graph, boxes: str, scores: str, n: int) -> tuple[str, str]:
    """The n best cells without their neighbours: boxes (1, n, 4), scores (1, n)."""
    kept = g("NonMaxSuppression", corners(g, boxes), scores, [400], 0.45, 0.05)  # (k, 3)
    index = g("Reshape", g("Slice", kept, [2], [3], [1]), [-1])
    count = g("Shape", index)
    rows = g("Gather", g("Transpose", boxes, perm=[0, 2, 1]), index, axis=1)
    values = g("Gather", g("Squeeze", scores, [1]), index, axis=1)
    missing = g("Sub", [n], count)
    zero = [0]
    fill2 = g("Concat", [0, 0, 0], missing, axis=0)
    fill3 = g("Concat", [0, 0, 0, 0], missing, zero, axis=0)
    return g("Pad", rows, fill3, 0.0), g("Pad", values, fill2, 0.0)


def corners(g: Graph, boxes: str) -> str:
    """x1 y1 x2 y2 (1, n, 4) of cx cy w h (1, 4, n)."""
    t = g("Transpose", boxes, perm=[0, 2, 1])
    middle, size = g("Slice", t, [0], [2], [2]), g("Slice", t, [2], [4], [2])
    half = g("Mul", size, 0.5)
    return g("Concat", g("Sub", middle, half), g("Add", middle, half), axis=2)


def rows_to_corners(g: Graph, rows: str) -> str:
    return corners(g, g("Transpose", rows, perm=[0, 2, 1]))


F, WHOLE = TensorProto.FLOAT, TensorProto.INT64
NAMES = {"names": "{0: 'leaf', 1: 'flower'}", "stride": "32", "task": "detect", "imgsz": "[640, 640]"}


def yolo() -> None:
    g = Graph()
    boxes, scores = discs(g, "images", 640, 640)
    none = g("Mul", scores, 0.0)
    g.named(g("Concat", boxes, none, scores, axis=1), "output0")
    g.save("yolo.onnx", {"images": (F, [1, 3, 640, 640])}, {"output0": (F, [1, 6, 8400])}, NAMES)


def end_to_end() -> None:
    g = Graph()
    rows, scores = best(g, *discs(g, "images", 640, 640), 300)
    kind = g("Add", g("Mul", g("Unsqueeze", scores, [2]), 0.0), 1.0)
    g.named(g("Concat", rows_to_corners(g, rows), g("Unsqueeze", scores, [2]), kind, axis=2), "output0")
    g.save("end_to_end.onnx", {"images": (F, [1, 3, 640, 640])}, {"output0": (F, [1, 300, 6])}, NAMES)


def detr_rows() -> None:
    g = Graph()
    rows, scores = best(g, *discs(g, "images", 640, 640), 300)
    shares = g("Mul", rows, 1.0 / 640)
    g.named(g("Concat", shares, g("Unsqueeze", scores, [2]), axis=2), "output0")
    metadata = {**NAMES, "names": "{0: 'flower'}", "description": "Ultralytics RT-DETR model"}
    g.save("rtdetr_rows.onnx", {"images": (F, [1, 3, 640, 640])}, {"output0": (F, [1, 300, 5])}, metadata)


def detr_sizes() -> None:
    """RT-DETR and D-FINE as their own exporters write them: boxes in pixels of the picture."""
    g = Graph()
    rows, scores = best(g, *discs(g, "images", 640, 640), 300)
    size = g("Cast", g("Concat", "orig_target_sizes", "orig_target_sizes", axis=1), to=F)
    g.named(g("Mul", g("Mul", rows_to_corners(g, rows), 1.0 / 640), g("Unsqueeze", size, [1])), "boxes")
    g.named(scores, "scores")
    g.named(g("Cast", g("Mul", scores, 0.0), to=WHOLE), "labels")
    g.save(
        "dfine.onnx",
        {"images": (F, ["N", 3, 640, 640]), "orig_target_sizes": (WHOLE, ["N", 2])},
        {"labels": (WHOLE, ["N", 300]), "boxes": (F, ["N", 300, 4]), "scores": (F, ["N", 300])},
    )


def logit(g: Graph, scores: str) -> str:
    p = g("Clip", scores, 1e-4, 1.0 - 1e-4)
    return g("Log", g("Div", p, g("Sub", 1.0, p)))


def detr_logits(path: str, inputs: str, box_name: str, score_name: str, is_normalised: bool) -> None:
    g = Graph()
    image = inputs
    if is_normalised:
        image = g("Add", g("Mul", inputs, channel(STD)), channel(MEAN))
    rows, scores = best(g, *discs(g, image, 640, 640), 300)
    g.named(g("Mul", rows, 1.0 / 640), box_name)
    g.named(g("Unsqueeze", logit(g, scores), [2]), score_name)
    g.save(
        path,
        {inputs: (F, [1, 3, 640, 640])},
        {score_name: (F, [1, 300, 1]), box_name: (F, [1, 300, 4])},
    )


def channel(values: list[float]) -> np.ndarray:
    return np.array(values, np.float32).reshape(1, 3, 1, 1)


def grounding_dino() -> None:
    """Only the word "flower" is answered; the picture comes normalised, stretched to 800 x 800."""
    g = Graph()
    image = g("Add", g("Mul", "pixel_values", channel(STD)), channel(MEAN))
    rows, scores = best(g, *discs(g, image, 800, 800), 900)
    g.named(g("Mul", rows, 1.0 / 800), "pred_boxes")
    is_word = g("Cast", g("Equal", "input_ids", [FLOWER]), to=F)  # (1, t)
    asked = g("Mul", is_word, g("Cast", "attention_mask", to=F))
    masked = g("Mul", g("Cast", "token_type_ids", to=F), 0.0)
    shown = g("ReduceMax", g("Cast", "pixel_mask", to=F), [1, 2], keepdims=1)
    asked = g("Mul", g("Add", asked, masked), g("Squeeze", shown, [2]))
    full = g("Mul", g("Unsqueeze", scores, [2]), g("Unsqueeze", asked, [1]))  # (1, 900, t)
    missing = g("Sub", [256], g("Slice", g("Shape", "input_ids"), [1], [2], [0]))
    padded = g("Pad", logit(g, full), g("Concat", [0, 0, 0, 0, 0], missing, axis=0), -20.0)
    g.named(g("Reshape", padded, [1, 900, 256]), "logits")
    text = {name: (WHOLE, [1, "tokens"]) for name in ("input_ids", "token_type_ids", "attention_mask")}
    g.save(
        "dino/model.onnx",
        {"pixel_values": (F, [1, 3, 800, 800]), **text, "pixel_mask": (WHOLE, [1, 800, 800])},
        {"logits": (F, [1, 900, 256]), "pred_boxes": (F, [1, 900, 4])},
    )
    (OUT / "dino" / "vocab.txt").write_text("\n".join([*VOCABULARY, ""]))


def classifier() -> None:
    """No detector: a model that must be refused."""
    g = Graph()
    g.named(g("ReduceMean", "input", [2, 3], keepdims=0), "probabilities")
    g.save("classifier.onnx", {"input": (F, [1, 3, 224, 224])}, {"probabilities": (F, [1, 3])})


if __name__ == "__main__":
    OUT.mkdir(exist_ok=True)
    (OUT / "dino").mkdir(exist_ok=True)
    yolo()
    end_to_end()
    detr_rows()
    detr_sizes()
    detr_logits("rfdetr.onnx", "input", "dets", "labels", True)
    detr_logits("rtdetr_logits.onnx", "pixel_values", "pred_boxes", "logits", False)
    grounding_dino()
    classifier()
