"""Errors of a flower that last: they look like a motion of its own, and no number of frames averages them away.

A detector's box and a camera's depth err with the direction that a flower is seen from, and with the leaf before it;
both change slowly as the camera moves. How large such errors are, as a share of the stated variance of one observation,
is read off the flowers' nearest neighbours, most of which belong to the same cluster and do not move away from each
other: the difference of two such flowers, averaged over a moment, should be as small as the number of its frames says.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.stats import chi2

from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

_FEWEST = 2  # frames of a moment
_FEWEST_FRAMES = 30  # in which neighbours were seen together
WRONG = 0.03  # of the frames of a pair: those with the largest differences are left out
_MEDIAN = float(chi2.ppf(0.5, 3))
_LARGEST = 100.0  # of the variance of an observation
_STEPS = 40  # of a bisection
SPELL_S = 2.0  # half of a turn about a plant takes longer, a period of sway does not
REMAINS = 1.0 / 3.0  # of the variance of errors whose correlation falls to 1 / e in a third of a spell
_TAIL = 10.0  # as many times its usual variance a lasting error may have
_LEFT = 0.5  # of the noise of one observation


class Moments(NamedTuple):
    """Differences of neighbours, averaged over moments (k,): squared over the mean variance of one frame; frames."""

    square: Array
    n_frames: Array


def lasting_share(places: Array, u: Array, var: Array, moment: IntArray) -> float:
    """Variance of the errors that last for a moment, over the variance of one observation.

    Flowers at ``places`` (l, 3) were displaced by ``u`` (n, l, 3) with noise ``var`` (n, l); ``moment`` (n,) of each
    frame. The median over all moments of all pairs does not mind those in which neighbours do move apart.
    """
    moments = _moments(places, u, var, moment)
    low, high = 0.0, _LARGEST
    if len(moments.square) == 0 or _median(moments, low) <= _MEDIAN:
        return 0.0
    for _ in range(_STEPS):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if _median(moments, middle) > _MEDIAN else (low, middle)
    return 0.5 * (low + high)


def _median(moments: Moments, share: float) -> float:
    return float(np.median(moments.square / (1.0 / moments.n_frames + share)))


def _moments(places: Array, u: Array, var: Array, moment: IntArray) -> Moments:
    """Of each flower and its nearest."""
    pairs = _neighbours(places)
    found = [_moments_of(u[:, f] - u[:, g], var[:, f] + var[:, g], moment) for f, g in pairs.tolist()]
    return Moments(*(np.concatenate(x) for x in zip(*found, strict=True)))


def _neighbours(places: Array) -> NDArray[np.int64]:
    """Pairs (p, 2) of a flower and its nearest."""
    nearest = np.asarray(cKDTree(places).query(places, k=2)[1])[:, 1]
    return np.unique(np.sort(np.column_stack([np.arange(len(places)), nearest]), axis=1), axis=0).astype(np.int64)


def noise_share(places: Array, u: Array, var: Array) -> float:
    """Share of the stated variances by which neighbours do differ, at most one.

    Where flowers are taken for loose, sway that they share is taken for errors of each, and variances are too large.
    """
    shares = []
    for f, g in _neighbours(places).tolist():
        both = var[:, f] + var[:, g]
        k = np.flatnonzero(np.isfinite(both))
        if len(k) >= _FEWEST_FRAMES:
            square = np.sort(((u[k, f] - u[k, g]) ** 2).sum(axis=-1) / both[k])
            kept = square[: len(k) - max(1, round(WRONG * len(k)))]
            shares.append(float(kept.mean()) / (3.0 * share_of_smallest(len(kept) / len(k))))
    return min(1.0, float(np.median(shares))) if shares else 1.0


def share_of_smallest(kept: Any) -> Any:
    """Mean of the smallest ones, this share, of chi-square numbers with three degrees of freedom, over that of all."""
    return chi2.cdf(chi2.ppf(kept, 3), 5) / kept


def _moments_of(difference: Array, var: Array, moment: NDArray[np.int64]) -> Moments:
    k = np.flatnonzero(np.isfinite(var))
    weight, of = 1.0 / var[k], moment[k]
    n_frames = np.bincount(of).astype(float)
    enough = n_frames >= _FEWEST
    information = np.bincount(of, weight)[enough]
    n_frames = n_frames[enough]
    mean = np.stack([np.bincount(of, weight * difference[k, a])[enough] for a in range(3)]) / information
    return Moments((mean**2).sum(axis=0) * information / n_frames, n_frames)


def without_lasting(u: Array, var: Array, stamps: Array, share: float) -> tuple[Array, Array]:
    """Displacements ``u`` (n, l, 3) less what stays the same for a spell, and their noise ``var`` (n, l).

    Sway has returned by then, so that its mean over a spell is nothing. An error that lasts has ``share`` times the
    variance of one observation, or many times that: as far as it can be told from noise it is removed.
    """
    seen = np.isfinite(var)
    information = np.where(seen, 1.0 / np.where(seen, var, 1.0), 0.0)
    first = np.searchsorted(stamps, stamps - 0.5 * SPELL_S)
    last = np.searchsorted(stamps, stamps + 0.5 * SPELL_S, side="right")

    def over_spell(x: Array) -> Array:
        total = np.concatenate([np.zeros_like(x[:1]), np.cumsum(x, axis=0)])
        summed: Array = total[last] - total[first]
        return summed

    known, n = over_spell(information), over_spell(1.0 * seen)
    known[~seen] = 1.0
    told = _TAIL * share * n / (1.0 + _TAIL * share * n)
    mean = over_spell(information[..., None] * np.where(seen[..., None], u, 0.0)) / known[..., None]
    own = information / known
    left: Array = var * (1.0 - told * own * (2.0 - told))
    kept = seen & (left > _LEFT * np.where(seen, var, np.inf))
    return np.where(kept[..., None], u - told[..., None] * mean, np.nan), np.where(kept, left, np.nan)
