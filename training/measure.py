"""Measure a detector: on renderings of plants it has not seen, and on annotated pictures (COCO).

    python training/measure.py cluster_slam/detect/models/flowers.onnx --worlds 20
    python training/measure.py colour --coco FOLDER/annotations.coco.json

Renderings are counted twice: every flower of which a third or more is seen and that is not tiny; and those only that
are "reasonable", as benchmarks of small or hidden things have it. With ``--calibrate`` the measured error of the boxes'
middles is written into the model's metadata.
"""

from __future__ import annotations

import argparse
import json
from itertools import pairwise
from pathlib import Path

import cv2
import numpy as np
from pictures import HIDDEN, SEEN, render_usual, render_world

from cluster_slam.detect import open_detector
from cluster_slam.records import ImageDetections

HELD_OUT = 90_000  # first seed of the worlds that no training sees
_MIN_PX = 6.0  # longer side: a flower smaller than that is neither wanted nor wrong
_LEAST = 0.15  # score
_PLANTS = {"random": render_world, "usual": render_usual}
# Least share that is seen, shorter side in px. "Reasonable" in P. Dollar and others, "Pedestrian detection", 2012: 65 %
# or more is seen; S. Yang and others, "WIDER FACE", 2016, leave out faces below 10 px.
_REASONABLE = (0.65, 10.0)


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("model", help="an ONNX file, own, or colour")
    options.add_argument("--worlds", type=int, default=12)
    options.add_argument("--first", type=int, default=HELD_OUT, help="seed of the first plant")
    options.add_argument("--plants", nargs="+", choices=sorted(_PLANTS), default=["usual"])
    options.add_argument("--coco", type=Path)
    options.add_argument("--category", default="flower")
    options.add_argument("--calibrate", action="store_true")
    options.add_argument("--at", type=float, default=0.6, help="score at which groups of flowers are counted")
    chosen = options.parse_args()
    is_file = chosen.model.endswith(".onnx")
    detector = open_detector(chosen.model if is_file else None, name=None if is_file else chosen.model, score=_LEAST)
    if chosen.coco is not None:
        scores, hits, _, flowers = _joined(annotated(detector, chosen.coco, chosen.category))
        report(scores, hits, flowers, chosen.at)
        return
    looks = looked(detector, range(chosen.first, chosen.first + chosen.worlds), chosen.plants)
    print("reasonable flowers: 65 % seen or more, shorter side 10 px or more")
    scores, hits, _, flowers = _joined(counted(looks, *_REASONABLE))
    report(scores, hits, flowers, chosen.at)
    print("all flowers: 35 % seen or more, longer side 6 px or more")
    scores, hits, errors, flowers = _joined(counted(looks, SEEN, 0.0))
    report(scores, hits, flowers, chosen.at)
    by_group(flowers, chosen.at)
    a, b = centre_sigma(errors)
    print(f"middle of a box: sigma of u and of v = hypot({a:.2f} px, {b:.3f} of its size)")
    print(f"its mean error: {errors[:, 0].mean():+.2f} px in u, {errors[:, 1].mean():+.2f} px in v")
    if chosen.calibrate:
        state(Path(chosen.model), {"sigma_px": f"{a:.3f} {b:.4f}", "pixel_origin": "centre"})


def looked(detector: object, seeds: range, plants: list[str]) -> list[tuple]:
    """What is found in the pictures of held-out worlds, their true boxes, their shapes."""
    pictures = (picture for name in plants for seed in seeds for picture in _PLANTS[name](seed))
    return [(detector.detect(p.colour), p.boxes, p.colour.shape[:2]) for p in pictures]


def counted(looks: list[tuple], seen: float, shorter: float) -> list[tuple]:
    """Matches, where those flowers count of which such a share is seen and whose shorter side is so long."""
    tables = []
    for found, b, (height, width) in looks:
        inside = (b.centres > 3).all(1) & (b.centres < [width - 4, height - 4]).all(1)
        wanted = (b.visible >= seen) & (b.sizes.min(1) >= shorter) & (b.sizes.max(1) >= _MIN_PX) & inside
        ignored = (b.visible >= HIDDEN) & ~wanted
        tables.append(matched(found, np.column_stack([b.centres, b.sizes]), wanted, ignored, b.visible))
    return tables


def _joined(tables: list[tuple]) -> tuple[np.ndarray, ...]:
    return tuple(np.concatenate([table[i] for table in tables]) for i in range(len(tables[0])))


def annotated(detector: object, path: Path, category: str) -> list[tuple]:
    """Matches in the pictures of a COCO file."""
    content = json.loads(path.read_text("utf-8"))
    wanted = {c["id"] for c in content["categories"] if c["name"] == category}
    tables = []
    for entry in content["images"]:
        image = cv2.imread(str(path.parent / entry["file_name"]))
        rows = [
            a["bbox"] for a in content["annotations"] if a["image_id"] == entry["id"] and a["category_id"] in wanted
        ]
        corner = np.array(rows, float).reshape(-1, 4)
        boxes = np.column_stack([corner[:, :2] + corner[:, 2:] / 2 - 0.5, corner[:, 2:]])
        found = detector.detect(image)
        every = np.ones(len(boxes))
        tables.append(matched(found, boxes, every > 0, every < 0, every))
    return tables


