"""The whole geometry as a descriptor: the members themselves, compared by the best map and the best motion."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.descriptors.geometries import match_geometries
from cluster_slam.descriptors.geometry import match_geometry
from cluster_slam.descriptors.invariants import common_variance
from cluster_slam.descriptors.members import centred, checked_points
from cluster_slam.descriptors.protocol import Comparison, Description
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray
from tracking.gaussian import ensure_positive_definite


@dataclass(frozen=True, slots=True)
class FullGeometry:
    """Members relative to their centroid, with their joint covariance; 3 n - 6 degrees of freedom."""

    name: str = "full geometry"
    limit: float | None = None  # squared distances above it are reported as inf, which is much faster

    def describe(self, points: Array, cov: Array) -> Description:
        """The members, as they are."""
        offsets = centred(checked_points(points))
        n = offsets.shape[-2]
        flat = offsets.reshape(*offsets.shape[:-2], 3 * n)
        full = np.broadcast_to(ensure_positive_definite(cov, "covariance of the members"), (*flat.shape, 3 * n))
        return Description(flat, flat, full, degrees_of_freedom(n), n)

    def compare(self, reference: Description, observed: Description) -> Comparison:
        """Best map and motion of each pair; members may be missing on one side."""
        n, m = reference.n_flowers, observed.n_flowers
        shape = np.broadcast_shapes(reference.value.shape[:-1], observed.value.shape[:-1])
        a = np.broadcast_to(reference.value, (*shape, 3 * n)).reshape(-1, n, 3)
        b = np.broadcast_to(observed.value, (*shape, 3 * m)).reshape(-1, m, 3)
        cov_a = np.broadcast_to(reference.cov, (*shape, 3 * n, 3 * n)).reshape(-1, 3 * n, 3 * n)
        cov_b = np.broadcast_to(observed.cov, (*shape, 3 * m, 3 * m)).reshape(-1, 3 * m, 3 * m)
        var_a, var_b = common_variance(cov_a), common_variance(cov_b)
        if var_a is not None and var_b is not None:
            found = self._compare_isotropic(a, b, np.sqrt(var_a + var_b))
        else:
            found = self._compare_one_by_one(a, cov_a, b, cov_b)
        return Comparison(*(x.reshape(shape) for x in found))

    def _compare_isotropic(self, a: Array, b: Array, sigma: Array) -> tuple[Array, Array, Array]:
        match = match_geometries(a, b, sigma, self.limit)
        return match.distance_sq, match.dof, match.log_likelihood

    def _compare_one_by_one(self, a: Array, cov_a: Array, b: Array, cov_b: Array) -> tuple[Array, Array, Array]:
        found = [match_geometry(*pair, limit=self.limit) for pair in zip(a, cov_a, b, cov_b, strict=True)]
        out = np.array([(m.distance_sq, m.dof, m.log_likelihood) for m in found]).reshape(-1, 3)
        return out[:, 0], out[:, 1], out[:, 2]


def degrees_of_freedom(n: int | IntArray) -> int:
    """Of the squared distance of two equal shapes of n members in general position."""
    return 1 if n == 2 else 3 * int(n) - 6
