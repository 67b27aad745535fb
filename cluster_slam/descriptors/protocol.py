"""What gates and association ask of a descriptor: mean, covariance and degrees of freedom, and how two compare."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any, Protocol

import numpy as np

from cluster_slam.descriptors.members import checked_points
from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from tracking.gating import mahalanobis_sq
from tracking.gaussian import LOG_2PI, log_det


@dataclass(frozen=True, slots=True, eq=False)
class Description:
    """A descriptor's value for a stack of clusters with equal numbers of members.

    Two observations with errors of like size are compared value against value: the errors shift both alike. An
    observation of a cluster that is known far better is held against the *mean* that its errors let one expect
    (`descriptor_moments` of the known positions with the sum of both covariances).
    """

    value: Array  # (..., m) at the members' positions as they were observed
    mean: Array  # (..., m) expected where these positions are true and errors of `cov` are added
    cov: Array  # (..., m, m)
    dof: int  # degrees of freedom of the squared distance of two equal clusters
    n_flowers: int

    def __getitem__(self, index: Any) -> Description:
        """Of some clusters of the stack, or with new axes; the last axes stay."""
        return Description(self.value[index], self.mean[index], self.cov[index], self.dof, self.n_flowers)


@dataclass(frozen=True, slots=True, eq=False)
class Comparison:
    """Pairs of descriptions held against each other."""

    distance_sq: Array  # (...) squared Mahalanobis distance under S_reference + S_observed
    dof: Array  # (...)
    log_likelihood: Array  # (...) of the observed given the reference


class Descriptor(Protocol):
    """A way to describe a cluster that does not depend on where it stands, how it is turned, or who is which."""

    @property
    def name(self) -> str:
        """A short name, for tables."""

    def describe(self, points: Array, cov: Array) -> Description:
        """Of members (..., n, 3), m, with joint covariances (..., 3 n, 3 n), m^2."""

    def compare(self, reference: Description, observed: Description) -> Comparison:
        """Of pairs; leading dimensions broadcast."""


def compare_vectors(reference: Description, observed: Description) -> Comparison:
    """Of descriptions that are plain vectors: Gaussian difference with the sum of the covariances.

    Raises
    ------
    InputError
        The vectors differ in length, as they do for some descriptors where the numbers of members differ.
    """
    if reference.value.shape[-1] != observed.value.shape[-1]:
        raise InputError(
            f"descriptions of {reference.n_flowers} and {observed.n_flowers} flowers differ in length: "
            "compare equal numbers of members (`compare_with_missing`)"
        )
    innovation, S = observed.value - reference.value, reference.cov + observed.cov
    distance_sq = mahalanobis_sq(innovation, S)
    m = innovation.shape[-1]
    log_likelihood = -0.5 * (distance_sq + log_det(S) + m * LOG_2PI)
    return Comparison(distance_sq, np.full(distance_sq.shape, float(reference.dof)), log_likelihood)


def subsets(points: Array, cov: Array, n: int) -> tuple[Array, Array]:
    """All choices of n members: (..., s, n, 3) and (..., s, 3 n, 3 n)."""
    points = checked_points(points)
    members = np.array(list(combinations(range(points.shape[-2]), n)), dtype=np.int64)
    index = (3 * members[..., None] + np.arange(3)).reshape(len(members), 3 * n)
    return points[..., members, :], cov[..., index[:, :, None], index[:, None, :]]


def compare_with_missing(
    descriptor: Descriptor, reference: Array, reference_cov: Array, observed: Array, observed_cov: Array
) -> Comparison:
    """Compare clusters one of which lacks members of the other: the best choice of members of the larger one.

    Parameters
    ----------
    reference, observed
        (..., n, 3) and (..., m, 3), m; leading dimensions equal.
    reference_cov, observed_cov
        Joint covariances (..., 3 n, 3 n) and (..., 3 m, 3 m), m^2.
    """
    k = min(reference.shape[-2], observed.shape[-2])
    a = descriptor.describe(*subsets(reference, reference_cov, k))
    b = descriptor.describe(*subsets(observed, observed_cov, k))
    every = descriptor.compare(a, b)
    best = np.argmin(every.distance_sq, axis=-1)[..., None]
    picked = (
        np.take_along_axis(x, best, axis=-1)[..., 0] for x in (every.distance_sq, every.dof, every.log_likelihood)
    )
    return Comparison(*picked)
