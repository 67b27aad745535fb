"""How far a detector's middles lie to where flowers face, into the model's metadata.

    python training/lean.py cluster_slam/detect/models/flowers.onnx --first 95000 --worlds 3 --write

Of a flower that is a dozen pixels wide nobody sees how it is tilted, and a detector that was trained to say where its
middle is errs to the side that it faces. Lifting knows the tilt of the petals, if roughly: the error of middles is
regressed on it, both averaged over a second. What the tilt still errs, as neighbouring frames tell, is no tilt, and
makes the slope too small by its share of the variance.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from measure import state

from cluster_slam.detect import open_detector
from cluster_slam.lift import lift_boxes
from cluster_slam.simulate.config import MODERATE
from cluster_slam.simulate.render.frames import Renderer
from cluster_slam.simulate.session import simulate_session
from tracking.assignment import assign

_REACH = 0.4  # of a flower's width: a detection farther from its middle does not show it
_SEEN = 0.5  # of a flower
_HALF_S = 0.5
_FEWEST = 10  # frames of a flower


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    options.add_argument("model", help="an ONNX file")
    options.add_argument("--worlds", type=int, default=3)
    options.add_argument("--first", type=int, default=95_000, help="seed of the first plant")
    options.add_argument("--fps", type=float, default=8.0)
    options.add_argument("--write", action="store_true", help="into the model's metadata")
    chosen = options.parse_args()
    detector = open_detector(chosen.model)
    worlds = [errors_of(detector, seed, chosen.fps) for seed in range(chosen.first, chosen.first + chosen.worlds)]
    for seed, (error, tilt, noise) in enumerate(worlds, chosen.first):
        print(f"seed {seed}: {slope(error, tilt, noise):.3f} of {len(error)}")
    error, tilt, noise = (np.concatenate(x) for x in zip(*worlds, strict=True))
    lean = slope(error, tilt, noise)
    less = 1.0 - ((error - lean * tilt).std(axis=0) / error.std(axis=0)) ** 2
    print(f"middles lean by {lean:.3f} widths for each unit of the tangent: {less.mean():.2f} of what lasts")
    if chosen.write:
        state(Path(chosen.model), {"lean": f"{lean:.3f}"})


def errors_of(detector: object, seed: int, fps: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Errors of middles (n, 2) in widths, tangents of tilts (n, 2), and what these still err (n, 2), squared."""
    made = simulate_session(replace(MODERATE, level=1, fps=fps), seed=seed)
    renderer = Renderer(made, seed=seed)
    rows = []
    for k in range(len(made.session.stamps)):
        picture = renderer.frame(k)
        found = detector.detect(picture.colour)
        lifted = lift_boxes(
            made.camera,
            found,
            picture.depth * renderer.depth_model.unit_m,
            convention="z",
            model=renderer.depth_model,
            sigma_px=np.ones(len(found)),
            image=picture.colour,
            lean=1.0,
        )
        boxes = picture.boxes
        seen, i = np.flatnonzero(boxes.visible > _SEEN), np.flatnonzero(lifted.is_lifted)
        width = np.sqrt(boxes.sizes[seen].prod(axis=1))
        away = np.linalg.norm(found.centres[i, None] - boxes.centres[None, seen], axis=2)
        one, other = assign(away / width, _REACH)
        i, j = i[one], seen[other]
        own = np.sqrt(found.sizes[i].prod(axis=1))[:, None]
        rows.append(
            np.column_stack(
                [
                    np.full(len(i), k / fps),
                    boxes.flowers[j],
                    (found.centres[i] - boxes.centres[j]) / own,
                    (found.centres[i] - lifted.centres[i]) / own,
                ]
            )
        )
    return averaged(np.concatenate(rows))


def averaged(rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Of rows (n, 6) time, flower, error, tilt: errors and tilts, averaged over a second of the same flower."""
    out = []
    for flower in np.unique(rows[:, 1]):
        mine = rows[rows[:, 1] == flower]
        if len(mine) >= _FEWEST:
            near = np.abs(mine[:, None, 0] - mine[None, :, 0]) <= _HALF_S
            n = near.sum(axis=1, keepdims=True)
            noise = 0.5 * (np.diff(mine[:, 4:], axis=0) ** 2).mean(axis=0)
            out.append(np.column_stack([near @ mine[:, 2:] / n, noise / n]))
    error, tilt, noise = np.split(np.concatenate(out), 3, axis=1)
    return error, tilt, noise


def slope(error: np.ndarray, tilt: np.ndarray, noise: np.ndarray) -> float:
    error, tilt = error - error.mean(axis=0), tilt - tilt.mean(axis=0)
    return float((error * tilt).sum() / (tilt**2 - noise).sum())


if __name__ == "__main__":
    main()
