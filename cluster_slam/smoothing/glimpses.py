"""What was seen for less than a swing may have been off its rest all the while: a place is as uncertain as that.

The displacements of one visit are compared with what each swing that this session knows would show in that time: a
Gaussian process about an unknown rest, one for each width and each frequency, and one for what is thought so far. Each
says how well the rest is known from the visit (the generalised least squares of a constant), and how likely the visit
is (the restricted likelihood; Patterson and Thompson 1971). Long visits tell a swing from rest, and change nothing.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import IntArray
from cluster_slam.smoothing.displaced import Displaced

_APART = 2.0  # quarters of a period after which a cluster that was not seen meets the camera at any phase
_LONGEST = 8.0  # quarters of a period: who was seen for two swings is known to swing or not
_BINS = 4.0  # in a quarter: sway hardly changes in between
_WIDTHS = (0.1, 0.3, 0.5, 0.7, 0.9)  # quantiles of what is known to have swung
_SLOWER = ((0.5, 0.25), (1.0, 0.5), (2.0, 0.25))  # times the usual period, and how many clusters swing so
_FLAT = 1.0  # m: nothing else is known of a place
_STEPS = 6  # of Newton's method: convergence from below, quadratic


@dataclass(frozen=True, slots=True, eq=False)
class _Visit:
    """What h hypotheses make of a visit: the rest (h, 3) m, its variance (h,), log-likelihood (h,) with it free."""

    rest: Array
    var: Array
    log_likelihood: Array

    def weights(self, prior: Array, mean: Array, var: float) -> Array:
        """Probabilities (h,) where all else says that the rest is at ``mean`` (3,), with ``var``, m^2."""
        total = self.var + var
        score = (
            self.log_likelihood + np.log(prior[: len(self.var)]) - 0.5 * ((self.rest - mean) ** 2).sum(axis=1) / total
        )
        score -= 1.5 * np.log(total / self.var)
        weight = np.exp(score - score.max())
        return np.asarray(weight / weight.sum())

    def spread(self, weight: Array) -> float:
        """Mean square error along any axis, m^2, of the rest that the first hypothesis gives."""
        off = ((self.rest - self.rest[0]) ** 2).sum(axis=1) / 3.0
        return float(weight @ (self.var + off))


def widened(
    moved: Displaced,
    rest: float,
    lasting_s: float,
    quarter_s: float,
    stretch: IntArray,
    stretch_sigma: Array,
    sigma: Array,
) -> Array:
    """Sigmas (s,) of stretches, m, wider where a cluster was seen for less than a swing.

    ``stretch`` (p,) of each displacement, ``sigma`` (p,) m about its mean; motion at rest is ``rest`` m and lasts for
    ``lasting_s``, a quarter of a swing's period ``quarter_s``.
    """
    moving = moved.scale > 0.0
    if not moving.any():
        return stretch_sigma
    moved = replace(moved, scale=np.where(moving, stretch_sigma[stretch], 0.0))
    widths = np.quantile(moved.scale[moving], _WIDTHS)
    prior = _prior(float(np.clip(moving.mean(), 0.02, 0.98)))
    noise = moved.noise
    within = 1.0 / (sigma**2 + noise)
    out = stretch_sigma.copy()
    for visits in _visits(moved, _APART * quarter_s):
        known = [_seen(moved, v, noise[v], widths, rest, lasting_s, quarter_s) for v in visits]
        flat = [v.spread(v.weights(prior, np.zeros(3), _FLAT**2)) for v in known]
        information = np.array([1.0 / f for f in flat])
        moment = np.array([i * v.rest[0] for i, v in zip(information, known, strict=True)])
        for k, (pairs, visit) in enumerate(zip(visits, known, strict=True)):
            others = max(float(information.sum() - information[k]), _FLAT**-2)
            weight = visit.weights(prior, (moment.sum(axis=0) - moment[k]) / others, 1.0 / others)
            more = visit.spread(weight) - float(visit.var[0])
            own = np.unique(stretch[pairs])
            error = 1.0 / np.bincount(stretch[pairs], within[pairs])[own]
            out[own] = np.sqrt(out[own] ** 2 + _added(out[own] ** 2 + error, more))
    return out


def _prior(share: float) -> Array:
    """Of what is thought so far, and of all swings, where clusters swing in a ``share`` of what was seen."""
    swings = [share * often / len(_WIDTHS) for _, often in _SLOWER for _ in _WIDTHS]
    return np.array([1.0 - share, *swings])


def _visits(moved: Displaced, apart_s: float) -> list[list[IntArray]]:
    """Displacements of each visit of each cluster, in time."""
    stamps = moved.stamps[moved.frame]
    order = np.lexsort((stamps, moved.cluster))
    out = []
    for mine in np.split(order, np.flatnonzero(np.diff(moved.cluster[order])) + 1):
        out.append(np.split(mine, np.flatnonzero(np.diff(stamps[mine]) > apart_s) + 1))
    return out


def _seen(
    moved: Displaced, pairs: IntArray, noise: Array, widths: Array, rest: float, lasting_s: float, quarter_s: float
) -> _Visit:
    """One visit with its ``noise`` (q,) m^2; of a long one only where its middle was."""
    t = moved.stamps[moved.frame[pairs]]
    if t[-1] - t[0] > _LONGEST * quarter_s:
        n_quarters = (t[-1] - t[0]) / quarter_s
        var = (rest**2 + float((moved.scale[pairs] ** 2).mean())) / n_quarters + 1.0 / (1.0 / noise).sum()
        return _Visit(moved.d[pairs].mean(axis=0)[None], np.array([var]), np.zeros(1))
    bins = np.unique(np.floor((t - t[0]) / quarter_s * _BINS), return_inverse=True)[1]
    weight = 1.0 / noise
    total = np.bincount(bins, weight)

    def mean(x: Array) -> Array:
        return np.asarray(np.bincount(bins, weight * x) / total)

    y = np.stack([mean(x) for x in moved.d[pairs].T], axis=-1)
    t, scale, kept = mean(t - t[0]), np.sqrt(mean(moved.scale[pairs] ** 2)), np.sqrt(mean(moved.share[pairs]))
    apart = np.abs(t[:, None] - t)
    calm = rest**2 * np.exp(-2.0 * apart / lasting_s) + np.diag(1.0 / total)
    thought = calm + scale[:, None] * scale * _swing(apart, quarter_s)
    covs = [thought]
    for slower, _ in _SLOWER:
        for width in widths:
            wide = kept * np.maximum(scale, width)
            covs.append(calm + wide[:, None] * wide * _swing(apart, slower * quarter_s))
    return _constant(np.array(covs), y)


def _swing(apart: Array, quarter_s: float) -> Array:
    """Correlation of a swing with itself, phases and like frequencies averaged."""
    return np.asarray(np.cos(0.5 * np.pi * apart / quarter_s) * np.exp(-((apart / (6.0 * quarter_s)) ** 2)))


def _constant(covs: Array, y: Array) -> _Visit:
    """The constant that y (n, 3) is about, its errors having covariances (h, n, n) along each axis."""
    L = np.linalg.cholesky(covs)
    white = np.linalg.solve(L, np.broadcast_to(np.column_stack([np.ones(len(y)), y]), (len(covs), len(y), 4)))
    one, z = white[..., :1], white[..., 1:]
    information = (one**2).sum(axis=(1, 2))
    rest = (one * z).sum(axis=1) / information[:, None]
    left = (z**2).sum(axis=(1, 2)) - information * (rest**2).sum(axis=1)
    half_log_det = np.log(np.diagonal(L, axis1=1, axis2=2)).sum(axis=1)
    return _Visit(rest, 1.0 / information, -0.5 * left - 3.0 * half_log_det - 1.5 * np.log(information))


def _added(var: Array, more: float) -> float:
    """What to add to each variance (k,) so that the variance of their weighted mean grows by ``more``."""
    if more <= 0.0:
        return 0.0
    wanted, added = 1.0 / (1.0 / var).sum() + more, 0.0
    for _ in range(_STEPS):
        information = (1.0 / (var + added)).sum()
        slope = ((var + added) ** -2).sum() / information**2
        added += float((wanted - 1.0 / information) / slope)
    return added
