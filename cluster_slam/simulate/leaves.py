"""Leaves between camera and plant: ellipses, still or slowly moving, that hide what is behind them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from cluster_slam.geometry import Array, so3_exp
from cluster_slam.records import IntArray
from cluster_slam.simulate.config import SimulateConfig
from cluster_slam.simulate.plant import Plant


@dataclass(frozen=True, slots=True, eq=False)
class Leaves:
    """Ellipses in the world."""

    centres: Array  # (n, l, 3) at each frame
    axes: Array  # (l, 3, 3) columns: half-axis directions, normal
    radii: Array  # (l, 2) m


def grow_leaves(config: SimulateConfig, plant: Plant, times: Array, *, rng: np.random.Generator) -> Leaves:
    """Leaves 6 to 20 cm in front of clusters (times scale); every second one wanders by up to 8 cm in seconds.

    No cluster has two of its own: leaves beyond the number of clusters hang in front of any stem.
    """
    k, s = config.n_leaves, config.scale
    elsewhere = plant.stems.reshape(-1, 3)[rng.integers(0, plant.stems.size // 3, k)]
    host = np.concatenate([rng.permutation(plant.centroids), elsewhere])[:k]
    place = host + s * rng.uniform([-0.05, -0.20, -0.03], [0.05, -0.06, 0.08], (k, 3))
    upright = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]])  # normal along -y, to the arm
    axes = so3_exp(rng.normal(0.0, 0.4, (k, 3))) @ upright
    radii = s * rng.uniform([0.035, 0.045], [0.065, 0.095], (k, 2))
    hz, phase = rng.uniform(0.05, 0.2, (k, 1)), rng.uniform(0.0, 2 * np.pi, (k, 3))
    reach = s * rng.uniform(0.03, 0.08, (k, 3)) * (np.arange(k) % 2)[:, None]
    wander = reach * np.sin(2 * np.pi * hz * times[:, None, None] + phase)
    return Leaves(place + wander, axes, radii)


def hidden_by(leaves: Leaves, frame: IntArray, eyes: Array, points: Array) -> NDArray[np.bool_]:
    """Which points (m, 3) a leaf hides from the eyes (m, 3) at the given frames (m,): the ray crosses its ellipse."""
    hidden = np.zeros(len(points), bool)
    for j, (axes, radii) in enumerate(zip(leaves.axes, leaves.radii, strict=True)):
        centre = leaves.centres[frame, j]
        eye = (eyes - centre) @ axes
        ray = (points - eyes) @ axes
        with np.errstate(divide="ignore", invalid="ignore"):
            part = -eye[:, 2] / ray[:, 2]
            across = (eye[:, :2] + part[:, None] * ray[:, :2]) / radii
            hidden |= (part > 0.0) & (part < 1.0) & ((across**2).sum(1) < 1.0)
    return hidden
