"""Table I: the unscented transform of three flowers against Monte Carlo, at five noise levels."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.descriptors import (
    closed_form_moments,
    inertia_and_mean_distance,
    isotropic,
    unscented_moments,
)
from cluster_slam.geometry import Array
from cluster_slam.reproduce.matlab_rng import MatlabStream
from cluster_slam.reproduce.settings import N_SAMPLES, PROBABILITY, SEED, Settings
from tracking.gating import chi2_threshold, mahalanobis_sq

N_FLOWERS = 3


@dataclass(frozen=True, slots=True)
class NoiseRow:
    """One row of table I, and what the exact moments say of it."""

    noise: float  # m
    frobenius_norm: float  # |C_unscented - C_monte_carlo|
    outlier_percent: float  # of the draws, outside the unscented gate
    transform_error: float  # |C_unscented - C_exact|
    sampling_error: float  # |C_monte_carlo - C_exact|
    exact_outlier_percent: float  # outside the gate of the exact moments


def table1(settings: Settings, n_samples: int = N_SAMPLES) -> list[NoiseRow]:
    """The rows of table I. The stream starts anew for every level: `rng(1); X = rand(3, 3)`, then `randn(3, 3)`s."""
    stream = MatlabStream(SEED)
    points = settings.scale * stream.rand(N_FLOWERS, 3)
    draws = np.moveaxis(stream.randn(N_FLOWERS, 3, n_samples), -1, 0)
    return [_row(settings, points, draws, noise) for noise in settings.noise_levels]


def _row(settings: Settings, points: Array, draws: Array, noise: float) -> NoiseRow:
    values = inertia_and_mean_distance(points + noise * draws)
    sampled = np.cov(values.T)
    mean, cov = unscented_moments(points, isotropic(N_FLOWERS, noise), settings.rule)
    exact_mean, exact_cov = closed_form_moments(points, noise)
    return NoiseRow(
        noise,
        float(np.linalg.norm(cov - sampled)),
        _outlier_percent(values - mean, cov),
        float(np.linalg.norm(cov - exact_cov)),
        float(np.linalg.norm(sampled - exact_cov)),
        _outlier_percent(values - exact_mean, exact_cov),
    )


def _outlier_percent(innovations: Array, cov: Array) -> float:
    return 100.0 * float((mahalanobis_sq(innovations, cov) > chi2_threshold(2, PROBABILITY)).mean())
