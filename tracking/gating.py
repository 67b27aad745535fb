"""Chi-square gates: which pairs are close enough, given all that is uncertain, to be one and the same.

The innovation covariance is that of the difference: S_reference + S_observation (and whatever else moves the one
against the other). Leaving the observation's own covariance out makes a nominal 95 % gate hold 78 to 87 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import gammaincinv

from tracking.errors import ParameterError
from tracking.gaussian import LOG_2PI, Array, cholesky, ensure_positive_semidefinite, forward_substitution


class GateReason(IntEnum):
    """Why a pair does not pass a gate, or that it does."""

    ACCEPTED = 0
    DISTANCE = 1  # the Mahalanobis distance exceeds the threshold
    COUNT = 2  # the numbers of members differ, and the gate wants them equal
    INVALID = 3  # the innovation is not finite


@dataclass(frozen=True, slots=True)
class Gate:
    """A chi-square gate and its options.

    Parameters
    ----------
    probability
        Share of true pairs that passes; in (0, 1).
    dof
        Degrees of freedom of the squared distance.
    equal_count
        Refuse pairs whose numbers of members differ (the rule of Chu et al. 2025, section III.F).
    sigma_inflation_m
        Added to every member's standard deviation before the descriptor's covariance is computed (their "padding"), m.

    Raises
    ------
    ParameterError
        A value is out of its range.
    """

    probability: float = 0.99
    dof: int = 2
    equal_count: bool = False
    sigma_inflation_m: float = 0.0

    def __post_init__(self) -> None:
        chi2_threshold(self.dof, self.probability)
        if not (np.isfinite(self.sigma_inflation_m) and self.sigma_inflation_m >= 0):
            raise ParameterError(f"sigma_inflation_m must be a length >= 0, got {self.sigma_inflation_m}")

    @property
    def threshold(self) -> float:
        """The squared Mahalanobis distance up to which a pair passes."""
        return chi2_threshold(self.dof, self.probability)


@dataclass(frozen=True, slots=True, eq=False)
class Gated:
    """What a gate says of pairs: squared distance, log likelihood of the match, and the reason."""

    mahalanobis_sq: Array  # (...)
    log_likelihood: Array  # (...) -1/2 (d2 + log |2 pi S|)
    reasons: NDArray[np.int64]  # (...) GateReason

    @property
    def passed(self) -> NDArray[np.bool_]:
        """True where the pair passes (...)."""
        out: NDArray[np.bool_] = self.reasons == GateReason.ACCEPTED
        return out


@lru_cache(maxsize=1024)
def chi2_threshold(dof: int, probability: float) -> float:
    """The value that a chi-square variable of `dof` degrees of freedom stays below with this probability.

    Raises
    ------
    ParameterError
        `dof` < 1, or a probability outside (0, 1).
    """
    if not dof >= 1:
        raise ParameterError(f"degrees of freedom must be at least 1, got {dof}")
    if not 0.0 < probability < 1.0:
        raise ParameterError(f"a gate's probability must lie in (0, 1), got {probability}")
    return 2.0 * float(gammaincinv(dof / 2.0, probability))


def mahalanobis_sq(innovation: Array, cov: Array) -> Array:
    """Squared Mahalanobis distances v' S^-1 v (...) of innovations (..., d) with covariances (..., d, d).

    Stacks broadcast against each other. A NaN in an innovation gives NaN.

    Raises
    ------
    CovarianceError
        A covariance is not positive definite.
    """
    return _distance_and_log_det(np.asarray(innovation, float), np.asarray(cov, float))[0]


def matching_log_likelihood(innovation: Array, cov: Array) -> Array:
    """Log density -1/2 (v' S^-1 v + log |2 pi S|) (...) of innovations (..., d) under N(0, S).

    Bare distances favour hypotheses with large covariances; compare hypotheses by this.
    """
    innovation = np.asarray(innovation, float)
    d2, log_det = _distance_and_log_det(innovation, np.asarray(cov, float))
    out: Array = -0.5 * (d2 + log_det + innovation.shape[-1] * LOG_2PI)
    return out


def apply_gate(
    gate: Gate,
    innovation: Array,
    cov: Array,
    n_reference: ArrayLike | None = None,
    n_observed: ArrayLike | None = None,
) -> Gated:
    """Distances, likelihoods and reasons for innovations (..., d) with covariances (..., d, d).

    `n_reference` and `n_observed` (...) are the numbers of members, needed where the gate wants them equal.

    Raises
    ------
    ParameterError
        The innovation's length is not the gate's `dof`, or counts are missing.
    CovarianceError
        A covariance is not positive definite.
    """
    innovation = np.asarray(innovation, float)
    if innovation.shape[-1] != gate.dof:
        raise ParameterError(
            f"the gate has {gate.dof} degrees of freedom, the innovation {innovation.shape[-1]} entries"
        )
    d2, log_det = _distance_and_log_det(innovation, np.asarray(cov, float))
    log_likelihood = -0.5 * (d2 + log_det + gate.dof * LOG_2PI)
    return Gated(d2, log_likelihood, gate_reasons(gate, d2, n_reference, n_observed))


def gate_reasons(
    gate: Gate, distance_sq: Array, n_reference: ArrayLike | None = None, n_observed: ArrayLike | None = None
) -> NDArray[np.int64]:
    """Reasons (...) for squared distances (...) that are already known."""
    reasons = np.where(distance_sq <= gate.threshold, GateReason.ACCEPTED, GateReason.DISTANCE).astype(np.int64)
    if gate.equal_count:
        if n_reference is None or n_observed is None:
            raise ParameterError("the gate wants equal numbers of members: give n_reference and n_observed")
        reasons = np.where(np.asarray(n_reference) != np.asarray(n_observed), GateReason.COUNT, reasons)
    out: NDArray[np.int64] = np.where(np.isnan(distance_sq), GateReason.INVALID, reasons).astype(np.int64)
    return out


def inflate(cov: Array, sigma_inflation_m: float) -> Array:
    """Covariances (..., d, d) with `sigma_inflation_m` added to the standard deviation along every principal axis.

    sigma^2 I becomes (sigma + inflation)^2 I, which is the paper's padding of 0.01 by 0.005 to 0.015 m.
    """
    if not (np.isfinite(sigma_inflation_m) and sigma_inflation_m >= 0):
        raise ParameterError(f"sigma_inflation_m must be a length >= 0, got {sigma_inflation_m}")
    values, axes = np.linalg.eigh(ensure_positive_semidefinite(cov))
    grown = (np.sqrt(np.maximum(values, 0.0)) + sigma_inflation_m) ** 2
    out: Array = (axes * grown[..., None, :]) @ np.swapaxes(axes, -1, -2)
    return out


def _distance_and_log_det(v: Array, S: Array) -> tuple[Array, Array]:
    d = v.shape[-1]
    if S.shape[-2:] != (d, d):
        raise ParameterError(f"innovations of {d} entries want covariances ({d}, {d}), got {S.shape[-2:]}")
    if d == 3 and S.ndim > 2:
        return _closed_3(v, S)
    lower = cholesky(S, "innovation covariance")
    whitened = forward_substitution(lower, v)
    log_det = 2.0 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
    return (whitened * whitened).sum(-1), log_det


def _closed_3(v: Array, S: Array) -> tuple[Array, Array]:
    """The same for d = 3, with L D L' written out: one pass over the stack instead of a call a matrix."""
    a, b, c = S[..., 0, 0], S[..., 1, 0], S[..., 2, 0]
    with np.errstate(invalid="ignore", divide="ignore"):
        l10, l20 = b / a, c / a
        d1 = S[..., 1, 1] - l10 * b
        e = S[..., 2, 1] - l20 * b
        l21 = e / d1
        d2 = S[..., 2, 2] - l20 * c - l21 * e
        positive = (a > 0) & (d1 > 0) & (d2 > 0)
    if not positive.all():
        cholesky(S, "innovation covariance")
    w0 = v[..., 0]
    w1 = v[..., 1] - l10 * w0
    w2 = v[..., 2] - l20 * w0 - l21 * w1
    return w0 * w0 / a + w1 * w1 / d1 + w2 * w2 / d2, np.log(a * d1 * d2)
