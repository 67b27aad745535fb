"""Sway is slow compared with the frames: displacements of one cluster come in stretches that err alike.

A cluster that swings passes through the same side of its rest for a quarter of its period. Displacements within such a
stretch share a mean of their own; from stretch to stretch they are independent. So a cluster that was seen for a moment
while it swayed has a rest place that is as uncertain as the sway is wide, however many frames saw it.
"""

from __future__ import annotations

import numpy as np
from scipy.ndimage import maximum_filter1d

from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

_LAGS = (1, 2, 3, 4, 5, 6, 8, 10, 13, 16, 21, 26, 34, 42, 55, 68, 89, 110, 144)
_WITHIN = 0.5  # of a stretch's sigma: how far a displacement strays from the stretch's mean, a quarter of a sine
_FEWEST = 30  # products that make a covariance
_CALM_SHARE = 0.1  # of the measurement's sigma: no cluster is known to stand stiller


class Series:
    """Measured displacements as series (n, c, 3), zero where unseen."""

    def __init__(self, d: Array, frame: IntArray, cluster: IntArray, stamps: Array) -> None:
        """Displacements d (p, 3) of clusters (p,) in frames (p,) at ``stamps`` (n,)."""
        n_clusters = int(cluster.max(initial=0)) + 1
        self.stamps = stamps
        self.dt = float(np.median(np.diff(stamps))) if len(stamps) > 1 else 1.0
        self.values = np.zeros((len(stamps), n_clusters, 3))
        self.seen = np.zeros((len(stamps), n_clusters))
        self.values[frame, cluster] = d
        self.seen[frame, cluster] = 1.0

    def own_covariance(self, lag: int) -> tuple[float, float]:
        """The same without what all clusters have in common: that is an error of the pose, or of the mounting."""
        value, count = self.covariance(lag)
        if lag >= len(self.values):
            return value, count
        early, late = self.values[:-lag], self.values[lag:]
        seen_early, seen_late = self.seen[:-lag], self.seen[lag:]
        n_both = float((seen_early.sum(axis=1) * seen_late.sum(axis=1)).sum()) - count
        both = float((early.sum(axis=1) * late.sum(axis=1)).sum()) - 3.0 * count * value
        common = both / (3.0 * n_both) if n_both >= _FEWEST else value  # one cluster alone cannot tell
        return value - max(common, 0.0), count

    def covariance(self, lag: int) -> tuple[float, float]:
        """Mean product along any axis of displacements ``lag`` frames apart, and how many products that is."""
        if lag >= len(self.values):
            return 0.0, 0.0
        count = float((self.seen[lag:] * self.seen[:-lag]).sum())
        return float((self.values[lag:] * self.values[:-lag]).sum()) / max(3.0 * count, 1.0), count


def standing_still(cov: Array) -> float:
    """The least that clusters move, m, beside the noise (p, 3, 3) of their measurements."""
    return _CALM_SHARE * float(np.sqrt(np.median(np.trace(cov, axis1=1, axis2=2)) / 3.0)) if len(cov) else 1e-4


def rest_sigma(d: Array, cov: Array, scale: Array, frame: IntArray, cluster: IntArray, stamps: Array) -> float:
    """How far clusters that are not known to move are from rest, m, one sigma along any axis.

    Noise of the measurements (p, 3, 3) is new in every frame, so what displacements of neighbouring frames have in
    common is motion.
    """
    calm = scale <= 0.0
    if not calm.any():
        return standing_still(cov)
    least = standing_still(cov[calm])
    # Squares of rare mistakes would be all that is seen.
    size = (d[calm] ** 2).sum(axis=1)
    usual = np.flatnonzero(calm)[size <= 16.0 * np.trace(cov[calm], axis1=1, axis2=2)]
    series = Series(d[usual], frame[usual], cluster[usual], stamps)
    (first, n_first), (second, n_second) = series.own_covariance(1), series.own_covariance(2)
    if n_first + n_second < _FEWEST:
        return least
    shared = (first * n_first + second * n_second) / (n_first + n_second)
    return float(np.sqrt(max(shared, least**2)))


def quarter_period(d: Array, scale: Array, frame: IntArray, cluster: IntArray, stamps: Array) -> float:
    """Seconds after which a swaying cluster passes its rest: where the correlation of displacements is lost.

    With too little motion to tell, half a second.
    """
    moving = scale > 0.0
    series = Series(d[moving] / scale[moving, None], frame[moving], cluster[moving], stamps)
    first, count = series.covariance(1)
    if count < _FEWEST or first <= 0.0:
        return 0.5
    for lag in _LAGS:
        value, count = series.covariance(lag)
        if count < _FEWEST or value < 0.2 * first:
            return lag * series.dt
    return _LAGS[-1] * series.dt


def stretches(
    d: Array, cov: Array, sigma: Array, frame: IntArray, cluster: IntArray, stamps: Array, length_s: float
) -> tuple[IntArray, Array, Array]:
    """Stretch 0..s-1 of each displacement (p,), sigma (s,) of each stretch's mean, and sigma (p,) about that mean.

    ``sigma`` (p,) is how far each displacement d (p, 3) with noise (p, 3, 3) may be from rest. Where a cluster moves
    on from one stretch to the next, it swings as widely as that speed says: (v / omega)^2 is the energy's other half.
    """
    if len(frame) == 0:
        return np.empty(0, dtype=np.int64), np.empty(0), np.empty(0)
    block = np.floor((stamps[frame] - stamps[0]) / length_s).astype(np.int64)
    n_blocks = int(block.max()) + 1
    key, of = np.unique(cluster * n_blocks + block, return_inverse=True)
    count = np.bincount(of)
    mean_square = np.bincount(of, sigma**2) / count
    mean = np.stack([np.bincount(of, d[:, a]) for a in range(3)], axis=-1) / count[:, None]
    noise = np.bincount(of, np.trace(cov, axis1=1, axis2=2)) / count**2
    follows = np.diff(key) == 1
    step = ((mean[1:] - mean[:-1]) ** 2).sum(axis=1) - 2.0 * (noise[1:] + noise[:-1])
    swing = np.where(follows, np.maximum(step, 0.0) * (2.0 / np.pi) ** 2 / 3.0, 0.0)
    table = np.zeros((int(cluster.max()) + 1, n_blocks))
    table.flat[key[1:]] = swing
    table.flat[key[:-1]] = np.maximum(table.flat[key[:-1]], swing)
    widest = maximum_filter1d(table, 3, axis=1).flat[key]
    stretch_sigma = np.sqrt(np.maximum(mean_square, widest))
    return of.astype(np.int64), stretch_sigma, _WITHIN * np.maximum(sigma, stretch_sigma[of])
