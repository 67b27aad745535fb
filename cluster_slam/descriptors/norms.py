"""The length |y| of a 3-D Gaussian vector: its mean, gradient and curvature with respect to the vector's mean.

With the smoothed length g(u) = E|y|, y ~ N(u, S), the covariance of |y| with anything jointly Gaussian follows from
g's derivatives (Mehler's formula), so these three are all that the moments of the mean distance need.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from scipy.special import erf, erfc

from cluster_slam.geometry import Array

SMALL = 1e-3  # below this length in sigmas the series are exact to 1e-13
REACH = 6.5  # exp(-REACH^2) = 5e-19
NODES = 24
TINY = 1e-300
SQRT_2_PI = float(np.sqrt(2.0 / np.pi))


@dataclass(frozen=True, slots=True, eq=False)
class RadialLength:
    """Length of y ~ N(u, s^2 I): everything depends on m = |u| alone."""

    excess: Array  # (...) E|y| - m
    slope: Array  # (...) dg/dm
    slope_ratio: Array  # (...) (dg/dm) / m
    curvature: Array  # (...) d2g/dm2


@dataclass(frozen=True, slots=True, eq=False)
class Length:
    """Length of y ~ N(u, S) with any covariance."""

    excess: Array  # (...) E|y| - |u|
    gradient: Array  # (..., 3) of g
    hessian: Array  # (..., 3, 3) of g


def radial_length(m: Array, s: Array) -> RadialLength:
    """Closed form for isotropic errors (shifted Maxwell distribution); m >= 0 and s > 0 broadcast.

    g = s [sqrt(2/pi) e^(-a^2/2) + (a + 1/a) erf(a/sqrt 2)] with a = m / s, and its Laplacian is 2 E[1/|y|].
    """
    a = m / s
    small = a < SMALL
    b = np.where(small, 1.0, a)
    e, tail, bell = erf(b / np.sqrt(2.0)), erfc(b / np.sqrt(2.0)), SQRT_2_PI * np.exp(-0.5 * b * b)
    excess = s * np.where(small, SQRT_2_PI * (2.0 + a * a / 3.0) - a, bell + e / b - b * tail)
    ratio = np.where(small, SQRT_2_PI * (2.0 / 3.0 - a * a / 15.0), ((1.0 - 1.0 / b**2) * e + bell / b) / b) / s
    inverse = np.where(small, SQRT_2_PI * (1.0 - a * a / 6.0), e / b) / s
    return RadialLength(excess, ratio * m, ratio, 2.0 * inverse - 2.0 * ratio)


def length(u: Array, S: Array) -> Length:
    """The same for any covariance: one-dimensional integrals over 24 Gauss-Legendre nodes.

    From |y| = 1/(2 sqrt pi) int (1 - e^(-t y'y)) t^(-3/2) dt and the characteristic function of a quadratic form, with
    t = v^2 / (1 - 2 l v^2), l the largest eigenvalue of S, which makes the integrand smooth on a finite interval.

    Parameters
    ----------
    u, S
        (..., 3) and positive semidefinite (..., 3, 3), S not zero.
    """
    values, axes = np.linalg.eigh(S)
    values = np.maximum(values, 0.0)
    m = (u[..., None, :] @ axes)[..., 0, :]
    m_sq = (m * m).sum(-1)
    nodes, weights = _legendre()
    end = np.minimum(1.0 / np.sqrt(2.0 * values[..., 2] + TINY), REACH / np.sqrt(m_sq + TINY))
    v2 = (end[..., None] * nodes) ** 2
    shrink = 1.0 - 2.0 * values[..., 2, None] * v2
    rest = 1.0 - 2.0 * (values[..., 2, None, None] - values[..., None, :]) * v2[..., None]
    density = np.exp(-(m[..., None, :] ** 2 * v2[..., None] / rest).sum(-1)) / np.sqrt(rest.prod(-1))
    w = (2.0 / np.sqrt(np.pi)) * end[..., None] * weights * density
    diagonal = ((w * shrink)[..., None] / rest).sum(-2)
    outer = np.swapaxes(1.0 / rest, -1, -2) @ ((w * shrink * v2)[..., None] / rest)
    hessian = diagonal[..., None] * np.eye(3) - 2.0 * m[..., :, None] * m[..., None, :] * outer
    own = (values * np.diagonal(hessian, axis1=-2, axis2=-1)).sum(-1)
    excess = (m * m * diagonal).sum(-1) - np.sqrt(m_sq) + own  # E|y| = u . grad g + tr(S hess g), by Stein's lemma
    back = np.swapaxes(axes, -1, -2)
    return Length(excess, ((m * diagonal)[..., None, :] @ back)[..., 0, :], axes @ hessian @ back)


@lru_cache(maxsize=1)
def _legendre() -> tuple[Array, Array]:
    """Nodes and weights of Gauss and Legendre on [0, 1]."""
    x, w = np.polynomial.legendre.leggauss(NODES)
    return 0.5 * (x + 1.0), 0.5 * w
