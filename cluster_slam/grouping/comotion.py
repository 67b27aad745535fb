"""What flowers' motion says of whether they belong together: members of one cluster move as one.

For two flowers the ratio

    r = sum w (|u_f - u_g|^2 - noise) / sum w (|u_f|^2 + |u_g|^2 - noise)

is zero where they move as one and one where they move apart from each other; neighbouring clusters that one touch
shook lie between. Frames in which the plant moves weigh most; how much it moved is read off the neighbouring frames,
so that a frame's own noise does not choose it.

Two clusters may swing alike for a moment, but hardly again and again. How often a pair was seen to move is the number
of equal stretches that would hold as much motion, (sum e)^2 / sum e^2 over the motion e in each stretch (Kish, "Survey
sampling", 1965); the more there are, the rarer a small ratio of two clusters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from scipy.stats import chi2

from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

_WINDOW_S = 0.4  # motion hardly changes for so long
_SIGNIFICANT = 11.3  # chi-square, 3 degrees of freedom, 99 %
_FEWEST_FRAMES = 5
_SYSTEMATIC = 0.02  # of an observation's variance: how well places at rest are known, which does not average out
_SURE = 0.33  # motion of three times its own standard deviation is there at all
_WRONG = 0.03  # of the frames of a pair: those with the largest differences are left out
_APART = (0.66, 0.27)  # ratio of flowers of two clusters, mean and sigma
_ALIKE = 0.3  # of pairs of two clusters lie anywhere from 0 to _RANGE instead, with the density of ratio ** (power - 1)
_POWER = (0.4, 0.07)  # at no stretch of motion, and for each: one touch may move two clusters alike, ten do not
_RIGID = 0.02  # ratio within a cluster that does not turn
_NEAR = 0.3  # of the reach: flowers so near each other are mostly of one cluster
_TELLS = 0.1  # standard deviation of a ratio that tells of turning
_FEWEST_PAIRS = 10
_MOST_TURNING = 0.3
_ANYTHING = 0.05  # this share of all pairs has any ratio
_RANGE = 1.4
_BINS = 140  # of the range


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Displacements ``u`` (n, l, 3) from rest, NaN where unseen, their noise ``var`` (n, l), and ``stamps`` (n,) s."""

    u: Array
    var: Array
    stamps: Array


