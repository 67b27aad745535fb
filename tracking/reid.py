"""Scoring after a gap: is this set of points that set, moved as a whole by an unknown offset, with some missing?

A group's members share one offset o ~ N(0, var_offset I) (it drifted while nobody looked), each has an error of its
own, some are lost or unseen and some are new. The offset is integrated out in closed form; the one-to-one assignment
inside is found from many beginnings. All functions take stacks of pairs of groups, padded to common sizes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from tracking.gaussian import LOG_2PI, Array

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]
N_SEEDS = 24  # beginnings: the smallest offsets that put one member on another
N_ROUNDS = 3  # of assigning and moving
NEGLIGIBLE = -12.0  # log likelihood ratios below this tie nothing together
_BLOCK = 2_000_000  # entries of the largest array


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """A stack of groups of points, padded. Padded members are False in ``mask``."""

    points: Array  # (p, n, d)
    variances: Array  # (p, n) of each point along each axis
    mask: BoolArray  # (p, n)

    def take(self, index: IntArray) -> Groups:
        """The groups of these rows."""
        return Groups(self.points[index], self.variances[index], self.mask[index])


@dataclass(frozen=True, slots=True)
class Background:
    """What is expected where a group is not the other one."""

    log_density: float  # of a member within its group, log of 1/m^d
    log_group_density: float  # of a group's first member anywhere, log of 1/m^d
    n_new: float = 0.15  # mean number of members that the other group did not have


@dataclass(frozen=True, slots=True, eq=False)
class GroupScores:
    """What matching of group pairs gives."""

    log_ratio: Array  # (p,) log likelihood of "the same" over "another one"
    partner: IntArray  # (p, n) member of the second group that each member of the first is, -1 none
    offset: Array  # (p, d) posterior mean of the common offset (first minus second)


def same_group(
    first: Groups, second: Groups, var_offset: Array, seen: Array, background: Background, dim: int | None = None
) -> GroupScores:
    """Log likelihood ratio that the first group is the second after a gap, the common offset integrated out.

    Parameters
    ----------
    first, second
        p groups each, compared row by row, in one frame: what was seen now and what was known.
    var_offset
        (p,) variance of the common offset along each axis; 0: none.
    seen
        (p, m) probability that each known member is still there and is seen.
    background
        Densities under "another one".

    Returns
    -------
    GroupScores
        With k matched members of residuals r_i, variances v_i, w_i = 1/v_i, W = sum w_i, weighted mean R:
        sum(-d/2 log 2 pi v_i - w_i |r_i - R|^2 / 2) - d/2 log(1 + var_offset W) - |R|^2 / (2 (var_offset + 1/W)), and
        the probabilities of what is missing and new, minus the log density of the first group under the background.
    """
    n_pairs, n, m = len(first.points), first.points.shape[1], second.points.shape[1]
    block = max(1, _BLOCK // max(1, (N_SEEDS + 1) * n * m))
    parts = [
        _score(first.take(rows), second.take(rows), var_offset[rows], np.clip(seen[rows], 1e-3, 0.999), background)
        for rows in np.array_split(np.arange(n_pairs), max(1, -(-n_pairs // block)))
    ]
    return GroupScores(
        np.concatenate([part.log_ratio for part in parts]),
        np.concatenate([part.partner for part in parts]),
        np.concatenate([part.offset for part in parts]),
    )


def _score(first: Groups, second: Groups, var_offset: Array, seen: Array, background: Background) -> GroupScores:
    d = first.points.shape[-1]
    residual = first.points[:, :, None] - second.points[:, None]  # (p, n, m, d)
    variance = first.variances[:, :, None] + second.variances[:, None]
    both = first.mask[:, :, None] & second.mask[:, None]
    log_new = np.log(background.n_new) + background.log_density
    odds = np.log(seen) - np.log1p(-seen)
    base = np.where(both, -0.5 * d * (LOG_2PI + np.log(variance)) - log_new + odds[:, None], -np.inf)
    offset = _seeds(residual, both)
    matched, score = _assign(residual, variance, base, offset, var_offset)
    for _ in range(N_ROUNDS):
        offset = _posterior_offset(residual, variance, matched, var_offset)
        matched, score = _assign(residual, variance, base, offset, var_offset)
    best = score.argmax(axis=1)
    row = np.arange(len(best))
    chosen = matched[row, best]
    log_ratio = _exact(residual, variance, chosen, var_offset, base)
    missing = np.where(second.mask, np.log1p(-seen), 0.0).sum(axis=1)
    n_first = first.mask.sum(axis=1)
    another = background.log_group_density + (n_first - 1) * background.log_density
    log_ratio = log_ratio + missing + n_first * log_new - background.n_new - another
    partner = np.where(chosen.any(axis=2), chosen.argmax(axis=2), -1)
    final = _posterior_offset(residual, variance, chosen[:, None], var_offset)[:, 0]
    return GroupScores(log_ratio, partner.astype(np.int64), final)


def _seeds(residual: Array, both: BoolArray) -> Array:
    """Beginnings (p, s, d) of the common offset: none, and the smallest that put a member on another."""
    p, n, m, d = residual.shape
    size = np.where(both, (residual * residual).sum(-1), np.inf).reshape(p, n * m)
    k = min(N_SEEDS, n * m)
    nearest = np.argpartition(size, k - 1, axis=1)[:, :k]
    chosen = np.take_along_axis(residual.reshape(p, n * m, d), nearest[..., None], axis=1)
    return np.concatenate([np.zeros((p, 1, d)), chosen], axis=1)


def _assign(residual: Array, variance: Array, base: Array, offset: Array, var_offset: Array) -> tuple[BoolArray, Array]:
    """One-to-one members (p, s, n, m) that are each other's best for each offset (p, s, d), and the scores (p, s)."""
    moved = residual[:, None] - offset[:, :, None, None]
    gain = base[:, None] - 0.5 * (moved * moved).sum(-1) / variance[:, None]
    best_of_row = gain == gain.max(axis=3, keepdims=True)
    best_of_column = gain == gain.max(axis=2, keepdims=True)
    matched = best_of_row & best_of_column & (gain > 0)
    prior = 0.5 * (offset * offset).sum(-1) / np.maximum(var_offset, 1e-12)[:, None]
    total = np.where(matched, gain, 0.0).sum(axis=(2, 3)) - prior
    return matched, total


