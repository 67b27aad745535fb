"""Table II: correct and false matches among 10,000 clusters of 3 to 6 flowers, with and without padding.

The paper's numbers do not follow from what it says. The literal protocol and the readings that come nearest are all
run; none gives all four numbers.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from cluster_slam.descriptors import inertia_and_mean_distance, isotropic, unscented_moments
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray
from cluster_slam.reproduce.matlab_rng import MatlabStream
from cluster_slam.reproduce.settings import N_SAMPLES, PADDING_M, PROBABILITY, SEED, Settings
from tracking.allpairs import gate_all
from tracking.gating import Gate

SIZES = (3, 4, 5, 6)
Padding = Literal["none", "sigma", "quadrature", "variance", "entry"]
PADDING_WORDS: dict[Padding, str] = {
    "none": "none",
    "sigma": "sigma + 0.005 m",
    "quadrature": "in quadrature",
    "variance": "variances + 0.005²",
    "entry": "variances + 0.005",
}


@dataclass(frozen=True, slots=True)
class Reading:
    """A way to understand the paper's words."""

    name: str
    scale: float = 1.0  # of the cube, on top of the settings'
    is_reference_noisy: bool = False
    is_observed_noisy: bool = True
    counts_later_only: bool = False  # "the corresponding index and subsequent indexes"
    paddings: tuple[Padding, ...] = ("sigma", "quadrature")


@dataclass(frozen=True, slots=True)
class MatchRow:
    """One row of table II."""

    reading: str
    padding: Padding
    correct_match: int
    false_positive_avg: float


READINGS = (
    Reading("literal: clean reference, noisy observation", paddings=("sigma", "quadrature", "variance", "entry")),
    Reading("both frames noisy", is_reference_noisy=True),
    Reading("cube of 0.1 m, both frames noisy, later indices", 0.1, True, True, True),
    Reading("cube of 0.1 m, noisy reference, later indices", 0.1, True, False, True),
)


@dataclass(frozen=True, slots=True, eq=False)
class _Clusters:
    """Clusters of one size, with the indices that they have among all."""

    index: IntArray  # (c,)
    points: Array  # (c, n, 3) in a cube of side 1
    first: Array  # (c, n, 3) standard normal
    second: Array  # (c, n, 3)


def table2(settings: Settings, n_clusters: int = N_SAMPLES) -> list[MatchRow]:
    """All readings, each without and with padding."""
    drawn = {True: _draw(n_clusters, True), False: _draw(n_clusters, False)}
    rows: list[MatchRow] = []
    for reading in READINGS:
        clusters = drawn[reading.is_reference_noisy and reading.is_observed_noisy]
        for padding in ("none", *reading.paddings):
            rows.append(_row(settings, reading, padding, clusters, n_clusters))
    return rows


def _draw(n_clusters: int, is_both: bool) -> list[_Clusters]:
    """`n = randi([3 6]); X = rand(n, 3); randn(n, 3)` for each cluster, and one more `randn` where both are noisy."""
    stream = MatlabStream(SEED)
    found: dict[int, list[tuple[int, Array, Array, Array]]] = {n: [] for n in SIZES}
    for index in range(n_clusters):
        n = int(stream.randi(SIZES[0], SIZES[-1], 1)[0])
        points, first = stream.rand(n, 3), stream.randn(n, 3)
        found[n].append((index, points, first, stream.randn(n, 3) if is_both else first))
    return [_Clusters(*(np.array(column) for column in zip(*found[n], strict=True))) for n in SIZES if found[n]]


def _row(
    settings: Settings, reading: Reading, padding: Padding, clusters: list[_Clusters], n_clusters: int
) -> MatchRow:
    correct = wrong = 0
    for group in clusters:
        hits = _matches(settings, reading, padding, group)
        correct += int(np.trace(hits))
        np.fill_diagonal(hits, False)
        wrong += int(np.triu(hits).sum() if reading.counts_later_only else hits.sum())
    return MatchRow(reading.name, padding, correct, wrong / n_clusters)


def _matches(settings: Settings, reading: Reading, padding: Padding, group: _Clusters) -> NDArray[np.bool_]:
    """Which observation (column) passes the gate of which reference (row)."""
    points = settings.scale * reading.scale * group.points
    reference = points + settings.noise * group.first if reading.is_reference_noisy else points
    last = group.second if reading.is_reference_noisy else group.first
    observed = points + settings.noise * last if reading.is_observed_noisy else points
    sigma = _sigma(settings.noise, padding)
    mean, cov = unscented_moments(reference, isotropic(points.shape[1], sigma), settings.rule)
    cov = cov + {"variance": PADDING_M**2, "entry": PADDING_M}.get(padding, 0.0) * np.eye(2)
    values = inertia_and_mean_distance(observed)
    return gate_all(Gate(PROBABILITY, 2), mean, cov, values, np.zeros((len(values), 2, 2)))


def _sigma(noise: float, padding: Padding) -> float:
    return {"sigma": noise + PADDING_M, "quadrature": float(np.hypot(noise, PADDING_M))}.get(padding, noise)
