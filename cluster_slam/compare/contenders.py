"""The descriptors that are compared, each as a function from pairs to a statistic that is small for a match."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from cluster_slam.compare.population import Pairs
from cluster_slam.descriptors import (
    Background,
    Descriptor,
    InertiaDistance,
    distance_axes_descriptor,
    inertia_and_mean_distance,
    isotropic,
    match_geometries,
    paper_descriptor,
)
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray
from tracking.gating import chi2_threshold, mahalanobis_sq

FAR = 1.0 - 1e-4  # of true pairs lie nearer; beyond, the full geometry does not look


@dataclass(frozen=True, slots=True, eq=False)
class Scores:
    """What a contender says of some pairs."""

    statistic: Array  # (q,) small for a match
    distance_sq: Array  # (q,) what its gate compares
    dof: Array  # (q,)

    def coverage(self, probability: float) -> float:
        """Share of the pairs inside a gate of this probability."""
        thresholds = np.array([chi2_threshold(int(d), probability) if d == d else 0.0 for d in self.dof])
        return float(np.mean(self.distance_sq <= thresholds))


Score = Callable[[Pairs, float, int, IntArray, IntArray], tuple[Scores, ...]]


@dataclass(frozen=True, slots=True)
class Contender:
    """One way to compare, and the names of the statistics that it gives."""

    names: tuple[str, ...]
    score: Score  # pairs, sigma, number of common flowers, references, observations


PAPER, PAPER_BOTH, PAPER_EXACT = "paper, its gate", "paper, both covariances", "inertia and distance, exact moments"
AXES, GEOMETRY, RATIO = "distance and axes", "full geometry", "full geometry, likelihood ratio"
BOUND = "bound: the true likelihood ratio"
DEFAULT = RATIO  # its squared distance is what the gate compares


def contenders() -> tuple[Contender, ...]:
    """All, in the order of the table."""
    return (
        Contender((PAPER,), _paper),
        Contender((PAPER_BOTH,), _by_vectors(paper_descriptor())),
        Contender((PAPER_EXACT,), _by_vectors(InertiaDistance())),
        Contender((AXES,), _by_vectors(distance_axes_descriptor())),
        Contender((GEOMETRY, RATIO), _by_geometry),
    )


def choices(points: Array, k: int) -> Array:
    """All choices of k members of clusters (p, n, 3): (p, s, k, 3)."""
    members = np.array(list(combinations(range(points.shape[-2]), k)), dtype=np.int64)
    out: Array = points[:, members]
    return out


def _paper(pairs: Pairs, sigma: float, k: int, i: IntArray, j: IntArray) -> tuple[Scores, ...]:
    """As in the paper: the observation's own errors are not counted."""
    reference = paper_descriptor().describe(choices(pairs.reference, k), isotropic(k, sigma))
    observed = inertia_and_mean_distance(choices(pairs.observed, k))
    innovation = observed[j][:, None, :] - reference.mean[i][:, :, None]
    return (_best(mahalanobis_sq(innovation, reference.cov[i][:, :, None]), 2),)


def _by_vectors(descriptor: Descriptor) -> Score:
    def score(pairs: Pairs, sigma: float, k: int, i: IntArray, j: IntArray) -> tuple[Scores, ...]:
        reference = descriptor.describe(choices(pairs.reference, k), isotropic(k, sigma))[i]
        observed = descriptor.describe(choices(pairs.observed, k), isotropic(k, sigma))[j]
        return (_best(descriptor.compare(reference[:, :, None], observed[:, None]).distance_sq, reference.dof),)

    return score


def _best(every: Array, dof: int) -> Scores:
    """Of all choices of members the one that fits best."""
    best = every.reshape(len(every), -1).min(1)
    return Scores(best, best, np.full(len(best), float(dof)))


def _by_geometry(pairs: Pairs, sigma: float, k: int, i: IntArray, j: IntArray) -> tuple[Scores, ...]:
    """The squared distance, and the likelihood ratio against a match by chance, learned from the references."""
    limit = chi2_threshold(max(3 * k - 6, 1), FAR)
    distance_sq, dof, ratio = (np.full(len(i), v) for v in (np.inf, np.nan, -np.inf))
    background = Background.of_clusters(list(pairs.reference), sigma)
    reference = pairs.reference[i]
    for some in np.moveaxis(choices(pairs.observed, k), 1, 0):
        observed = some[j]
        match = match_geometries(reference, observed, np.sqrt(2.0) * sigma, limit)
        better = match.distance_sq < distance_sq
        distance_sq[better], dof[better] = match.distance_sq[better], match.dof[better]
        a = np.take_along_axis(reference[better], match.reference[better][..., None], axis=1)
        b = np.take_along_axis(observed[better], match.observed[better][..., None], axis=1)
        ratio[better] = background.log_likelihood_ratio(a, b, sigma, sigma)
    return Scores(distance_sq, distance_sq, dof), Scores(-ratio, distance_sq, dof)
