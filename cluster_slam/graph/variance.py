"""How large the errors of a session really are, from the residuals of its own smoothing.

A residual is smaller than the error that made it, because the unknowns follow the errors; what each group of
measurements keeps is its redundancy (Foerstner 1979; Helmert's variance components). The ratio of a group's squared
residuals to its redundancy is the factor by which its stated variance is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, inverse, se3_log
from cluster_slam.graph.batch import BatchSmoother, Estimate
from cluster_slam.graph.innovations import frame_posterior
from cluster_slam.records import BoolArray

_LAGS = (1, 2, 3, 5, 8, 13, 21, 34, 55, 89, 144, 233, 377, 610, 987)
_CHI2_3_AT_10 = 0.584  # 10 % quantile of chi-square with three degrees of freedom
_GATE_CHI2 = 16.0
_IN_MOTION = 1.01  # times the sigma of clusters at rest
_LEAST_WHITE = 0.17  # share of the stated variance that changes from frame to frame; sigmas wrong by two leave 0.25


@dataclass(frozen=True, slots=True)
class VarianceFactors:
    """Factors on stated variances: of flowers, of poses, and how many observations in a row say the same thing.

    ``sway``: on the squared displacements that clusters in motion are thought to have. ``pose_correlation``: how many
    given poses in a row err alike, as where an arm's own errors change slowly, or sway that all clusters share.
    """

    flower: float
    pose: float
    correlation: float
    sway: float = 1.0
    pose_correlation: float = 1.0


def variance_factors(smoother: BatchSmoother, estimate: Estimate) -> VarianceFactors:
    """Factors by which the stated variances should be multiplied, at a solved estimate."""
    used = estimate.weight[smoother.rows] > 0.5
    A_z, A_d, residual = smoother.whitened(estimate)
    prior = smoother.pose_information(estimate)
    n = len(estimate.T)
    free_poses, of_displacement = _taken_up(smoother, A_z, A_d, used, prior)
    redundancy_flower = 3.0 * (int(used.sum()) - smoother.n_places) - free_poses - float(of_displacement.sum())
    redundancy_pose = free_poses
    flower = _ratio(float((residual[used] ** 2).sum()), redundancy_flower)
    pose, in_a_row = 1.0, 1.0
    if smoother.poses.cov_step is None:
        predicted = smoother.poses.given if estimate.X is None else smoother.poses.given @ estimate.X
        error = se3_log(inverse(predicted) @ estimate.T)
        seen = np.bincount(smoother.frame[used], minlength=n) > 0
        white = np.where(seen[:, None], np.einsum("nji,nj->ni", np.linalg.cholesky(prior), error), 0.0)
        pose = _ratio(float((white**2).sum()), redundancy_pose)
        common = _integrated_autocorrelation(white.reshape(n, 2, 3), np.tile(seen[:, None], 2).astype(np.float64))
        # Only the share that poses take of what is measured is seen of their errors; noise of flowers is white in it.
        in_a_row = 1.0 + (common - 1.0) * 6.0 * n / max(free_poses, 1.0)
    sway = _ratio(*_of_sway(smoother, estimate, of_displacement))
    return VarianceFactors(flower, pose, _correlation_factor(smoother, residual, used, n), sway, in_a_row)


def _of_sway(smoother: BatchSmoother, estimate: Estimate, taken: Array) -> tuple[float, float]:
    """Squares of displacements in motion over what they are thought to be, and their degrees of freedom."""
    sigma = smoother.pairs.total_sigma
    moving = sigma > _IN_MOTION * sigma.min(initial=np.inf)
    return float(((estimate.d[moving] / sigma[moving, None]) ** 2).sum()), float(taken[moving].sum())


def errs_slowly(smoother: BatchSmoother, given: Estimate) -> bool:
    """Whether it is the observations that err slowly (a detector's bias changes with the view), not the given poses.

    Two things together say so: at the poses as they are given many residuals are no larger than an association gate
    lets through, and from frame to frame they change far less than the stated noise would make them. Low quantiles
    are compared, since such detectors also jump.
    """
    residual, _ = smoother.residuals(given)
    chi2 = (residual**2).sum(axis=1)
    if len(chi2) < 30 or float(np.quantile(chi2, 0.25)) > _GATE_CHI2:
        return False
    order = np.lexsort((smoother.frame, smoother.landmark))
    same = np.diff(smoother.landmark[order]) == 0
    change = (np.diff(residual[order], axis=0)[same] ** 2).sum(axis=1)
    return len(change) >= 30 and float(np.quantile(change, 0.1)) < _LEAST_WHITE * 2.0 * _CHI2_3_AT_10


def _taken_up(smoother: BatchSmoother, A_z: Array, A_d: Array, used: BoolArray, prior: Array) -> tuple[float, Array]:
    """Degrees of freedom that the poses (6 each) and each displacement (p,) (3) take from the observations.

    What an unknown's posterior keeps of its prior it has not taken; what nothing was seen of takes none.
    """
    posterior = frame_posterior(smoother, A_z, A_d, used, prior)
    kept = np.trace(posterior.displacement, axis1=1, axis2=2) / smoother.pairs.total_sigma**2
    return 6.0 * len(prior) - float((posterior.pose * prior).sum()), 3.0 - kept


def _ratio(square: float, redundancy: float) -> float:
    return float(np.clip(square / redundancy, 1e-3, 1e4)) if redundancy > 30.0 else 1.0


def _correlation_factor(smoother: BatchSmoother, residual: Array, used: BoolArray, n: int) -> float:
    """How many residuals of one flower in a row count as one."""
    series = np.zeros((n, smoother.n_places, 3))
    seen = np.zeros((n, smoother.n_places))
    at = (smoother.frame[used], smoother.landmark[used])
    series[at] = residual[used]
    seen[at] = 1.0
    return _integrated_autocorrelation(series, seen)


def _integrated_autocorrelation(series: Array, seen: Array) -> float:
    """1 + 2 sum of the autocorrelation of series (n, s, 3), zero where not ``seen``, to the lag at which it is lost."""
    n = len(series)
    power = float((series**2).sum() / max(3.0 * seen.sum(), 1.0))
    total, last_lag, last_value = 1.0, 0, 1.0
    for lag in _LAGS:
        count = float((seen[lag:] * seen[:-lag]).sum()) if lag < n else 0.0
        if count < 30 or power <= 0.0:
            break
        value = float((series[lag:] * series[:-lag]).sum()) / (3.0 * count * power)
        if value < 2.0 / np.sqrt(3.0 * count):
            break
        # Lags between are interpolated; lag zero itself counts once and is in the leading one.
        between = lag - last_lag
        total += 2.0 * (value + (between - 1) * 0.5 * (value + min(last_value, 2.0 * value)))
        last_lag, last_value = lag, value
    return total
