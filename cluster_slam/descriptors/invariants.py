"""Descriptors of a few numbers: the paper's two, and mean distance with the sizes of the principal axes."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cluster_slam.descriptors.members import centred, checked_points
from cluster_slam.descriptors.moments import (
    carry,
    closed_form_moments,
    descriptor_moments,
    inertia_and_mean_distance,
)
from cluster_slam.descriptors.protocol import Comparison, Description, compare_vectors
from cluster_slam.geometry import Array
from tracking.unscented import SigmaRule

PAPER_RULE = SigmaRule(alpha=1.0, beta=2.0, kappa=0.0)


@dataclass(frozen=True, slots=True)
class InertiaDistance:
    """Inertia and mean distance, with exact moments."""

    name: str = "inertia, mean distance"

    def describe(self, points: Array, cov: Array) -> Description:
        """Mean and covariance from `descriptor_moments`, in closed form where all errors are equal and isotropic."""
        var = common_variance(cov)
        if var is None:
            mean, out = descriptor_moments(points, cov)
        else:
            mean, out = closed_form_moments(points, np.sqrt(var))
        points = checked_points(points)
        return _reduced(inertia_and_mean_distance(points), mean, out, points.shape[-2])

    def compare(self, reference: Description, observed: Description) -> Comparison:
        """Gaussian difference."""
        return compare_vectors(reference, observed)


@dataclass(frozen=True, slots=True)
class UnscentedDescriptor:
    """Any function of the centred members, with its mean and covariance from the unscented transform."""

    name: str
    function: Callable[[Array], Array]  # offsets (..., n, 3) -> (..., m)
    dof: Callable[[int], int]  # of the number of members
    rule: SigmaRule | None = None  # None: the beta with which the variance of the inertia is exact

    def describe(self, points: Array, cov: Array) -> Description:
        """Mean and covariance of the function's value."""
        points = checked_points(points)
        n = points.shape[-2]
        mean, out = carry(points, cov, self.function, self.rule)
        return Description(self.function(centred(points)), mean, out, self.dof(n), n)

    def compare(self, reference: Description, observed: Description) -> Comparison:
        """Gaussian difference."""
        return compare_vectors(reference, observed)


def distance_and_axes(points: Array) -> Array:
    """Mean distance to the centroid and the root mean square sizes along the principal axes (..., 1 + min(3, n - 1)).

    The squares of the sizes are the eigenvalues of the scatter matrix over n, largest first; those that n members
    cannot have are left out. Two members have one number only.
    """
    offsets = centred(points)
    n = offsets.shape[-2]
    distance = np.sqrt((offsets * offsets).sum(-1)).mean(-1)
    if n == 2:
        return np.asarray(distance[..., None])
    scatter = np.swapaxes(offsets, -1, -2) @ offsets / n
    sizes = np.sqrt(np.maximum(np.linalg.eigvalsh(scatter)[..., ::-1][..., : min(3, n - 1)], 0.0))
    return np.concatenate([distance[..., None], sizes], axis=-1)


def paper_descriptor(rule: SigmaRule = PAPER_RULE) -> UnscentedDescriptor:
    """Inertia and mean distance as Chu et al. (2025) carry them through the unscented transform."""
    return UnscentedDescriptor("paper", inertia_and_mean_distance, lambda n: 2, rule)


def distance_axes_descriptor() -> UnscentedDescriptor:
    """Mean distance and principal axes, four numbers from four flowers on."""
    return UnscentedDescriptor("mean distance, axes", distance_and_axes, lambda n: 1 if n == 2 else min(n, 4))


def common_variance(cov: Array) -> Array | None:
    """The variances (...) where all joint covariances (..., 3 n, 3 n) are multiples of the identity; else None."""
    cov = np.asarray(cov, float)
    var = cov[..., 0, 0]
    off = np.abs(cov - var[..., None, None] * np.eye(cov.shape[-1])).max((-1, -2))
    return var if bool((off <= 1e-12 * np.abs(var)).all()) else None


def _reduced(value: Array, mean: Array, cov: Array, n: int) -> Description:
    """Two members have one distance only, and inertia says nothing more."""
    if n == 2:
        return Description(value[..., 1:], mean[..., 1:], cov[..., 1:, 1:], 1, n)
    return Description(value, mean, cov, 2, n)
