"""What flowers' motion says of whether they belong together: members of one cluster move as one.

For two flowers the ratio

    r = sum w (|u_f - u_g|^2 - noise) / sum w (|u_f|^2 + |u_g|^2 - noise)

is zero where they move as one and one where they move apart from each other; neighbouring clusters that one touch
shook lie between. Frames in which the plant moves weigh most; how much it moved is read off the neighbouring frames,
so that a frame's own noise does not choose it.

Errors of a flower that last (``lasting``) look like a motion of its own. Their expectation is subtracted like that of
the noise, and since they are larger for some flowers than for others, by an unknown factor whose inverse is chi-square
distributed, the likelihood is the mean over that factor: where the motion that was seen is not clearly more than such
errors may be, it says nothing, however many frames there are.

Two clusters may swing alike for a moment, but hardly again and again. How often a pair was seen to move is the number
of equal stretches that would hold as much motion, (sum e)^2 / sum e^2 over the motion e in each stretch (Kish, "Survey
sampling", 1965); the more there are, the rarer a small ratio of two clusters.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from scipy.stats import chi2

from cluster_slam.geometry import Array
from cluster_slam.grouping.lasting import (
    REMAINS,
    SPELL_S,
    WRONG,
    lasting_share,
    noise_share,
    share_of_smallest,
    without_lasting,
)
from cluster_slam.records import IntArray

WINDOW_S = 0.4  # motion hardly changes for so long
SIGNIFICANT = 11.3  # chi-square, 3 degrees of freedom, 99 %
FEWEST_FRAMES = 5
SYSTEMATIC = 0.02  # of an observation's variance: how well places at rest are known, which does not average out
SURE = 0.33  # motion of three times its own standard deviation is there at all
_APART = (0.66, 0.27)  # ratio of flowers of two clusters, mean and sigma
_ALIKE = 0.3  # of pairs of two clusters lie anywhere from 0 to _RANGE instead, with the density of ratio ** (power - 1)
_POWER = (0.4, 0.07)  # at no stretch of motion, and for each: one touch may move two clusters alike, ten do not
_RIGID = 0.02  # ratio within a cluster that does not turn
NEAR = 0.3  # of the reach: flowers so near each other are mostly of one cluster
_TELLS = 0.1  # standard deviation of a ratio that tells of turning
_FEWEST_PAIRS = 10
_MOST_TURNING = 0.3
_ANYTHING = 0.05  # this share of all pairs has any ratio
_RANGE = 1.4
_BINS = 140  # of the range
_LASTS = 3.0  # windows: as long a lasting error stays the same
_ALIKE_DOF = 4.0  # flowers' lasting errors are alike as far as sample variances with so many degrees of freedom
_N_FACTORS = 32  # equally probable ones of their usual variance
_FACTORS = _ALIKE_DOF / chi2.ppf((np.arange(_N_FACTORS) + 0.5) / _N_FACTORS, _ALIKE_DOF)
# Only moments that are significant are looked at: if it was errors, then large ones.
_IF_SELECTED = chi2.sf(SIGNIFICANT / _FACTORS, 3) / chi2.sf(SIGNIFICANT / _FACTORS, 3).mean()


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Displacements ``u`` (n, l, 3) from rest, NaN where unseen, their noise ``var`` (n, l), and ``stamps`` (n,) s."""

    u: Array
    var: Array
    stamps: Array


class Ratios(NamedTuple):
    """Of pairs (p,); NaN where too little moved."""

    ratio: Array
    sigma: Array  # standard deviation
    n_stretches: Array  # of motion
    lasting: Array  # share of lasting errors in the denominator, if they are as large as usual


