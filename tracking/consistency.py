"""Are the covariances true? Normalised squared errors with the bands that they must lie in.

Bar-Shalom, Li, Kirubarajan, "Estimation with applications to tracking and navigation" (2001), section 5.4.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import bdtr, gammaincinv

from tracking.errors import ParameterError
from tracking.gating import chi2_threshold, mahalanobis_sq
from tracking.gaussian import Array


@dataclass(frozen=True, slots=True)
class Band:
    """An interval that a statistic lies in with the probability stated, if the covariances are true."""

    low: float
    high: float

    def __contains__(self, value: float) -> bool:
        return self.low <= value <= self.high


@dataclass(frozen=True, slots=True)
class Coverage:
    """The share of errors inside their ellipsoid, and the band of that share."""

    share: float
    n: int
    probability: float  # nominal
    band: Band

    @property
    def is_consistent(self) -> bool:
        """Whether the share lies in its band."""
        return self.share in self.band


def nees(errors: Array, covs: Array) -> Array:
    """Normalised estimation errors squared e' P^-1 e (...) of errors (..., d) (estimate minus truth)."""
    return mahalanobis_sq(errors, covs)


def nis(innovations: Array, covs: Array) -> Array:
    """Normalised innovations squared v' S^-1 v (...) of innovations (..., d) (measured minus predicted)."""
    return mahalanobis_sq(innovations, covs)


def mean_band(dof: int, n: int, probability: float = 0.95) -> Band:
    """Two-sided band of the mean of n independent chi-square variables of `dof` degrees of freedom (eq. 5.4.2-18)."""
    _check(n, probability)
    if dof < 1:
        raise ParameterError(f"degrees of freedom must be at least 1, got {dof}")
    tail = 0.5 * (1.0 - probability)
    low, high = 2.0 * gammaincinv(0.5 * dof * n, [tail, 1.0 - tail]) / n
    return Band(float(low), float(high))


def share_band(probability: float, n: int, confidence: float = 0.95) -> Band:
    """Two-sided band of the share of n independent trials that succeed, each with this probability (binomial)."""
    _check(n, confidence)
    if not 0.0 < probability < 1.0:
        raise ParameterError(f"the probability of a trial must lie in (0, 1), got {probability}")
    tail = 0.5 * (1.0 - confidence)
    return Band(_binomial_quantile(tail, n, probability) / n, _binomial_quantile(1.0 - tail, n, probability) / n)


def coverage(normalised_sq: Array, dof: int, probability: float = 0.95, confidence: float = 0.95) -> Coverage:
    """The share of normalised squared errors (n,) inside the ellipsoid of this probability, with its band."""
    values = np.asarray(normalised_sq, dtype=float).ravel()
    share = float(np.mean(values <= chi2_threshold(dof, probability))) if len(values) else float("nan")
    return Coverage(share, len(values), probability, share_band(probability, len(values), confidence))


def _binomial_quantile(q: float, n: int, p: float) -> int:
    """The least k with P(X <= k) >= q, X ~ Binomial(n, p), by bisection."""
    low, high = -1, n
    while high - low > 1:
        middle = (low + high) // 2
        if bdtr(middle, n, p) >= q:
            high = middle
        else:
            low = middle
    return high


def _check(n: int, probability: float) -> None:
    if n < 1:
        raise ParameterError(f"a band needs at least one sample, got {n}")
    if not 0.0 < probability < 1.0:
        raise ParameterError(f"a band's probability must lie in (0, 1), got {probability}")
