"""The geometry gate of one cluster, made true where its members could be taken for one another.

The squared distance of the best map is chi-square with 3 n - 6 degrees of freedom only while the members lie many
sigmas apart. Nearer, a wrong map often fits better than the right one, and the plain gate holds more than it says: 98
to 100 % instead of 95 % at a radius of three sigmas. Trials with the cluster itself show how much.
"""

from __future__ import annotations

import numpy as np
from scipy.special import gammaincinv

from cluster_slam.descriptors.geometries import match_geometries
from cluster_slam.descriptors.members import centred, checked_points, checked_sigma
from cluster_slam.errors import InputError
from cluster_slam.geometry import Array
from tracking.gating import chi2_threshold

N_TRIALS = 200


def calibrated_threshold(
    points: Array,
    sigma_reference: float,
    sigma_observed: float,
    probability: float,
    *,
    rng: np.random.Generator,
    n_trials: int = N_TRIALS,
) -> float:
    """The squared distance that a true match stays below with this probability, for this cluster.

    A gamma distribution with the mean and variance of the trials, which is chi-square where no two members can be
    confused.

    Parameters
    ----------
    points
        The reference as observed (n, 3), n >= 2, m.
    sigma_reference, sigma_observed
        Standard deviations of the members' errors along each axis, m.
    probability
        In (0, 1).
    rng
        For the trials.
    n_trials
        200 give the coverage to about one percent.

    Raises
    ------
    InputError
        Fewer than two flowers, a sigma that is not positive, or fewer than 10 trials.
    ParameterError
        A probability outside (0, 1).
    """
    chi2_threshold(1, probability)
    if n_trials < 10:
        raise InputError(f"a calibration needs at least 10 trials, got {n_trials}")
    one, two = float(checked_sigma(sigma_reference)), float(checked_sigma(sigma_observed))
    shape = _without_noise(centred(checked_points(points)), one)
    a = shape + one * rng.standard_normal((n_trials, *shape.shape))
    b = shape + two * rng.standard_normal((n_trials, *shape.shape))
    distance_sq = match_geometries(a, b, float(np.hypot(one, two))).distance_sq
    mean, variance = float(distance_sq.mean()), float(distance_sq.var(ddof=1))
    return float(gammaincinv(mean**2 / variance, probability)) * variance / mean


def _without_noise(offsets: Array, sigma: float) -> Array:
    """Errors make a cluster look larger; the offsets shrunk by what they add on average to the inertia."""
    inertia = float((offsets * offsets).sum())
    added = 3.0 * (len(offsets) - 1) * sigma**2
    return offsets * np.sqrt(max(1.0 - added / inertia, 0.0)) if inertia > 0 else offsets
