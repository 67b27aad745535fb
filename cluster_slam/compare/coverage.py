"""What a nominal 95 % gate really holds, when both observations are noisy."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.compare.contenders import GEOMETRY, contenders
from cluster_slam.compare.population import Pairs
from cluster_slam.geometry import Array

PROBABILITY = 0.95
SIZES = (3, 4, 5, 6, 8)
RADII = (3.0, 6.0, 20.0)  # root mean square distance to the centroid, in sigmas
GEOMETRY_TRIALS = {3.0: 200, 6.0: 1000, 20.0: 2000}  # of a radius: near ones are slow, and hold nearly all
GEOMETRY_SIZES = (3, 4, 5, 6)  # more take long where members are confused


@dataclass(frozen=True, slots=True)
class CoverageRow:
    """One gate on clusters of one size and radius."""

    name: str
    n_flowers: int
    radius_in_sigmas: float
    coverage: float


def coverage_table(n_trials: int = 4000, *, rng: np.random.Generator) -> list[CoverageRow]:
    """Shapes at random, scaled to the radius."""
    rows = []
    for n in SIZES:
        for radius in RADII:
            pairs = _pairs(n, radius, n_trials, rng=rng)
            for contender in contenders():
                name = contender.names[0]
                if name == GEOMETRY and n not in GEOMETRY_SIZES:
                    continue
                own = np.arange(min(n_trials, GEOMETRY_TRIALS[radius]) if name == GEOMETRY else n_trials)
                scores = contender.score(pairs, 1.0, n, own, own)[0]
                rows.append(CoverageRow(name, n, radius, scores.coverage(PROBABILITY)))
    return rows


def _pairs(n: int, radius: float, n_trials: int, *, rng: np.random.Generator) -> Pairs:
    """In units of sigma."""
    shapes: Array = rng.standard_normal((n_trials, n, 3))
    shapes = shapes - shapes.mean(1, keepdims=True)
    shapes = shapes * (radius / np.sqrt((shapes**2).sum((1, 2)) / n))[:, None, None]
    return Pairs(shapes + rng.standard_normal(shapes.shape), shapes + rng.standard_normal(shapes.shape))
