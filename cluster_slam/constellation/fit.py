"""The pose that fits matched flowers best, when flowers of a cluster share an offset, and how sure it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.constellation.similarity import Similarities, from_moments
from cluster_slam.geometry import Array, skew
from cluster_slam.records import IntArray

PRIOR_DOF = 12.0  # what is said beforehand of variances within units counts as so many degrees of freedom


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Matched flowers: where the session has them, where the map has them, and whose offset they share."""

    a: Array  # (k, d) session
    b: Array  # (k, d) map
    variance: Array  # (k,) of b - a along each axis, without the common offset
    unit: IntArray  # (k,) 0 ... u - 1
    var_offset: Array  # (u,)

    @property
    def n_units(self) -> int:
        return len(self.var_offset)


@dataclass(frozen=True, slots=True, eq=False)
class _Centred:
    """Pairs about the weighted centroids of their units: between and within carry separate weights."""

    mean_a: Array  # (u, d)
    mean_b: Array  # (u, d)
    between: Array  # (u,) 1 / (var_offset + 1 / W)
    within: Array  # (k,) 1 / variance
    da: Array  # (k, d)
    db: Array  # (k, d)


def _centred(pairs: Pairs) -> _Centred:
    weight = 1.0 / pairs.variance
    total = np.bincount(pairs.unit, weight, pairs.n_units)
    means = []
    for points in (pairs.a, pairs.b):
        sums = np.stack([np.bincount(pairs.unit, weight * x, pairs.n_units) for x in points.T], axis=1)
        means.append(sums / total[:, None])
    between = 1.0 / (pairs.var_offset + 1.0 / total)
    return _Centred(means[0], means[1], between, weight, pairs.a - means[0][pairs.unit], pairs.b - means[1][pairs.unit])


def variance_factors(pairs: Pairs, pose: Similarities) -> tuple[float, float]:
    """By how much the residuals say the variances are wrong: of flowers in their units, and of the units' offsets.

    Within units a sum of squares over its degrees of freedom; between them the mean over a grid of factors of the
    restricted likelihood (6 of 3 u degrees of freedom went into the pose), a factor of two being one sigma beforehand.
    """
    c = _centred(pairs)
    d = pairs.a.shape[1]
    moved = pose.apply(c.mean_a)[0]
    inner = float(pose.scale[0]) * c.da @ pose.R[0].T - c.db
    dof = float((len(pairs.a) - pairs.n_units) * d)
    within = (PRIOR_DOF + float(c.within @ (inner**2).sum(axis=1))) / (PRIOR_DOF + dof)
    own = within / np.bincount(pairs.unit, c.within, pairs.n_units)
    left = max(d * pairs.n_units - d * (d + 1) / 2, 1.0) / pairs.n_units
    squared = ((moved - c.mean_b) ** 2).sum(axis=1) * d / left
    weight, factors = factor_posterior(squared / d, left, pairs.var_offset, own)
    return within, float(weight @ factors)


def factor_posterior(mean_square: Array, dof: float, variance: Array, noise: Array) -> tuple[Array, Array]:
    """Weights and factors (g,): by how much variances may be wrong, where what they have in common is one factor.

    Parameters
    ----------
    mean_square
        (u,) of residuals, along an axis, of variance factor * ``variance`` + ``noise``.
    dof
        Degrees of freedom of each. A factor of two is one sigma beforehand.
    """
    factors = np.exp2(np.linspace(-4.0, 4.0, 65))
    total = factors[:, None] * variance + noise
    log_density = -0.5 * dof * (np.log(total) + mean_square / total).sum(axis=1) - 0.5 * np.log2(factors) ** 2
    weight = np.exp(log_density - log_density.max())
    return weight / weight.sum(), factors


def fit(pairs: Pairs, scale_range: tuple[float, float]) -> Similarities:
    """The generalised least-squares similarity (a stack of one) that takes a onto b.

    With a common offset of variance s^2 in each unit the likelihood falls apart into the units' centroids, of weight
    1 / (s^2 + 1/W), and deviations from them, of weight 1 / v each, which fix the rotation alone: a closed form.
    """
    c = _centred(pairs)
    mean_a, mean_b = (np.average(m, axis=0, weights=c.between) for m in (c.mean_a, c.mean_b))
    da, db = c.mean_a - mean_a, c.mean_b - mean_b
    H = np.einsum("u,ui,uj->ij", c.between, da, db) + np.einsum("k,ki,kj->ij", c.within, c.da, c.db)
    var_a = float(c.between @ (da**2).sum(1) + c.within @ (c.da**2).sum(1))
    return from_moments(H, var_a, mean_a, mean_b, scale_range)


def pose_covariance(pairs: Pairs, scale: float, *, with_scale: bool, prior_sigma: float = 10.0) -> Array:
    """Covariance (6, 6) of the tangent ``[rx ry rz tx ty tz]`` on the right of T, from pairs in three dimensions.

    ``a`` is in the session's own frame, before T. A prior of ``prior_sigma`` (rad, m) keeps all finite.
    """
    c = _centred(pairs)
    eye = np.broadcast_to(np.eye(3), (len(c.mean_a), 3, 3))
    outer = np.concatenate([-skew(scale * c.mean_a), eye, c.mean_a[:, :, None]], axis=2)
    inner = np.concatenate([-skew(scale * c.da), np.zeros((len(c.da), 3, 3)), c.da[:, :, None]], axis=2)
    information = np.einsum("u,uki,ukj->ij", c.between, outer, outer)
    information += np.einsum("k,kai,kaj->ij", c.within, inner, inner)
    information += np.diag([prior_sigma**-2] * 6 + [1e-6])
    n = 7 if with_scale else 6
    cov: Array = np.linalg.solve(information[:n, :n], np.eye(n))[:6, :6]
    return 0.5 * (cov + cov.T)
