"""The unscented transform: mean and covariance of a function of a Gaussian from a few chosen points.

Written in differences to the central point, which is exact algebra and loses nothing for a small spread: with
d_i = f(x_i) - f(x_0) and m = w sum_i d_i,

    mean = f(x_0) + m,    cov = w sum_i d_i d_i' + (beta - alpha^2) m m',    w = 1 / (2 alpha^2 (L + kappa)),

which is the scaled transform of Julier (2002) and Wan and van der Merwe (2001) without its large weights of opposite
sign. Stacks of distributions are transformed at once.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from tracking.errors import ParameterError
from tracking.gaussian import Array, cholesky, symmetrise


@dataclass(frozen=True, slots=True)
class SigmaRule:
    """Parameters of the scaled unscented transform.

    Parameters
    ----------
    alpha
        Spread of the points, > 0. Numerically 0.1 to 1 is best.
    beta
        Weight of the mean shift's square in the covariance. 2 makes the variance of a square of *one* Gaussian
        exact; a sum of d independent ones wants 2 / d.
    kappa
        Second spread parameter; L + kappa must be > 0.
    """

    alpha: float = 1.0
    beta: float = 2.0
    kappa: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.alpha) and self.alpha > 0):
            raise ParameterError(f"alpha must be > 0, got {self.alpha}: at 0 all sigma points coincide")
        if not (np.isfinite(self.beta) and np.isfinite(self.kappa)):
            raise ParameterError(f"beta and kappa must be finite, got {self.beta} and {self.kappa}")

    def spread_sq(self, length: int) -> float:
        """L + lambda = alpha^2 (L + kappa)."""
        if not length + self.kappa > 0:
            raise ParameterError(f"L + kappa must be > 0, got L = {length}, kappa = {self.kappa}")
        return self.alpha**2 * (length + self.kappa)

    def weights(self, length: int) -> tuple[Array, Array]:
        """Weights (2 L + 1,) of the mean and of the covariance as they are usually printed."""
        spread = self.spread_sq(length)
        mean = np.full(2 * length + 1, 0.5 / spread)
        mean[0] = 1.0 - length / spread
        cov = mean.copy()
        cov[0] += 1.0 - self.alpha**2 + self.beta
        return mean, cov


CUBATURE = SigmaRule(alpha=1.0, beta=0.0, kappa=0.0)  # the third-degree spherical rule of Arasaratnam, Haykin (2009)


def sigma_points(mean: Array, cov: Array, rule: SigmaRule, factor: Array | None = None) -> Array:
    """Sigma points (..., 2 L + 1, L): the mean, mean + h c_j, mean - h c_j.

    The c_j are the columns of `factor` (..., L, L), any F with F F' = cov; without it, of the Cholesky factor.

    Raises
    ------
    CovarianceError
        A covariance is not positive definite.
    """
    mean, cov = np.asarray(mean, float), np.asarray(cov, float)
    length = mean.shape[-1]
    if cov.shape[-2:] != (length, length):
        raise ParameterError(f"a mean of {length} entries wants covariances ({length}, {length}), got {cov.shape[-2:]}")
    steps = np.sqrt(rule.spread_sq(length)) * np.swapaxes(cholesky(cov) if factor is None else factor, -1, -2)
    centre = mean[..., None, :]
    shape = np.broadcast_shapes((*mean.shape[:-1], length, length), steps.shape)
    full = np.broadcast_to(centre, (*shape[:-2], 1, length))
    return np.concatenate([full, centre + steps, centre - steps], axis=-2)


def combine(values: Array, rule: SigmaRule, length: int, beta: Array | None = None) -> tuple[Array, Array]:
    """Mean (..., m) and covariance (..., m, m) from the function's values (..., 2 L + 1, m) at the sigma points.

    `beta` (...) overrides the rule's, one for each distribution of the stack.
    """
    weight = 0.5 / rule.spread_sq(length)
    centre = values[..., 0, :]
    delta = values[..., 1:, :] - centre[..., None, :]
    shift = weight * (delta[..., :length, :] + delta[..., length:, :]).sum(-2)
    curvature = (rule.beta if beta is None else np.asarray(beta)[..., None, None]) - rule.alpha**2
    cov = weight * (np.swapaxes(delta, -1, -2) @ delta) + curvature * shift[..., :, None] * shift[..., None, :]
    return centre + shift, symmetrise(cov)


def unscented_transform(
    mean: Array,
    cov: Array,
    function: Callable[[Array], Array],
    rule: SigmaRule,
    beta: Array | None = None,
    factor: Array | None = None,
) -> tuple[Array, Array]:
    """Mean and covariance of `function(x)` for x ~ N(mean, cov).

    Parameters
    ----------
    mean, cov
        (..., L) and (..., L, L).
    function
        Takes points (..., L), gives values (..., m); called once with all points of all distributions.
    rule
        Spread and weights.
    beta
        (...) overrides the rule's, one for each distribution.
    factor
        (..., L, L), any F with F F' = cov; None: the Cholesky factor. A symmetric root allows a singular covariance.

    Returns
    -------
    mean (..., m), cov (..., m, m)

    Raises
    ------
    CovarianceError
        A covariance is not positive definite.
    ParameterError
        Shapes do not fit.
    """
    points = sigma_points(mean, cov, rule, factor)
    return combine(np.asarray(function(points), float), rule, points.shape[-1], beta)


def fifth_degree(mean: Array, cov: Array, function: Callable[[Array], Array]) -> tuple[Array, Array]:
    """Mean and covariance by the cubature rule that integrates polynomials up to the fifth degree exactly.

    2 L^2 + 1 points instead of 2 L + 1: the mean is exact for a function of the fifth degree, the covariance for one of
    the second, whatever the dimension, which no choice of alpha, beta and kappa achieves (McNamee, Stenger 1967; Jia,
    Xin, Cheng 2013). Shapes as in `unscented_transform`; some weights are negative from L = 5 on, so that a covariance
    is not positive definite by construction.

    Raises
    ------
    CovarianceError
        A covariance is not positive definite.
    """
    mean = np.asarray(mean, float)
    directions, weights = _fifth_degree_rule(mean.shape[-1])
    factor = cholesky(np.asarray(cov, float))
    values = np.asarray(function(mean[..., None, :] + directions @ np.swapaxes(factor, -1, -2)), float)
    centre = np.asarray(function(mean), float)
    delta = values - centre[..., None, :]
    shift = (weights[:, None] * delta).sum(-2)
    second = np.swapaxes(delta, -1, -2) @ (weights[:, None] * delta)
    return centre + shift, symmetrise(second - shift[..., :, None] * shift[..., None, :])


@lru_cache(maxsize=32)
def _fifth_degree_rule(length: int) -> tuple[Array, Array]:
    """Points (2 L^2, L) other than the origin, for the standard normal, and their weights."""
    spread = np.sqrt(length + 2.0)
    axes = spread * np.concatenate([np.eye(length), -np.eye(length)])
    pairs = [
        s * np.eye(length)[i] + t * np.eye(length)[j]
        for i in range(length)
        for j in range(i + 1, length)
        for s in (1.0, -1.0)
        for t in (1.0, -1.0)
    ]
    diagonals = spread / np.sqrt(2.0) * np.array(pairs).reshape(-1, length)
    on_axes = (4.0 - length) / (2.0 * (length + 2.0) ** 2)
    weights = np.concatenate([np.full(len(axes), on_axes), np.full(len(diagonals), 1.0 / (length + 2.0) ** 2)])
    return np.concatenate([axes, diagonals]), weights