def motion_evidence(places: Array, motion: Motion, reach: float) -> csr_matrix:
    """Log-likelihood ratios (l, l) that two flowers within ``reach`` move as one, against that they do not."""
    pairs = cKDTree(places).query_pairs(reach, output_type="ndarray")
    n = len(places)
    if len(pairs) == 0:
        return csr_matrix((n, n))
    ratio, sigma, n_stretches = pair_ratios(pairs, motion)
    known = sigma < _SURE
    pairs, ratio, sigma, n_stretches = pairs[known], ratio[known], sigma[known], n_stretches[known]
    if len(pairs) == 0:
        return csr_matrix((n, n))
    distance = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    evidence = log_likelihood_ratio(ratio, sigma, n_stretches, turning_ratio(ratio, sigma, distance, _NEAR * reach))
    upper = csr_matrix((evidence, (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return csr_matrix(upper + upper.T)


def log_likelihood_ratio(ratio: Array, sigma: Array, n_stretches: Array, turning: Array | float) -> Array:
    """Of ratios (p,) with standard deviations ``sigma``, from so many stretches of motion.

    ``turning`` is the usual ratio of such a pair within a cluster that turns.
    """
    together = _normal(ratio, 0.5 * turning, np.hypot(sigma, _RIGID + turning))
    apart = _normal(ratio, _APART[0], np.hypot(sigma, _APART[1]))
    apart = (1.0 - _ALIKE) * apart + _ALIKE * _anywhere(ratio, sigma, _POWER[0] + _POWER[1] * n_stretches)
    anything = np.where(np.abs(ratio) < _RANGE, 1.0, 0.0) / (2.0 * _RANGE) + _normal(ratio, 0.5, 0.5 * _RANGE + sigma)
    anything = 0.5 * anything
    value: Array = np.log(
        ((1.0 - _ANYTHING) * together + _ANYTHING * anything) / ((1.0 - _ANYTHING) * apart + _ANYTHING * anything)
    )
    return value


def _anywhere(x: Array, sigma: Array, power: Array) -> Array:
    """Density of what is distributed as ``power`` (ratio / range) ** (power - 1) / range, seen with errors sigma."""
    edges = np.linspace(0.0, 1.0, _BINS + 1)
    mass = np.diff(edges ** power[:, None], axis=1)
    middle = 0.5 * _RANGE * (edges[1:] + edges[:-1])
    blurred = np.hypot(sigma, _RANGE / _BINS / np.sqrt(12.0))[:, None]
    value: Array = (mass * _normal(x[:, None], middle, blurred)).sum(axis=1)
    return value


def turning_ratio(ratio: Array, sigma: Array, distance: Array, near: float) -> Array:
    """Usual ratio (p,) of two flowers of one cluster at ``distance`` (p,) m: clusters turn as they sway.

    It grows with the square of the distance; by how much is said by pairs within ``near`` m, mostly of one cluster.
    """
    tell = np.flatnonzero((sigma < _TELLS) & (distance < near))
    if len(tell) < _FEWEST_PAIRS:
        return np.zeros_like(ratio)
    a_square_metre = ratio[tell] / distance[tell] ** 2
    order = np.argsort(a_square_metre)
    weight = np.cumsum((distance[tell] ** 2 / np.hypot(sigma[tell], _RIGID))[order])
    median = float(a_square_metre[order[np.searchsorted(weight, 0.5 * weight[-1])]])
    return np.clip(median * distance**2, 0.0, _MOST_TURNING)


def _normal(x: Array, mean: float | Array, sigma: Array) -> Array:
    value: Array = np.exp(-0.5 * ((x - mean) / sigma) ** 2) / (np.sqrt(2.0 * np.pi) * sigma)
    return value


def pair_ratios(pairs: NDArray[Any], motion: Motion) -> tuple[Array, Array, Array]:
    """Ratios (p,) of pairs (p, 2), standard deviations (p,), stretches of motion (p,); NaN where too little moved."""
    seen = np.isfinite(motion.var)
    power = _power(motion, seen)
    stretch = np.floor((motion.stamps - motion.stamps[0]) / _WINDOW_S).astype(np.int64)
    sums = np.full((6, len(pairs)), np.nan)
    for i, (f, g) in enumerate(pairs.tolist()):
        signal = power[:, f] + power[:, g]
        k = np.flatnonzero(seen[:, f] & seen[:, g] & (signal > 0.0))
        if len(k) >= _FEWEST_FRAMES:
            noise = motion.var[k, f] + motion.var[k, g]
            sums[:, i] = _pair_sums(motion.u[k, f], motion.u[k, g], noise, signal[k], stretch[k] - stretch[k[0]])
    different, moved, noise_sq, noise_fourth, stretches, kept = sums
    total = moved - noise_sq
    total[~(total > 0.0)] = np.nan
    # Of noise alone, whose squares are chi-square, those that are not the largest are smaller than the mean.
    left = chi2.cdf(chi2.ppf(kept, 3), 5) / kept
    sigma: Array = np.hypot(np.sqrt(6.0 * noise_fourth), _SYSTEMATIC * noise_sq) / total
    return (different - left * noise_sq) / total, sigma, stretches


def _pair_sums(u_f: Array, u_g: Array, noise: Array, signal: Array, stretch: IntArray) -> tuple[float, ...]:
    """Weighted sums over the frames (k,) of a pair whose flowers stand u_f, u_g (k, 3) from rest.

    Squares of differences, of both displacements, of noise, fourth power of noise; stretches of motion; share of the
    frames that was kept.
    """
    weight = signal / (signal + noise) / noise
    motion_of = np.bincount(stretch, weight * signal)
    difference = weight * ((u_f - u_g) ** 2).sum(-1)
    # A single wrong observation must not part a cluster.
    kept = np.argsort(difference)[: len(noise) - max(1, round(_WRONG * len(noise)))]
    expected = (weight * noise)[kept]
    both = (weight * ((u_f**2).sum(-1) + (u_g**2).sum(-1)))[kept]
    n_stretches = motion_of.sum() ** 2 / (motion_of**2).sum()
    sums = difference[kept].sum(), both.sum(), 3.0 * expected.sum(), (expected**2).sum(), n_stretches
    return (*map(float, sums), len(kept) / len(noise))


def _power(motion: Motion, seen: BoolArray) -> Array:
    """How far each flower (n, l) stood from rest around each frame, m^2 along any axis, from the other frames alone."""
    stamps = motion.stamps
    dt = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1.0
    half = max(1, round(0.5 * _WINDOW_S / dt))
    information: Array = np.where(seen, 1.0 / np.where(seen, motion.var, 1.0), 0.0)
    total = _others(information, half)
    noise: Array = 1.0 / np.where(_others(1.0 * seen, half) > 0.5, total, np.inf)
    u: Array = np.where(seen[..., None], motion.u, 0.0)
    square = np.zeros_like(total)
    for axis in range(3):
        square += (noise * _others(information * u[..., axis], half)) ** 2
    power: Array = np.where((noise > 0.0) & (square > _SIGNIFICANT * noise), square / 3.0 - noise, 0.0)
    return power


def _others(x: NDArray[Any], half: int) -> Array:
    """Sums over the ``half`` rows before and after each row of x (n, l)."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    i = np.arange(len(x))
    summed: Array = total[np.minimum(i + half + 1, len(x))] - total[np.maximum(i - half, 0)] - x
    return summed
