"""Errors of flowers and clusters against their true rest positions, matched by identity and never by distance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import Clusters, Flowers, IntArray, Truth
from tracking.gating import chi2_threshold
from tracking.metrics import IdentityScores

NOMINAL = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)  # probabilities of the coverage curves


@dataclass(frozen=True, slots=True, eq=False)
class LandmarkErrors:
    """Estimated minus true positions of the landmarks that have both, in the world."""

    index: IntArray  # (p,) rows of the estimate's table
    errors: Array  # (p, 3)
    covs: Array  # (p, 3, 3)
    true_positions: Array  # (p, 3)

    def __len__(self) -> int:
        return len(self.index)

    @property
    def norms(self) -> Array:
        """Distances (p,) from the truth, metres."""
        norms: Array = np.sqrt((self.errors * self.errors).sum(-1))
        return norms

    @property
    def nees(self) -> Array:
        """e' S^-1 e / 3 of each (p,): 1 on average where the covariances are true; inf where S is not definite."""
        return normalised_squared(self.errors, self.covs) / 3.0

    @property
    def inside95(self) -> float:
        """Share inside the 95 % ellipsoid."""
        return float((3.0 * self.nees <= chi2_threshold(3, 0.95)).mean())

    @property
    def coverage(self) -> tuple[float, ...]:
        """Share inside the ellipsoid of each of the probabilities ``NOMINAL``."""
        return tuple(float((3.0 * self.nees <= chi2_threshold(3, p)).mean()) for p in NOMINAL)


def normalised_squared(errors: Array, covs: Array) -> Array:
    """e' S^-1 e (p,) of errors (p, d) with covariances (p, d, d); inf where a covariance is not positive definite."""
    out = np.full(len(errors), np.inf)
    ok = np.flatnonzero(np.isfinite(covs).all((1, 2)) & np.isfinite(errors).all(1))
    ok = ok[np.linalg.eigvalsh(covs[ok])[:, 0] > 0]
    solved = np.linalg.solve(covs[ok], errors[ok][..., None])[..., 0]
    out[ok] = (errors[ok] * solved).sum(-1)
    return out


def matched_rest(flowers: Flowers, matching: IdentityScores, truth: Truth) -> Array:
    """True rest position (f, 3) of each estimated flower by the matching of ids, NaN where it has none."""
    out = np.full((len(flowers), 3), np.nan)
    if truth.rest_flower_ids is None or truth.rest_positions is None:
        return out
    rest = dict(zip(truth.rest_flower_ids.tolist(), truth.rest_positions, strict=True))
    partner = dict(zip(matching.estimated_ids.tolist(), matching.true_ids.tolist(), strict=True))
    for row, flower in enumerate(flowers.ids.tolist()):
        out[row] = rest.get(partner.get(flower, -1), out[row])
    return out


def flower_errors(flowers: Flowers, rest: Array) -> LandmarkErrors:
    """Errors of the flowers whose true rest position (f, 3) is known."""
    index = np.flatnonzero(np.isfinite(rest).all(1))
    return LandmarkErrors(index, flowers.positions[index] - rest[index], flowers.covs[index], rest[index])


def cluster_errors(clusters: Clusters, flowers: Flowers, rest: Array) -> LandmarkErrors:
    """Errors of centroids against the mean of the same flowers' truth.

    Only clusters all of whose members have a true rest position: the centroid of others has no truth.
    """
    where = np.searchsorted(clusters.ids, flowers.cluster_ids)
    total = np.zeros((len(clusters), 3))
    np.add.at(total, where, rest)
    n_members = np.bincount(where, minlength=len(clusters))
    index = np.flatnonzero((n_members > 0) & np.isfinite(total).all(1))
    true = total[index] / n_members[index, None]
    return LandmarkErrors(index, clusters.positions[index] - true, clusters.covs[index], true)


def ghost_clusters(clusters: Clusters, flowers: Flowers, matching: IdentityScores) -> IntArray:
    """Ids of confirmed clusters without a single flower that is matched to a true one (duplicates among them)."""
    real = np.isin(flowers.ids, matching.estimated_ids)
    confirmed = np.array([state == "confirmed" for state in clusters.states], dtype=bool)
    return clusters.ids[confirmed & ~np.isin(clusters.ids, flowers.cluster_ids[real])]
