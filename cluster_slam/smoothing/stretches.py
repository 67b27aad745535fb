"""Sway is slow compared with the frames: displacements of one cluster come in stretches that err alike.

A cluster that swings passes through the same side of its rest for a quarter of its period. Displacements within such a
stretch share a mean of their own; from stretch to stretch they are independent. So a cluster that was seen for a moment
while it swayed has a rest place that is as uncertain as the sway is wide, however many frames saw it.

A cluster that is not known to move moves a little all the same, and slowly: a few tenths of a millimetre that last for
half a second are ten times the error of that many measurements. Its stretches are as long as what it does at rest.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.ndimage import maximum_filter1d

from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray
from cluster_slam.smoothing.displaced import FEWEST, Displaced, Series
from cluster_slam.smoothing.glimpses import widened

_LAGS = (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 21, 26, 34, 42, 55, 68, 89, 110, 144)
_WITHIN = 0.8  # of a stretch's sigma: a quarter of a sine ends 0.9 of its own rms from its mean
_CALM_SHARE = 0.1  # of the measurement's sigma: no cluster is known to stand stiller
_MISTAKE_CHI2 = 16.0  # of a displacement at rest beyond which it is taken for a mistake
_BEYOND = 2.0  # times the sigma at rest: motion that rest does not explain
_SOONEST = 2.0  # frames in which motion fades at the soonest: what is faster cannot be told from noise
_FADING = np.geomspace(0.001, 0.25, 25)  # of the time that clusters were seen: how soon motion at rest is another


def standing_still(cov: Array) -> float:
    """The least that clusters move, m, beside the noise (p, 3, 3) of their measurements."""
    return _CALM_SHARE * float(np.sqrt(np.median(np.trace(cov, axis1=1, axis2=2)) / 3.0)) if len(cov) else 1e-4


def at_rest(moved: Displaced) -> tuple[float, float]:
    """How clusters move that are not known to move: one sigma along any axis, m, and for how long they err alike, s.

    Noise of the measurements is new in every frame, so what displacements of neighbouring frames have in common is
    motion. How long it lasts is the integral of its correlation over time.
    """
    calm = moved.scale <= 0.0
    least = standing_still(moved.cov[calm] if calm.any() else moved.cov)
    # Squares of rare mistakes would be all that is seen.
    usual = calm & ((moved.d**2).sum(axis=1) <= _MISTAKE_CHI2 * 3.0 * moved.noise)
    series = Series(moved, usual, 1.0 / moved.noise)
    return _fading(series, least)


def beyond_rest(moved: Displaced) -> Displaced:
    """The same, in motion only what is farther off than clusters at rest are: what they do lasts, and looks like it."""
    rest, _ = at_rest(moved)
    noise = float(np.sqrt(np.median(moved.noise))) if len(moved.noise) else 0.0  # what exceeds it needs no such care
    return replace(moved, scale=np.where(moved.scale > min(_BEYOND * rest, noise), moved.scale, 0.0))


def _fading(series: Series, least: float) -> tuple[float, float]:
    """Sigma, m, and integral of the correlation, s, of the exponential that covariances over time are closest to.

    Places are means over the time that a cluster was seen, and have taken that part of the motion with them.
    """
    found = np.array([series.own_covariance(lag) for lag in _LAGS])
    value, count = found[found[:, 1] >= FEWEST].T
    lags = np.array(_LAGS)[: len(value)]
    if len(value) < 2:
        return least, series.dt
    usual = float((series.weight > 0).sum(axis=0).max())
    tau = np.maximum(_FADING * usual, _SOONEST)
    shape = np.exp(-lags / tau[:, None]) - np.minimum(2.0 * tau[:, None] / usual, 0.5)
    square = (shape * count) @ value / np.maximum((shape**2) @ count, 1e-30)
    misfit = ((value - square[:, None] * shape) ** 2) @ count
    best = int(misfit.argmin())
    if square[best] <= least**2:
        return least, series.dt
    return float(np.sqrt(square[best])), float(max(2.0 * tau[best], 1.0) * series.dt)


def quarter_period(moved: Displaced) -> float:
    """Seconds after which a swaying cluster passes its rest: where the correlation of displacements is lost.

    With too little motion to tell, half a second.
    """
    moving = moved.scale > 0.0
    series = Series(moved, moving, 1.0 / np.where(moving, moved.scale, 1.0))
    first, count = series.covariance(1)
    if count < FEWEST or first <= 0.0:
        return 0.5
    for lag in _LAGS:
        value, count = series.covariance(lag)
        if count < FEWEST or value < 0.2 * first:
            return lag * series.dt
    return _LAGS[-1] * series.dt


def stretches(moved: Displaced, rest: float, lasting_s: float) -> tuple[IntArray, Array, Array]:
    """Stretch 0..s-1 of each displacement (p,), sigma (s,) of each stretch's mean, and sigma (p,) about that mean.

    At rest they are ``lasting_s`` long and as wide as ``rest`` m; while a cluster swings, a quarter of its period.
    """
    moving = moved.scale > 0.0
    quarter_s = quarter_period(moved)
    of, sigma = np.empty(len(moving), dtype=np.int64), np.full(len(moving), rest)
    calm_keys, calm_of = np.unique(_block(moved, ~moving, lasting_s), return_inverse=True)
    swing_keys, swing_of = np.unique(_block(moved, moving, quarter_s), return_inverse=True)
    of[~moving], of[moving] = calm_of, len(calm_keys) + swing_of
    wide = np.hypot(moved.scale[moving], rest)
    swing = _swings(moved, moving, wide, swing_keys, swing_of, _n_blocks(moved, quarter_s))
    sigma[moving] = np.maximum(wide, swing[swing_of])
    sigma *= _WITHIN
    of_stretch = np.concatenate([np.full(len(calm_keys), rest), swing])
    return of, widened(moved, rest, lasting_s, quarter_s, of, of_stretch, sigma), sigma


def _n_blocks(moved: Displaced, length_s: float) -> int:
    return int((moved.stamps[-1] - moved.stamps[0]) / length_s) + 1


def _block(moved: Displaced, which: BoolArray, length_s: float) -> IntArray:
    """Number of the block of time of each of some displacements, cluster by cluster."""
    block = np.floor((moved.stamps[moved.frame[which]] - moved.stamps[0]) / length_s).astype(np.int64)
    numbers: IntArray = moved.cluster[which] * _n_blocks(moved, length_s) + block
    return numbers


def _swings(moved: Displaced, which: BoolArray, wide: Array, key: IntArray, of: IntArray, n_blocks: int) -> Array:
    """Sigma (s,) of the mean of each stretch with block ``key`` (s,), from displacements ``wide`` m from rest.

    Where a cluster moves on from one stretch to the next, it swings as widely as that speed says: (v / omega)^2 is the
    energy's other half.
    """
    if len(key) == 0:
        return np.empty(0)
    d, count = moved.d[which], np.bincount(of)
    mean_square = np.bincount(of, wide**2) / count
    mean = np.stack([np.bincount(of, d[:, a]) for a in range(3)], axis=-1) / count[:, None]
    noise = np.bincount(of, 3.0 * moved.noise[which]) / count**2
    follows = np.diff(key) == 1
    step = ((mean[1:] - mean[:-1]) ** 2).sum(axis=1) - 2.0 * (noise[1:] + noise[:-1])
    swing = np.where(follows, np.maximum(step, 0.0) * (2.0 / np.pi) ** 2 / 3.0, 0.0)
    table = np.zeros((int(moved.cluster.max()) + 1, n_blocks))
    table.flat[key[1:]] = swing
    table.flat[key[:-1]] = np.maximum(table.flat[key[:-1]], swing)
    widest = maximum_filter1d(table, 3, axis=1).flat[key]
    return np.asarray(np.sqrt(np.maximum(mean_square, widest)))
