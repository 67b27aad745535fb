"""Runs of one world over several seeds, and figures pooled over them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache
from time import process_time

import numpy as np
from oracle import smooth_with_truth
from scipy.ndimage import maximum_filter1d

from cluster_slam import evaluate, smooth
from cluster_slam.evaluation import Metrics
from cluster_slam.evaluation.landmarks import flower_errors, matched_rest
from cluster_slam.geometry import Array
from cluster_slam.records import Result
from cluster_slam.simulate import PRESETS, Simulated, simulate_session
from tracking.metrics import identity_scores

_HALF_SWING_S = 0.4
_SWAYED_M = 0.002  # seven times what moves at all times


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
    nees_swayed: Array  # of each flower that was seen only while it swayed, over its dimension


@cache
def run(preset: str, seed: int, duration_s: float | None = None) -> Run:
    """Simulate, smooth and evaluate; each world and seed only once."""
    usual = PRESETS[preset]
    made = simulate_session(usual if duration_s is None else replace(usual, duration_s=duration_s), seed=seed)
    begin = process_time()
    result = smooth(made.session)
    seconds = process_time() - begin
    metrics = evaluate(result, made.session, made.truth)
    ratio = _noise_ratio(made, result.diagnostics.estimated_noise)
    n = len(made.session.observations)
    return Run(preset, seed, result.status, metrics, seconds, n, ratio, _nees_swayed(made, result))


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


def _nees_swayed(made: Simulated, result: Result) -> Array:
    """NEES over its dimension of flowers all of whose observations were made within half a swing of 2 mm or more."""
    truth = made.truth
    assert truth.flower_ids is not None
    reach = 2 * round(_HALF_SWING_S * made.config.fps) + 1
    swayed = maximum_filter1d(np.linalg.norm(made.motion.displacements, axis=-1), reach, axis=0) > _SWAYED_M
    real = np.flatnonzero((truth.flower_ids >= 0) & (result.flower_ids >= 0))
    cluster = made.plant.flower_cluster[truth.flower_ids[real]]
    calm = ~swayed[made.session.observations.frame[real], cluster]
    seen_calm = np.bincount(result.flower_ids[real], calm, minlength=int(result.flowers.ids.max(initial=-1)) + 1)
    errors = flower_errors(
        result.flowers, matched_rest(result.flowers, identity_scores(truth.flower_ids, result.flower_ids), truth)
    )
    only: Array = errors.nees[seen_calm[result.flowers.ids[errors.index]] == 0]
    return only


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
