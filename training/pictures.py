"""Pictures to learn from: renderings of random plants under random light, cut into crops with their boxes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cluster_slam.errors import ConfigError
from cluster_slam.simulate.config import MODERATE, SimulateConfig
from cluster_slam.simulate.render.config import LookConfig
from cluster_slam.simulate.render.frames import Picture, Renderer
from cluster_slam.simulate.session import simulate_session

SEEN = 0.35  # share of a flower that is seen, from which it should be found ...
HIDDEN = 0.08  # ... and below which it should not; what is between counts neither way
N_FRAMES = 8  # of one plant


@dataclass(frozen=True, slots=True, eq=False)
class Example:
    """A crop and its flowers."""

    image: NDArray[np.uint8]  # (s, s, 3) blue, green, red
    is_backdrop: NDArray[np.bool_]  # (s, s)
    boxes: NDArray[np.float32]  # (k, 5) u, v, width, height, share that is seen


def random_world(rng: np.random.Generator) -> SimulateConfig:
    """A plant, a camera and a light; wider than any session's."""
    near = rng.uniform(0.15, 0.6)
    small = rng.uniform(0.006, 0.013)
    look = LookConfig(
        flower_radius_min_m=small,
        flower_radius_max_m=small * rng.uniform(1.05, 1.6),
        flower_tilt=rng.uniform(0.4, 1.3),
        foliage_per_m=rng.uniform(4.0, 40.0),
        n_distractors=int(rng.integers(10, 120)),
        petal_pink=rng.uniform(0.0, 1.0) ** 2,
        sun=rng.uniform(0.0, 1.4),
        sky=rng.uniform(0.25, 0.9),
        exposure=rng.uniform(0.55, 1.6),
        vary_light=0.2,
        exposure_s=rng.uniform(0.001, 0.012),
        blur_px=rng.uniform(0.35, 1.5),
        noise=rng.uniform(0.2, 2.5),
        jpeg_quality=int(rng.integers(70, 98)),
    )
    return replace(
        MODERATE,
        level=1,
        n_clusters=int(rng.integers(8, 26)),
        flowers_max=int(rng.integers(4, 9)),
        cluster_spacing_m=rng.uniform(0.07, 0.13),
        plant_width_m=rng.uniform(1.0, 1.6),
        distance_min_m=near,
        distance_max_m=near + rng.uniform(0.05, 0.35),
        turn_rad=rng.uniform(0.2, 0.8),
        focal_px=rng.uniform(380.0, 700.0),
        duration_s=30.0,
        fps=N_FRAMES / 30.0,
        n_leaves=int(rng.integers(0, 25)),
        look=look,
    )


def render_world(seed: int, changes: dict[str, Any] | None = None) -> list[Picture]:
    """The pictures of one random plant, with changes; none where its flowers do not fit."""
    config = replace(random_world(np.random.default_rng([seed, 77])), **(changes or {}))
    try:
        made = simulate_session(config, seed=seed)
    except ConfigError:
        return []
    renderer = Renderer(made, seed=seed)
    return [renderer.frame(k) for k in range(N_FRAMES)]


def crops(picture: Picture, size: int, count: int, rng: np.random.Generator) -> list[Example]:
    """Crops, most of them about a flower."""
    height, width = picture.colour.shape[:2]
    boxes = picture.boxes
    table = np.column_stack([boxes.centres, boxes.sizes, boxes.visible]).astype(np.float32)
    good = np.flatnonzero(boxes.visible > SEEN)
    found = []
    for _ in range(count):
        if len(good) and rng.random() < 0.85:
            middle = boxes.centres[rng.choice(good)] + rng.uniform(-0.35, 0.35, 2) * size
        else:
            middle = rng.uniform([0, 0], [width, height])
        low = np.clip(np.rint(middle - size / 2), 0, [width - size, height - size]).astype(int)
        part = (slice(low[1], low[1] + size), slice(low[0], low[0] + size))
        moved = table - np.array([low[0], low[1], 0, 0, 0], np.float32)
        inside = (moved[:, :2] > -2).all(1) & (moved[:, :2] < size + 2).all(1)
        found.append(Example(picture.colour[part].copy(), picture.is_backdrop[part].copy(), moved[inside]))
    return found


def usual_distance(seed: int) -> dict[str, Any]:
    """Changes of a random plant: seen from as far, and with such a lens, as in a usual session."""
    rng = np.random.default_rng([seed, 79])
    near = float(rng.uniform(0.4, 0.7))
    return {"distance_min_m": near, "distance_max_m": near + 0.2, "focal_px": float(rng.uniform(400.0, 460.0))}


def render_near(seed: int) -> list[Picture]:
    """The pictures of a random plant at a usual session's distance."""
    return render_world(seed, usual_distance(seed))


def render_usual(seed: int) -> list[Picture]:
    """Pictures of a usual session: its plant, camera and light."""
    config = replace(MODERATE, level=1, fps=N_FRAMES / 30.0)
    renderer = Renderer(simulate_session(config, seed=seed), seed=seed)
    return [renderer.frame(k) for k in range(N_FRAMES)]


def make_examples(render: Callable[[int], list[Picture]], seeds: range, size: int, per_picture: int) -> list[Example]:
    """Examples of many worlds; the same seeds give the same examples."""
    found: list[Example] = []
    for seed in seeds:
        rng = np.random.default_rng([seed, 78])
        for picture in render(seed):
            found += crops(picture, size, per_picture, rng)
    return found
