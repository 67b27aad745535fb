"""What models give, as boxes in pixels of their input: centre, size, score."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array

NMS_IOU = 0.5  # boxes that overlap by more are one flower


@dataclass(frozen=True, slots=True, eq=False)
class RawBoxes:
    """Candidates before any is refused."""

    centres: Array  # (k, 2)
    sizes: Array  # (k, 2)
    scores: Array  # (k,)
    classes: NDArray[np.int64]  # (k,)

    def take(self, index: NDArray[np.int64] | NDArray[np.bool_]) -> RawBoxes:
        return RawBoxes(self.centres[index], self.sizes[index], self.scores[index], self.classes[index])


def yolo(table: NDArray[np.float32], least: float) -> RawBoxes:
    """Candidates of (4 + classes, cells) that reach a score."""
    scores = table[4:]
    best = scores.max(0)
    k = np.flatnonzero(best >= least)
    rows = table[:4, k].T.astype(float)
    return RawBoxes(rows[:, :2], rows[:, 2:], best[k].astype(float), scores[:, k].argmax(0))


def end_to_end(table: NDArray[np.float32]) -> RawBoxes:
    """Candidates of (n, 6): x1 y1 x2 y2 score class."""
    rows = table.astype(float)
    return corners(rows[:, :4], rows[:, 4], rows[:, 5])


def corners(boxes: Array, scores: Array, classes: Array) -> RawBoxes:
    """Candidates of corners x1 y1 x2 y2 (n, 4)."""
    low, high = boxes[:, :2], boxes[:, 2:]
    return RawBoxes((low + high) / 2, high - low, scores, classes.astype(np.int64))


def shares(boxes: NDArray[np.float32], scores: NDArray[np.float32], width: int, height: int) -> RawBoxes:
    """Candidates of cx cy w h (n, 4) in 0..1 and scores (n, classes), in pixels of an input of this size."""
    size = np.array([width, height], float)
    rows = boxes.astype(float)
    return RawBoxes(
        rows[:, :2] * size, rows[:, 2:] * size, scores.max(1).astype(float), scores.argmax(1).astype(np.int64)
    )


def sigmoid(x: NDArray[np.float32]) -> NDArray[np.float32]:
    """1 / (1 + exp(-x)), without overflow."""
    result: NDArray[np.float32] = 0.5 * (1.0 + np.tanh(0.5 * x))
    return result


def suppressed(boxes: RawBoxes, iou: float = NMS_IOU) -> RawBoxes:
    """Candidates without those that overlap a better one by more than ``iou``; best first."""
    order = np.argsort(-boxes.scores, kind="stable")
    boxes = boxes.take(order)
    low, high = boxes.centres - boxes.sizes / 2, boxes.centres + boxes.sizes / 2
    area = boxes.sizes.prod(1)
    alive = np.ones(len(order), bool)
    for i in range(len(order)):
        if not alive[i]:
            continue
        side = np.minimum(high[i], high[i + 1 :]) - np.maximum(low[i], low[i + 1 :])
        shared = np.maximum(side, 0.0).prod(1)
        alive[i + 1 :] &= shared <= iou * (area[i] + area[i + 1 :] - shared)
    return boxes.take(np.flatnonzero(alive))