def _posterior_offset(residual: Array, variance: Array, matched: BoolArray, var_offset: Array) -> Array:
    """Posterior mean (p, s, d) of the common offset, given who is whom (p, s, n, m)."""
    weight = matched / variance[:, None]
    total = weight.sum(axis=(2, 3))
    weighted = np.einsum("psnm,pnmd->psd", weight, residual)
    precision = 1.0 / np.maximum(var_offset, 1e-12)
    mean: Array = weighted / (total + precision[:, None])[..., None]
    return mean


def _exact(residual: Array, variance: Array, matched: BoolArray, var_offset: Array, base: Array) -> Array:
    """Sum of the matched members' gains (p,) with the offset integrated out."""
    d = residual.shape[-1]
    weight = matched / variance
    W = weight.sum(axis=(1, 2))
    mean = np.einsum("pnm,pnmd->pd", weight, residual) / np.maximum(W, 1e-12)[:, None]
    squares = np.einsum("pnm,pnm->p", weight, (residual * residual).sum(-1)) - W * (mean * mean).sum(-1)
    spread = var_offset * W
    prior = 0.5 * (mean * mean).sum(-1) * W / (1.0 + spread)
    found: Array = np.where(matched, base, 0.0).sum(axis=(1, 2)) - 0.5 * squares - prior - 0.5 * d * np.log1p(spread)
    return found


def association_probabilities(log_ratio: Array, n_rounds: int = 50) -> tuple[Array, Array, Array]:
    """Marginal probabilities of a one-to-one association from the log likelihood ratios of its pairs.

    Loopy belief propagation, which is exact for one pair and close to exact where few compete (Williams, Lau,
    "Approximate evaluation of marginal association probabilities with belief propagation", 2014, eq. 9 to 12).

    Parameters
    ----------
    log_ratio
        (r, c): of "the same" over "row is new and column is gone"; -inf where a pair is not admissible.

    Returns
    -------
    pairs (r, c), new (r,), gone (c,)
        Rows of ``pairs`` and ``new`` sum to one.
    """
    pairs = np.zeros(log_ratio.shape)
    for rows, cols in _components(log_ratio > NEGLIGIBLE):
        block = np.ix_(rows, cols)
        pairs[block] = _propagate(log_ratio[block], n_rounds)
    return pairs, np.maximum(1.0 - pairs.sum(axis=1), 0.0), np.maximum(1.0 - pairs.sum(axis=0), 0.0)


def _propagate(log_ratio: Array, n_rounds: int) -> Array:
    """Marginals (r, c) of the pairs of one connected component."""
    ratio = np.exp(np.clip(log_ratio, -25.0, 25.0)) * np.isfinite(log_ratio)
    back = np.ones_like(ratio)  # from column to row
    for _ in range(n_rounds):
        weighted = ratio * back
        forth = ratio / (1.0 + np.maximum(weighted.sum(axis=1, keepdims=True) - weighted, 0.0))
        back = 1.0 / (1.0 + np.maximum(forth.sum(axis=0) - forth, 0.0))
    weighted = ratio * back
    pairs: Array = weighted / (1.0 + weighted.sum(axis=1))[:, None]
    return pairs


def _components(admissible: BoolArray) -> list[tuple[IntArray, IntArray]]:
    """Rows and columns that pairs (r, c) tie together, one entry a component."""
    from scipy.sparse import coo_array
    from scipy.sparse.csgraph import connected_components

    r, c = admissible.shape
    i, j = np.nonzero(admissible)
    graph = coo_array((np.ones(len(i), dtype=np.int8), (i, j + r)), shape=(r + c, r + c))
    n, label = connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable").astype(np.int64)
    parts = np.split(order, np.cumsum(np.bincount(label, minlength=n))[:-1])
    return [(p[p < r], p[p >= r] - r) for p in parts if (p < r).any() and (p >= r).any()]
