"""A smooth field of drift: neighbours on a branch drift together, so what moved tells where the others went.

A Gaussian process over the plant, its size and its share of the whole drift chosen by the evidence of the matched
flowers (Rasmussen and Williams 2006, eq. 2.25, 2.26 and 2.30).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_slam.constellation.explain import Explained, Scene, explain, matched_pairs
from cluster_slam.constellation.fit import fit
from cluster_slam.geometry import Array
from tracking.reid import Groups

LENGTH_SHARE = 0.35  # correlation length over the plant's spread (RMS distance from its middle)
SIZES = (0.25, 0.5, 1.0, 2.0, 4.0, 8.0)  # drift against what was expected: a factor of two is one sigma
SHARES = (0.0, 0.5, 0.9)  # of its variance that is common to neighbours
N_ROUNDS = 3


def warped(scene: Scene, found: Explained) -> tuple[Scene, Explained]:
    """The scene with the known units moved by the field, and the explanation found there."""
    best_scene, best = scene, found
    for _ in range(N_ROUNDS):
        if len(best) < 4:
            break
        pose = fit(matched_pairs(scene, best), scene.scale_range)
        moved_scene = _moved(scene, replace(best, pose=pose))
        again = explain(moved_scene, pose)[0]
        if len(again) < len(best) and again.log_ratio < best.log_ratio:
            break
        best_scene, best = moved_scene, again
    return best_scene, best


def field_log_density(scene: Scene, found: Explained) -> float:
    """Log density of the matched flowers' drift as a smooth field, its size and share summed over with their prior."""
    pairs = matched_pairs(scene, found)
    at, residual = pairs.b, found.pose.apply(pairs.a)[0] - pairs.b
    var, noise, length = pairs.var_offset[pairs.unit], pairs.variance, _length(scene)
    sizes = np.array(SIZES)
    prior = -0.5 * np.log2(sizes) ** 2
    prior = prior - np.logaddexp.reduce(prior) - np.log(len(SHARES))
    each = [
        _log_evidence(at, residual, var, noise, length, s, c) + p
        for s, p in zip(sizes.tolist(), prior.tolist(), strict=True)
        for c in SHARES
    ]
    return float(np.logaddexp.reduce(each) - 0.5 * residual.size * np.log(2 * np.pi))


def _length(scene: Scene) -> float:
    """Correlation length of the field, m."""
    spread = np.sqrt(((scene.known.centres - scene.known.centres.mean(0)) ** 2).sum(1).mean())
    return max(LENGTH_SHARE * float(spread), 1e-3)


def _moved(scene: Scene, found: Explained) -> Scene:
    """Known units where the matched ones say they are."""
    pairs = matched_pairs(scene, found)
    at, residual = pairs.b, found.pose.apply(pairs.a)[0] - pairs.b
    length = _length(scene)
    var = pairs.var_offset[pairs.unit]
    size, share = max(
        ((s, c) for s in SIZES for c in SHARES),
        key=lambda x: (
            _log_evidence(at, residual, var, pairs.variance, length, x[0], x[1]) - 0.5 * float(np.log2(x[0])) ** 2
        ),
    )
    field, left = _predict(
        scene.known.centres, scene.known.var_offset, at, residual, var, pairs.variance, length, size, share
    )
    known = scene.known
    groups = known.groups
    moved = Groups(groups.points + field[:, None], groups.variances, groups.mask)
    return replace(scene, known=replace(known, groups=moved, centres=known.centres + field, var_offset=left))


def _kernel(a: Array, b: Array, var_a: Array, var_b: Array, length: float) -> Array:
    squared = ((a[:, None] - b) ** 2).sum(-1)
    kernel: Array = np.sqrt(var_a[:, None] * var_b) * np.exp(-0.5 * squared / length**2)
    return kernel


def _log_evidence(
    at: Array, residual: Array, var: Array, noise: Array, length: float, size: float, share: float
) -> float:
    K = _kernel(at, at, size**2 * share * var, size**2 * share * var, length)
    K += np.diag(noise + size**2 * (1 - share) * var)
    _, log_det = np.linalg.slogdet(K)
    fitted = float((residual * np.linalg.solve(K, residual)).sum())
    return float(-0.5 * fitted - 0.5 * residual.shape[1] * log_det)


def _predict(
    where: Array,
    var_where: Array,
    at: Array,
    residual: Array,
    var: Array,
    noise: Array,
    length: float,
    size: float,
    share: float,
) -> tuple[Array, Array]:
    """Mean of the field (n, d) and the variance (n,) of what is left of the drift."""
    K = _kernel(at, at, size**2 * share * var, size**2 * share * var, length)
    K += np.diag(noise + size**2 * (1 - share) * var)
    across = _kernel(where, at, size**2 * share * var_where, size**2 * share * var, length)
    solved = np.linalg.solve(K, across.T)
    mean = solved.T @ residual
    known = (across * solved.T).sum(axis=1)
    left = size**2 * share * var_where - known + size**2 * (1 - share) * var_where
    return mean, np.maximum(left, 1e-8)
