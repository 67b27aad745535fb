"""The length |y| of a 3-D Gaussian vector: its mean, gradient and curvature with respect to the vector's mean.

With the smoothed length g(u) = E|y|, y ~ N(u, S), the covariance of |y| with anything jointly Gaussian follows from
g's derivatives (Mehler's formula), so these three are all that the moments of the mean distance need.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import erfc

from cluster_slam.geometry import Array

SMALL = 1e-3  # below this length in sigmas the series are exact to 1e-13
REACH = 36.0  # exp(-REACH) = 2e-16
NODES = 48
TAIL = 7.5  # e^(-4 TAIL) = 1e-13
TINY = 1e-200
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
    b = np.maximum(a, SMALL)
    inverse_b = 1.0 / b
    tail, bell = erfc(b * np.sqrt(0.5)), SQRT_2_PI * np.exp(-0.5 * b * b)
    excess = bell + inverse_b - (b + inverse_b) * tail
    inverse = (1.0 - tail) * inverse_b  # s E[1/|y|]
    ratio = (1.0 - tail - inverse_b * inverse + bell * inverse_b) * inverse_b
    if small.any():
        excess = np.where(small, SQRT_2_PI * (2.0 + a * a / 3.0) - a, excess)
        ratio = np.where(small, SQRT_2_PI * (2.0 / 3.0 - a * a / 15.0), ratio)
        inverse = np.where(small, SQRT_2_PI * (1.0 - a * a / 6.0), inverse)
    ratio = ratio / s
    return RadialLength(s * excess, ratio * m, ratio, 2.0 * inverse / s - 2.0 * ratio)


def length(u: Array, S: Array) -> Length:
    """The same for any covariance: one-dimensional integrals by the trapezoidal rule, to about 1e-8.

    From |y| = 1/(2 sqrt pi) int (1 - e^(-t y'y)) t^(-3/2) dt and E e^(-t y'y), with t = (s sinh x)^2: in x the
    integrands are even, decay at least as e^(-4x), and have their poles pi/2 away from the real axis whatever the
    eigenvalues of S, so that the error falls exponentially with the number of nodes.

    Parameters
    ----------
    u, S
        (..., 3) and positive semidefinite (..., 3, 3); not both zero.
    """
    values, axes = np.linalg.eigh(S)
    values = np.maximum(values, 0.0)
    m = (u[..., None, :] @ axes)[..., 0, :]
    m_sq = (m * m).sum(-1)
    t, w = _nodes(m_sq, values)
    p = 1.0 / (1.0 + 2.0 * t[..., None] * values[..., None, :])  # (..., q, 3)
    w = w * np.exp(-t * (m[..., None, :] ** 2 * p).sum(-1)) * np.sqrt(p.prod(-1))
    diagonal = (w[..., None] * p).sum(-2)
    outer = np.swapaxes(p, -1, -2) @ ((w * t)[..., None] * p)
    hessian = diagonal[..., None] * np.eye(3) - 2.0 * m[..., :, None] * m[..., None, :] * outer
    own = (values * np.diagonal(hessian, axis1=-2, axis2=-1)).sum(-1)
    excess = (m * m * diagonal).sum(-1) - np.sqrt(m_sq) + own  # E|y| = u . grad g + tr(S hess g), by Stein's lemma
    back = np.swapaxes(axes, -1, -2)
    return Length(excess, ((m * diagonal)[..., None, :] @ back)[..., 0, :], axes @ hessian @ back)


def _nodes(m_sq: Array, values: Array) -> tuple[Array, Array]:
    """Values of t (..., q) and weights of 2 / sqrt(pi) d(sqrt t)."""
    largest, smallest = values[..., 2] + TINY, values[..., 0]
    s = np.minimum(1.0 / np.sqrt(2.0 * largest), 0.5 / np.sqrt(m_sq + TINY))
    tail = (
        TAIL + 0.5 * np.log(np.minimum(largest / (smallest + TINY), 1e12)) - np.log(s * np.sqrt(2.0 * largest) + TINY)
    )
    bell = np.maximum(m_sq - 2.0 * REACH * largest, TINY)  # the exponential reaches REACH only where this is positive
    end = np.minimum(np.arcsinh(np.sqrt(REACH / bell) / s), tail)
    step = end / NODES
    x = step[..., None] * np.arange(NODES + 1)
    weights = (2.0 / np.sqrt(np.pi)) * (s * step)[..., None] * np.cosh(x)
    weights[..., 0] *= 0.5
    return (s[..., None] * np.sinh(x)) ** 2, weights
