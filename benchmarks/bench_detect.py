"""The detector in the package, and the renderer: seconds of CPU on one core."""

from __future__ import annotations

from dataclasses import replace
from time import process_time

import cv2
import numpy as np
from figure import Figure

from cluster_slam.detect import open_detector
from cluster_slam.lift import lift_boxes
from cluster_slam.simulate import PRESETS, simulate_session
from cluster_slam.simulate.render.frames import Renderer

GOAL_DETECT_MS = 15.0  # 640 x 480
GOAL_RENDER_MS = 200.0  # 848 x 480: 900 frames in three minutes
SEED = 3


def measure(quick: bool) -> list[Figure]:
    """Milliseconds of detection, lifting and rendering; ``quick``: fewer frames."""
    cv2.setNumThreads(1)
    n = 3 if quick else 10
    config = replace(PRESETS["moderate"], level=1, fps=1.0)
    renderer = Renderer(simulate_session(config, seed=SEED), seed=SEED)
    renderer.frame(0)
    begin = process_time()
    pictures = [renderer.frame(k) for k in range(n)]
    rendering = (process_time() - begin) / n
    detector = open_detector()
    small = [np.ascontiguousarray(picture.colour[:, 104:744]) for picture in pictures]
    detector.detect(small[0])
    begin = process_time()
    for image in small:
        detector.detect(image)
    detecting = (process_time() - begin) / n
    boxes = [detector.detect(picture.colour) for picture in pictures]
    begin = process_time()
    for found, picture in zip(boxes, pictures, strict=True):
        depth = picture.depth * renderer.depth_model.unit_m
        sigma = detector.sigma_px(found.sizes)
        lift_boxes(
            renderer.made.camera, found, depth, convention="z", model=renderer.depth_model, sigma_px=sigma,
            image=picture.colour,
        )  # fmt: skip
    lifting = (process_time() - begin) / n
    return [
        Figure("our detector, 640 x 480", 1e3 * detecting, "ms", GOAL_DETECT_MS),
        Figure("rendering a frame, 848 x 480", 1e3 * rendering, "ms", GOAL_RENDER_MS),
        Figure(f"lifting the {sum(map(len, boxes)) // n} boxes of a frame", 1e3 * lifting, "ms"),
    ]
