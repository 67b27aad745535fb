"""Inertia and mean distance of a cluster, and their mean and covariance when the members are uncertain.

Descriptor (Chu et al. 2025, eqs. 4, 5): I = sum_i |p_i - c|^2 and D = (1/n) sum_i |p_i - c|, c the centroid.
"""

from __future__ import annotations

import numpy as np
from scipy.special import erf

from cluster_slam.descriptors.members import centred, checked_points
from cluster_slam.geometry import Array
from tracking.unscented import SigmaRule, unscented_transform

SMALL = 1e-3  # below this distance in sigmas the series of g and h are exact to 1e-13
SQRT_2_PI = float(np.sqrt(2.0 / np.pi))


def inertia_and_mean_distance(points: Array) -> Array:
    """Descriptors (..., 2): inertia in m^2 and mean distance to the centroid in m, of points (..., n, 3)."""
    offsets = centred(points)
    squares = (offsets * offsets).sum(-1)
    return np.stack([squares.sum(-1), np.sqrt(squares).mean(-1)], axis=-1)


def inertia_beta(cov: Array, rule: SigmaRule) -> Array:
    """The beta (...) that makes the unscented variance of the inertia exact, for joint covariances P (..., 3 n, 3 n).

    The inertia is x' A x with A the centring matrix. Its variance is 4 u' A P A u + 2 tr(A P A P); the transform
    gives 4 u' A P A u + h^2 sum_j q_j^2 + (beta - alpha^2) (sum_j q_j)^2 with q_j = c_j' A c_j and the columns c_j of
    the Cholesky factor. For equal isotropic members this is 2 / (3 (n - 1)), for every alpha.
    """
    length = cov.shape[-1]
    factor = np.linalg.cholesky(cov).reshape(*cov.shape[:-2], length // 3, 3, length)
    factor = (factor - factor.mean(-3, keepdims=True)).reshape(cov.shape)
    q = (factor * factor).sum(-2)
    inner = np.swapaxes(factor, -1, -2) @ factor
    true_part = 2.0 * (inner * inner).sum((-1, -2))
    beta: Array = (true_part - rule.spread_sq(length) * (q * q).sum(-1)) / q.sum(-1) ** 2 + rule.alpha**2
    return beta


def unscented_moments(points: Array, cov: Array, rule: SigmaRule | None = None) -> tuple[Array, Array]:
    """Mean (..., 2) and covariance (..., 2, 2) of inertia and mean distance, by the unscented transform.

    Parameters
    ----------
    points
        (..., n, 3), any frame, m.
    cov
        Joint covariance of the members (..., 3 n, 3 n), m^2, in the same frame.
    rule
        As in the paper: `SigmaRule(alpha, beta, kappa)`. None: alpha 1, kappa 0 and the beta of `inertia_beta`, with
        which the variance of the inertia is exact.

    Raises
    ------
    InputError
        Fewer than two flowers or a position that is not finite.
    CovarianceError
        A covariance is not positive definite.
    """
    offsets = centred(checked_points(points))
    n = offsets.shape[-2]
    used = SigmaRule() if rule is None else rule
    flat = offsets.reshape(*offsets.shape[:-2], 3 * n)
    beta = inertia_beta(np.asarray(cov, float), used) if rule is None else None

    def describe(x: Array) -> Array:
        return inertia_and_mean_distance(x.reshape(*x.shape[:-1], n, 3))

    return unscented_transform(flat, np.asarray(cov, float), describe, used, beta)


def closed_form_moments(points: Array, sigma: Array | float) -> tuple[Array, Array]:
    """Mean (..., 2) and covariance (..., 2, 2) of inertia and mean distance, all members with isotropic errors `sigma`.

    Exact but for the correlation of two members' distances, a series that is cut after its second term (relative error
    of var(D) below 1e-5 where the radius exceeds 5 sigma, 3e-3 at 1 sigma).

    Parameters
    ----------
    points
        (..., n, 3), m.
    sigma
        (...) or one number, m, > 0.
    """
    offsets = centred(checked_points(points))
    n = offsets.shape[-2]
    sigma = np.asarray(sigma, float)
    var = sigma**2
    own_var = var * (1.0 - 1.0 / n)
    m = np.sqrt((offsets * offsets).sum(-1))
    g, slope, h = _norm_moments(m, np.sqrt(own_var)[..., None])
    inertia = (m * m).sum(-1)
    dof = 3.0 * (n - 1)
    mean = np.stack([inertia + dof * var, g.mean(-1)], axis=-1)
    cov = np.empty((*mean.shape, 2))
    cov[..., 0, 0] = 4.0 * var * inertia + 2.0 * dof * var**2
    cov[..., 0, 1] = (2.0 * var * own_var)[...] * h.mean(-1) + 2.0 * var * (m * slope).mean(-1)
    cov[..., 1, 0] = cov[..., 0, 1]
    cov[..., 1, 1] = _mean_distance_variance(offsets, m, g, slope, h, var, own_var)
    return mean, cov


def _norm_moments(m: Array, s: Array) -> tuple[Array, Array, Array]:
    """E|y|, its derivative by m, and E[1/|y|] for y ~ N(u, s^2 I3) with |u| = m (Maxwell-Boltzmann, shifted)."""
    a = m / s
    small = a < SMALL
    b = np.where(small, 1.0, a)
    e, gauss = erf(b / np.sqrt(2.0)), SQRT_2_PI * np.exp(-0.5 * b * b)
    g = s * np.where(small, 2.0 * SQRT_2_PI * (1.0 + a * a / 6.0), gauss + (b + 1.0 / b) * e)
    slope = np.where(small, SQRT_2_PI * 2.0 * a / 3.0, (1.0 - 1.0 / b**2) * e + gauss / b)
    h = np.where(small, SQRT_2_PI * (1.0 - a * a / 6.0), e / b) / s
    return g, slope, h


def _mean_distance_variance(
    offsets: Array, m: Array, g: Array, slope: Array, h: Array, var: Array, own_var: Array
) -> Array:
    """var(D): own variances, and the members' correlation through the centroid to second order."""
    n = m.shape[-1]
    safe = np.where(m > 0, m, 1.0)
    unit = offsets / safe[..., None]
    cosine = unit @ np.swapaxes(unit, -1, -2)
    s = np.sqrt(own_var)[..., None]
    b = np.where(m < SMALL * s, 2.0 * SQRT_2_PI / (3.0 * s), slope / safe)
    A = (2.0 * h - 2.0 * b) - b
    c = (-var / n)[..., None, None]
    first = c * slope[..., :, None] * slope[..., None, :] * cosine
    AA, Ab, bb = (x[..., :, None] * y[..., None, :] for x, y in ((A, A), (A, b), (b, b)))
    second = 0.5 * c**2 * (AA * cosine**2 + Ab + np.swapaxes(Ab, -1, -2) + 3.0 * bb)
    pairs = first + second
    i = np.arange(n)
    pairs[..., i, i] = m * m + 3.0 * own_var[..., None] - g * g
    out: Array = pairs.sum((-1, -2)) / n**2
    return out
