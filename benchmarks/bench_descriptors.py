"""Descriptors and gates: moments against filterpy's loop and Monte Carlo, all-pairs gates against the memory's speed.

filterpy and Monte Carlo are timed on a part of the clusters, each cluster takes them equally long.
"""

from __future__ import annotations

import tracemalloc
from collections.abc import Callable
from time import process_time

import numpy as np
from figure import Figure
from filterpy.kalman import MerweScaledSigmaPoints, unscented_transform
from numpy.typing import NDArray

from cluster_slam.descriptors import (
    closed_form_moments,
    descriptor_moments,
    inertia_and_mean_distance,
    isotropic,
    match_geometries,
    match_geometry,
    unscented_moments,
)
from tracking.allpairs import gate_all
from tracking.gating import Gate

Array = NDArray[np.float64]
N_CLUSTERS, N_FLOWERS, SIGMA, N_SAMPLES = 10_000, 6, 0.01, 10_000
GIGABYTE = 1e9


def measure(quick: bool) -> list[Figure]:
    """Seconds for all clusters, and ratios; ``quick``: fewer of the slow ones."""
    rng = np.random.default_rng(0)
    points = 0.1 * rng.random((N_CLUSTERS, N_FLOWERS, 3))
    return [*_moments(points, quick, rng=rng), *_gates(points, rng=rng), *_geometry(points, rng=rng)]


def _moments(points: Array, quick: bool, *, rng: np.random.Generator) -> list[Figure]:
    cov = isotropic(N_FLOWERS, SIGMA)
    ours = _seconds(lambda: closed_form_moments(points, SIGMA), 7)
    n_loop, n_sampled = (100, 5) if quick else (600, 30)
    loop = _seconds(lambda: _filterpy_loop(points[:n_loop], cov), 2) * N_CLUSTERS / n_loop
    sampled = _seconds(lambda: _monte_carlo(points[:n_sampled], rng=rng), 2) * N_CLUSTERS / n_sampled
    return [
        Figure("moments of 10,000 clusters of 6: closed form", ours, "s"),
        Figure("  any covariance of the members", _seconds(lambda: descriptor_moments(points, cov), 2), "s"),
        Figure("  unscented transform", _seconds(lambda: unscented_moments(points, cov), 3), "s"),
        Figure("  filterpy, one by one", loop, "s"),
        Figure("  Monte Carlo, 10,000 samples", sampled, "s"),
        Figure("  closed form over filterpy", ours / loop, "times", 1 / 400),
        Figure("  closed form over Monte Carlo", ours / sampled, "times", 1 / 2000),
    ]


def _gates(points: Array, *, rng: np.random.Generator) -> list[Figure]:
    mean, cov = closed_form_moments(points, SIGMA)
    other, other_cov = closed_form_moments(points + SIGMA * rng.standard_normal(points.shape), SIGMA)
    gate = Gate(0.95, 2)

    def run() -> None:
        gate_all(gate, mean, cov, other, other_cov)

    ours = _seconds(run, 7)
    one_pass = _seconds_of_a_pass()
    tracemalloc.start()
    run()
    peak = tracemalloc.get_traced_memory()[1] / GIGABYTE
    tracemalloc.stop()
    return [
        Figure("gate of 10,000 x 10,000, each pair with its own S", ours, "s"),
        Figure("  one pass over a float64 array of that size", one_pass, "s"),
        Figure("  gate over pass", ours / one_pass, "times", 8.0),
        Figure("  memory", peak, "GB", 1.0),
    ]


def _seconds_of_a_pass() -> float:
    array = np.zeros((N_CLUSTERS, N_CLUSTERS))
    return _seconds(lambda: np.add(array, 1.0, out=array), 7)


def _geometry(points: Array, *, rng: np.random.Generator) -> list[Figure]:
    sigma = 0.002
    a = points[:1000] + sigma * rng.standard_normal((1000, N_FLOWERS, 3))
    b = points[:1000] + sigma * rng.standard_normal((1000, N_FLOWERS, 3))
    cov = isotropic(N_FLOWERS, sigma)
    general = cov * np.diag(np.linspace(1.0, 2.0, 3 * N_FLOWERS))
    many = _seconds(lambda: match_geometries(a, b, 2**0.5 * sigma, 40.0), 3) / len(a)
    one = _seconds(lambda: [match_geometry(x, cov, y, general) for x, y in zip(a[:30], b[:30], strict=True)], 2) / 30
    return [
        Figure("full geometry of a true pair of 6, in batches", 1e6 * many, "us"),
        Figure("  one by one, any covariance", 1e6 * one, "us"),
    ]


def _filterpy_loop(points: Array, cov: Array) -> None:
    rule = MerweScaledSigmaPoints(3 * N_FLOWERS, 1.0, 2.0, 0.0)
    for cluster in points:
        sigmas = rule.sigma_points(cluster.ravel(), cov)
        values = np.array([_describe_one(x.reshape(N_FLOWERS, 3)) for x in sigmas])
        unscented_transform(values, rule.Wm, rule.Wc)


def _describe_one(cluster: Array) -> Array:
    """As one writes it for one cluster."""
    distances = np.linalg.norm(cluster - cluster.mean(axis=0), axis=1)
    return np.array([np.sum(distances**2), np.mean(distances)])


def _monte_carlo(points: Array, *, rng: np.random.Generator) -> None:
    for cluster in points:
        values = inertia_and_mean_distance(cluster + SIGMA * rng.standard_normal((N_SAMPLES, N_FLOWERS, 3)))
        values.mean(0), np.cov(values.T)


def _seconds(work: Callable[[], object], repeats: int) -> float:
    """The least of some runs: what else the machine does only adds."""
    best = np.inf
    for _ in range(repeats):
        begin = process_time()
        work()
        best = min(best, process_time() - begin)
    return float(best)
