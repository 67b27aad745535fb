"""Clusters to compare descriptors on, and pairs of noisy observations of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import IntArray


@dataclass(frozen=True, slots=True)
class Population:
    """Flowers uniform in a ball, none nearer to another than the spacing; the ball's radius uniform in an interval."""

    radius_m: tuple[float, float] = (0.03, 0.08)
    spacing_m: float = 0.012

    def draw(self, n_flowers: int, n_clusters: int, *, rng: np.random.Generator) -> Array:
        """Clusters (n_clusters, n_flowers, 3), m."""
        out = np.empty((n_clusters, n_flowers, 3))
        radius = rng.uniform(*self.radius_m, n_clusters)
        todo = np.arange(n_clusters)
        while len(todo):
            out[todo] = radius[todo, None, None] * _in_ball((len(todo), n_flowers), rng=rng)
            todo = todo[~self.is_spaced(out[todo])]
        return out

    def is_spaced(self, points: Array) -> np.ndarray[tuple[int, ...], np.dtype[np.bool_]]:
        """Whether no two flowers of clusters (..., n, 3) are too near (...)."""
        i, j = np.triu_indices(points.shape[-2], 1)
        gaps = points[..., i, :] - points[..., j, :]
        return np.asarray(((gaps * gaps).sum(-1) >= self.spacing_m**2).all(-1))


@dataclass(frozen=True, slots=True)
class Case:
    """What is asked of the descriptors in one row of the table."""

    sigma_m: float  # of each flower's error along each axis, in both observations
    n_flowers: int  # of the cluster
    n_missing: int = 0  # flowers that the observation lacks
    n_new: int = 0  # flowers that only the observation has
    radius_m: tuple[float, float] = (0.03, 0.08)

    @property
    def n_observed(self) -> int:
        """Flowers that the observation has."""
        return self.n_flowers - self.n_missing + self.n_new


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Reference and observation of the same index belong together in the genuine pairs, all others do not."""

    reference: Array  # (p, n, 3)
    observed: Array  # (p, m, 3)


def observe(case: Case, clusters: Array, *, rng: np.random.Generator) -> Pairs:
    """One reference and one observation of each cluster (p, n, 3), both with errors, flowers in any order."""
    reference = clusters + case.sigma_m * rng.standard_normal(clusters.shape)
    order = rng.permuted(np.tile(np.arange(case.n_flowers), (len(clusters), 1)), axis=1)
    kept = np.take_along_axis(clusters, order[:, : case.n_flowers - case.n_missing, None], axis=1)
    radius = np.linalg.norm(clusters - clusters.mean(1, keepdims=True), axis=-1).max(-1)
    new = clusters.mean(1, keepdims=True) + radius[:, None, None] * _in_ball((len(clusters), case.n_new), rng=rng)
    seen = np.concatenate([kept, new], axis=1)
    return Pairs(reference, seen + case.sigma_m * rng.standard_normal(seen.shape))


def all_pairs(n: int) -> tuple[IntArray, IntArray]:
    """Indices of every reference with every observation, references outermost."""
    i, j = np.divmod(np.arange(n * n), n)
    return i, j


def _in_ball(shape: tuple[int, ...], *, rng: np.random.Generator) -> Array:
    """Points (*shape, 3), uniform in the unit ball."""
    direction = rng.standard_normal((*shape, 3))
    length = np.linalg.norm(direction, axis=-1, keepdims=True)
    out: Array = direction / length * rng.random((*shape, 1)) ** (1.0 / 3.0)
    return out