def matched(
    found: ImageDetections, boxes: np.ndarray, wanted: np.ndarray, ignored: np.ndarray, visible: np.ndarray
) -> tuple:
    """Scores and hits (IoU 0.5, best score first, each box once), errors of the middles, and flowers one by one.

    A flower's row: whether it is wanted, which share of it is seen, its shorter and longer side, the largest IoU with
    another that is to be seen, and the score it was found with, 0 where it was not.
    """
    scores, hits, errors, by = [], [], [], np.zeros(len(boxes))
    for k in range(len(found)):
        overlap = iou(np.concatenate([found.centres[k], found.sizes[k]]), boxes)
        free = np.where((wanted | ignored) & (by == 0), overlap * (1.0 + wanted), 0.0)  # those that are wanted first
        j = int(free.argmax()) if len(free) else -1
        is_hit = j >= 0 and free[j] > 0 and overlap[j] >= 0.5
        if is_hit:
            by[j] = found.scores[k]
            if wanted[j] and found.scores[k] > 0.35:
                errors.append([*(found.centres[k] - boxes[j, :2]), np.sqrt(boxes[j, 2:].prod())])
        if (is_hit and wanted[j]) or not (len(overlap) and (np.where(ignored, overlap, 0.0) > 0.3).any()):
            scores.append(found.scores[k])
            hits.append(bool(is_hit and wanted[j]))
    crowd = np.array(
        [np.delete(np.where(visible > HIDDEN, iou(b, boxes), 0.0), i).max(initial=0.0) for i, b in enumerate(boxes)]
    )
    rows = np.column_stack([wanted, visible, boxes[:, 2:].min(1), boxes[:, 2:].max(1), crowd.reshape(-1), by])
    flowers = rows[wanted | ignored].reshape(-1, 6)
    return np.array(scores), np.array(hits, bool), np.array(errors).reshape(-1, 3), flowers


def by_group(flowers: np.ndarray, least: float) -> None:
    """Recall over which share of a flower is seen, over its shorter side, and over how much others overlap it."""
    is_found, is_wanted = flowers[:, 5] >= least, flowers[:, 0] > 0
    groups = (
        ("seen", 1, (HIDDEN, 0.2, SEEN, 0.5, 0.65, 0.8, 0.95, 1.01), flowers[:, 3] >= _MIN_PX),
        ("shorter side, px", 2, (0, 6, 8, 10, 14, 20, 1000), is_wanted),
        ("IoU with another", 4, (0, 0.01, 0.1, 0.25, 0.5, 1.01), is_wanted),
    )
    for name, column, edges, counted in groups:
        print(f"{name}, at score {least}:")
        for low, high in pairwise(edges):
            part = counted & (flowers[:, column] >= low) & (flowers[:, column] < high)
            if part.any():
                print(f"  {low} to {high}: {int(part.sum())} flowers, recall {is_found[part].mean():.2f}")


def iou(box: np.ndarray, boxes: np.ndarray) -> np.ndarray:
    """Intersection over union of one box (4,) with others (k, 4), each as middle and size."""
    low = np.maximum(box[:2] - box[2:] / 2, boxes[:, :2] - boxes[:, 2:] / 2)
    high = np.minimum(box[:2] + box[2:] / 2, boxes[:, :2] + boxes[:, 2:] / 2)
    shared = np.maximum(high - low, 0.0).prod(1)
    return shared / (box[2:].prod() + boxes[:, 2:].prod(1) - shared + 1e-9)


def report(scores: np.ndarray, hits: np.ndarray, flowers: np.ndarray, at: float) -> None:
    """Precision and recall over the least score."""
    n_wanted = int(flowers[:, 0].sum())
    order = np.argsort(-scores, kind="stable")
    true = np.cumsum(hits[order])
    recall, precision = true / max(n_wanted, 1), true / np.arange(1, len(true) + 1)
    print(f"{n_wanted} flowers, {len(scores)} boxes")
    for least in sorted({0.2, 0.3, 0.4, 0.5, 0.6, at}):
        k = int((scores >= least).sum()) - 1
        if k >= 0:
            print(f"score {least:.2f}: precision {precision[k]:.3f}, recall {recall[k]:.3f}")
    for wanted in (0.8, 0.9, 0.95):
        at = precision >= wanted
        best = f"{recall[at].max():.3f}" if at.any() else "not reached"
        print(f"at precision {wanted}: recall {best}")


def centre_sigma(errors: np.ndarray) -> tuple[float, float]:
    """Constant and share of the size, by least squares on robust variances in bins of the size."""
    edges = np.quantile(errors[:, 2], np.linspace(0, 1, 9))
    rows = []
    for low, high in pairwise(edges):
        part = errors[(errors[:, 2] >= low) & (errors[:, 2] <= high)]
        rows.append([np.mean(part[:, 2] ** 2), np.mean(np.minimum(part[:, :2] ** 2, (0.3 * part[:, 2:]) ** 2))])
    size_sq, variance = np.array(rows).T
    X = np.column_stack([np.ones(len(rows)), size_sq]) / variance[:, None]
    a, b = np.linalg.lstsq(X, np.ones(len(rows)), rcond=None)[0]
    return float(np.sqrt(max(a, 0.04))), float(np.sqrt(max(b, 0.0)))


def state(path: Path, more: dict[str, str]) -> None:
    """Set entries of a model's metadata."""
    import onnx

    model = onnx.load(str(path))
    for entry in list(model.metadata_props):
        if entry.key in more:
            model.metadata_props.remove(entry)
    for key, value in sorted(more.items()):
        entry = model.metadata_props.add()
        entry.key, entry.value = key, value
    onnx.save(model, str(path))


if __name__ == "__main__":
    main()