def motion_evidence(places: Array, motion: Motion, reach: float) -> csr_matrix:
    """Log-likelihood ratios (l, l) that two flowers within ``reach`` move as one, against that they do not."""
    pairs = cKDTree(places).query_pairs(reach, output_type="ndarray")
    n = len(places)
    if len(pairs) == 0:
        return csr_matrix((n, n))
    var = noise_share(places, motion.u, motion.var) * motion.var
    # Sway averages out over a spell: it is not taken for lasting errors, even where all neighbours move apart.
    share = lasting_share(places, motion.u, var, _stretches(motion.stamps, SPELL_S))
    ratios = pair_ratios(pairs, Motion(motion.u, var, motion.stamps), share)
    known = ratios.sigma < SURE
    pairs, ratios = pairs[known], Ratios(*(x[known] for x in ratios))
    if len(pairs) == 0:
        return csr_matrix((n, n))
    distance = np.linalg.norm(places[pairs[:, 0]] - places[pairs[:, 1]], axis=1)
    evidence = log_likelihood_ratio(ratios, turning_ratio(ratios, distance, NEAR * reach))
    upper = csr_matrix((evidence, (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    return csr_matrix(upper + upper.T)


def log_likelihood_ratio(ratios: Ratios, turning: Array | float) -> Array:
    """Of ratios (p,), where ``turning`` is the usual ratio of such a pair within a cluster that turns."""
    if not ratios.lasting.any():
        alike, other = _densities(ratios, turning)
        return np.asarray(np.log(alike / other))
    together, apart = np.zeros_like(ratios.ratio), np.zeros_like(ratios.ratio)
    for factor, selected in zip(_FACTORS, _IF_SELECTED, strict=True):
        given, left = _given_lasting(ratios, float(factor))
        alike, other = _densities(given, turning)
        together, apart = together + selected * alike / left, apart + other / left
    return np.asarray(np.log(together / apart))


def _given_lasting(ratios: Ratios, factor: float) -> tuple[Ratios, Array]:
    """The ratios if lasting errors have ``factor`` times their usual variance; share of motion that is left (p,)."""
    more = (factor - 1.0) * ratios.lasting
    left = np.maximum(1.0 - more, np.minimum(ratios.sigma / SURE, 1.0))
    # Of squares of errors (chi-square) and of their product, over as many axes and independent stretches as there are.
    fluctuation = factor * ratios.lasting * np.sqrt(3.0 / np.maximum(3.0 / _LASTS * ratios.n_stretches, 3.0))
    sigma = np.hypot(ratios.sigma, fluctuation) / left
    return Ratios((ratios.ratio - more) / left, sigma, ratios.n_stretches, ratios.lasting), left


def _densities(ratios: Ratios, turning: Array | float) -> tuple[Array, Array]:
    """Of the ratios (p,) of two flowers of one cluster, and of two clusters."""
    ratio, sigma = ratios.ratio, ratios.sigma
    together = _normal(ratio, 0.5 * turning, np.hypot(sigma, _RIGID + turning))
    apart = _normal(ratio, _APART[0], np.hypot(sigma, _APART[1]))
    apart = (1.0 - _ALIKE) * apart + _ALIKE * _anywhere(ratio, sigma, _POWER[0] + _POWER[1] * ratios.n_stretches)
    anything = np.where(np.abs(ratio) < _RANGE, 1.0, 0.0) / (2.0 * _RANGE) + _normal(ratio, 0.5, 0.5 * _RANGE + sigma)
    anything = 0.5 * _ANYTHING * anything
    return (1.0 - _ANYTHING) * together + anything, (1.0 - _ANYTHING) * apart + anything


def _anywhere(x: Array, sigma: Array, power: Array) -> Array:
    """Density of what is distributed as ``power`` (ratio / range) ** (power - 1) / range, seen with errors sigma."""
    edges = np.linspace(0.0, 1.0, _BINS + 1)
    mass = np.diff(edges ** power[:, None], axis=1)
    middle = 0.5 * _RANGE * (edges[1:] + edges[:-1])
    blurred = np.hypot(sigma, _RANGE / _BINS / np.sqrt(12.0))[:, None]
    value: Array = (mass * _normal(x[:, None], middle, blurred)).sum(axis=1)
    return value


def turning_ratio(ratios: Ratios, distance: Array, near: float) -> Array:
    """Usual ratio (p,) of two flowers of one cluster at ``distance`` (p,) m: clusters turn as they sway.

    It grows with the square of the distance; by how much is said by pairs within ``near`` m, mostly of one cluster.
    """
    ratio, sigma = ratios.ratio, ratios.sigma
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


def pair_ratios(pairs: NDArray[Any], motion: Motion, share: float) -> Ratios:
    """Of pairs (p, 2), where errors that last have ``share`` times the variance of an observation."""
    power = _power(motion, share)
    seen = np.isfinite(motion.var)
    stretch = _stretches(motion.stamps)
    sums = np.full((6, len(pairs)), np.nan)
    for i, (f, g) in enumerate(pairs.tolist()):
        signal = power[:, f] + power[:, g]
        k = np.flatnonzero(seen[:, f] & seen[:, g])
        if len(k) < FEWEST_FRAMES or not (signal[k] > 0.0).any():
            continue
        at = np.ix_(k, [f, g])
        u, var = motion.u[at], motion.var[at]
        if share > 0.0:  # of the same frames for both: in motion, means over different ones differ
            u, var = without_lasting(u, var, motion.stamps[k], share)
        used = np.isfinite(var).all(axis=1) & (signal[k] > 0.0)
        if used.sum() >= FEWEST_FRAMES:
            k, u, noise = k[used], u[used], var[used].sum(axis=1)
            sums[:, i] = _pair_sums(u[:, 0], u[:, 1], noise, signal[k], stretch[k] - stretch[k[0]])
    lasting = REMAINS * share
    different, moved, noise_sq, noise_fourth, stretches, kept = sums
    total = moved - (1.0 + lasting) * noise_sq
    total[~(total > 0.0)] = np.nan
    # Of noise alone, whose squares are chi-square, those that are not the largest are smaller than the mean.
    left = share_of_smallest(kept)
    sigma: Array = np.hypot(np.sqrt(6.0 * noise_fourth), SYSTEMATIC * noise_sq) / total
    return Ratios((different - (left + lasting) * noise_sq) / total, sigma, stretches, lasting * noise_sq / total)


def _stretches(stamps: Array, length_s: float = WINDOW_S) -> IntArray:
    """In which stretch each frame (n,) is."""
    index: IntArray = np.floor((stamps - stamps[0]) / length_s).astype(np.int64)
    return index


def _pair_sums(u_f: Array, u_g: Array, noise: Array, signal: Array, stretch: IntArray) -> tuple[float, ...]:
    """Weighted sums over the frames (k,) of a pair whose flowers stand u_f, u_g (k, 3) from rest.

    Squares of differences, of both displacements, of noise, fourth power of noise; stretches of motion; share of the
    frames that was kept.
    """
    weight = signal / (signal + noise) / noise
    motion_of = np.bincount(stretch, weight * signal)
    difference = weight * ((u_f - u_g) ** 2).sum(-1)
    # A single wrong observation must not part a cluster.
    kept = np.argsort(difference)[: len(noise) - max(1, round(WRONG * len(noise)))]
    expected = (weight * noise)[kept]
    both = (weight * ((u_f**2).sum(-1) + (u_g**2).sum(-1)))[kept]
    n_stretches = motion_of.sum() ** 2 / (motion_of**2).sum()
    sums = difference[kept].sum(), both.sum(), 3.0 * expected.sum(), (expected**2).sum(), n_stretches
    return (*map(float, sums), len(kept) / len(noise))


def _power(motion: Motion, share: float) -> Array:
    """How far each flower (n, l) stood from rest around each frame, m^2 along any axis, from the other frames alone."""
    stamps, lasting = motion.stamps, REMAINS * share
    if share > 0.0:
        motion = Motion(*without_lasting(motion.u, motion.var, stamps, share), stamps)
    seen = np.isfinite(motion.var)
    dt = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1.0
    half = max(1, round(0.5 * WINDOW_S / dt))
    information: Array = np.where(seen, 1.0 / np.where(seen, motion.var, 1.0), 0.0)
    total = _others(information, half)
    n_others = _others(1.0 * seen, half)
    noise: Array = 1.0 / np.where(n_others > 0.5, total, np.inf)
    uncertain = noise * (1.0 + lasting * n_others)
    u: Array = np.where(seen[..., None], motion.u, 0.0)
    square = np.zeros_like(total)
    for axis in range(3):
        square += (noise * _others(information * u[..., axis], half)) ** 2
    power: Array = np.where((noise > 0.0) & (square > SIGNIFICANT * uncertain), square / 3.0 - uncertain, 0.0)
    return power


def _others(x: NDArray[Any], half: int) -> Array:
    """Sums over the ``half`` rows before and after each row of x (n, l)."""
    total = np.concatenate([np.zeros((1, x.shape[1])), np.cumsum(x, axis=0)])
    i = np.arange(len(x))
    summed: Array = total[np.minimum(i + half + 1, len(x))] - total[np.maximum(i - half, 0)] - x
    return summed
