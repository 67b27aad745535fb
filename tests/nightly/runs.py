"""Runs of one world over several seeds, and figures pooled over them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache
from time import process_time

import numpy as np
from oracle import smooth_with_truth

from cluster_slam import evaluate, smooth
from cluster_slam.evaluation import Metrics
from cluster_slam.simulate import PRESETS, Simulated, simulate_session


@dataclass(frozen=True, slots=True)
class Run:
    """What came of one simulated session. Seconds are of the processor, so that a busy machine does not matter."""

    preset: str
    seed: int
    status: str
    metrics: Metrics
    seconds: float
    n_observations: int
    noise_ratio: dict[str, float]  # estimated over true standard deviation


@cache
def run(preset: str, seed: int) -> Run:
    """Simulate, smooth and evaluate; each world and seed only once."""
    made = simulate_session(PRESETS[preset], seed=seed)
    begin = process_time()
    result = smooth(made.session)
    seconds = process_time() - begin
    metrics = evaluate(result, made.session, made.truth)
    ratio = _noise_ratio(made, result.diagnostics.estimated_noise)
    return Run(preset, seed, result.status, metrics, seconds, len(made.session.observations), ratio)


@cache
def oracle(preset: str, seed: int) -> Metrics:
    """The same with the true association."""
    made = simulate_session(PRESETS[preset], seed=seed)
    return evaluate(smooth_with_truth(made.session, made.truth), made.session, made.truth)


def _noise_ratio(made: Simulated, estimated: dict[str, float]) -> dict[str, float]:
    """Estimated standard deviations over the true ones: those stated without the factor that they are wrong by."""
    factor = made.config.stated_sigma_factor
    names = ["pose_translation", "pose_rotation", "flower"]
    stated = made.session.noise
    return {name: estimated[name] * factor / getattr(stated, name) for name in names if name in estimated}


def runs(preset: str, seeds: Sequence[int]) -> list[Run]:
    """One run a seed."""
    return [run(preset, seed) for seed in seeds]


def worst(values: Sequence[Run], name: str) -> float:
    """The least value of a metric over the runs."""
    return min(float(getattr(r.metrics, name)) for r in values)


def rms(metrics: Sequence[Metrics], name: str) -> float:
    """Root mean square of a metric over the seeds."""
    each = np.array([getattr(m, name) for m in metrics], dtype=float)
    return float(np.sqrt(np.nanmean(each**2)))


def pooled(metrics: Sequence[Metrics], name: str, weight: Callable[[Metrics], int | None]) -> float:
    """Mean of a metric over the seeds, each with its number of landmarks (zero where nothing could be compared)."""
    known = [(float(getattr(m, name)), weight(m) or 0) for m in metrics if getattr(m, name) is not None]
    each, weights = np.array(known, dtype=float).T
    return float(np.average(each, weights=weights))
