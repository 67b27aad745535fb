"""Errors of a flower that last: how large they are, and how far one must look from elsewhere for new ones.

A detector's box errs with the side that a flower is seen from, and so does the depth of petals that are no plane: the
same way in all frames of one view. What two neighbours of one cluster seem to move against each other, from one view
to another, tells of it: there neither the pose nor sway has a part. Were errors new in each frame, means over the
frames of a view would differ by as little as their number says.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial
from typing import Any, NamedTuple

import numpy as np
from scipy.optimize import minimize_scalar

from cluster_slam.association.frames import Frames
from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

_STEP = 0.1  # rad: frames of one view
_TURNS = (0.1, 0.2, 0.4, 0.6, 0.9, 1.5)  # rad: with the last, little is left after half a turn about the flower
_FEWEST_FRAMES = 10  # in which neighbours were seen together
_FEWEST_PAIRS = 3
_LEAST = 0.03  # of the variance of one observation: less may be a lens, or a board that is not quite flat
_FIRST_TURN = 0.4  # rad: where nothing is found with it, nothing is there
_SEARCH: dict[str, Any] = {  # for the log of what lasts, in sigmas of one observation
    "bounds": (-6.0, 2.0),
    "method": "bounded",
    "options": {"xatol": 0.02},
}
_SURE = 8.0  # log likelihood ratio that what lasts must reach: four sigmas


@dataclass(frozen=True, slots=True)
class LastingErrors:
    """Errors of flowers in the camera's frame that last, and shares of the stated variances that are new in each frame.

    Both along the ray and across it; the correlation of what lasts falls to 1 / e over ``turn`` (rad) between views.
    """

    along_m: float
    across_m: float
    new_along: float
    new_across: float
    turn: float

    def new(self, points: Array, covs: Array) -> Array:
        """Covariances (m, 3, 3) of what is new in each of observations at points (m, 3) with ``covs``."""
        along, across = np.sqrt(self.new_along), np.sqrt(self.new_across)
        factor = _along_and_across(points, along, across)
        new: Array = factor @ covs @ factor
        return new

    def root(self, points: Array) -> Array:
        """Square roots (m, 3, 3) of the covariance of what lasts, camera frame, m."""
        return _along_and_across(points, self.along_m, self.across_m)

    def correlation(self, view: Array, other: Array) -> Array:
        """Correlation (a, b) of what lasts between views (a, 3, 3) and (b, 3, 3)."""
        alike: Array = np.exp(-turns(view, other) / self.turn)
        return alike


def _along_and_across(points: Array, along: float, across: float) -> Array:
    ray = points / np.linalg.norm(points, axis=-1, keepdims=True)
    root: Array = across * np.eye(3) + (along - across) * ray[:, :, None] * ray[:, None]
    return root


def views(frames: Frames, T: Array) -> Array:
    """Of each observation (m, 3, 3) rows: the ray, the picture's u axis across it, and v, in the world."""
    axes = np.stack(_axes(frames.points), axis=1)
    view: Array = axes @ np.swapaxes(T[frames.frame, :3, :3], 1, 2)
    return view


def turns(view: Array, other: Array) -> Array:
    """How far apart (a, b) views (a, 3, 3) and (b, 3, 3) are, rad: the chord of the turn from one to the other."""
    one, two = view.reshape(-1, 9), other.reshape(-1, 9)
    square = (one**2).sum(axis=1)[:, None] + (two**2).sum(axis=1) - 2.0 * one @ two.T
    apart: Array = np.sqrt(np.maximum(0.5 * square, 0.0))
    return apart


def _axes(points: Array) -> tuple[Array, Array, Array]:
    ray = points / np.linalg.norm(points, axis=-1, keepdims=True)
    u = np.array([1.0, 0.0, 0.0]) - ray * ray[:, :1]
    u /= np.linalg.norm(u, axis=-1, keepdims=True)
    return ray, u, np.cross(ray, u)


def one_view(view: Array, step: float) -> IntArray:
    """Number of the view (m,) to which each of (m, 3, 3) belongs: those less than ``step`` rad from its first."""
    of = np.full(len(view), -1, dtype=np.int64)
    number = 0
    while (free := np.flatnonzero(of < 0)).size:
        of[free[turns(view[free[:1]], view[free])[0] <= step]] = number
        number += 1
    return of


def lasting_errors(
    frames: Frames, T: Array, landmark: IntArray, places: Array, cluster: IntArray, used: BoolArray
) -> LastingErrors | None:
    """What lasts of the errors of flowers, as neighbours tell; None where nothing is seen of it.

    ``landmark`` (m,) flower of each observation, ``places`` (l, 3) m, ``cluster`` (l,), ``used`` (m,) observations
    that agree with their flowers.
    """
    pairs = [_Means.of(*seen) for seen in _differences(frames, T, landmark, places, cluster, used)]
    pairs = [pair for pair in pairs if len(pair.n) > 1]
    if len(pairs) < _FEWEST_PAIRS:
        return None
    within = np.sum([pair.within for pair in pairs], axis=0) / sum(pair.freedom for pair in pairs)
    new = np.array([within[0], within[1:].mean()])
    if _fit(pairs, new, _FIRST_TURN).gain < 0.5 * _SURE:
        return None
    best = max((_fit(pairs, new, turn) for turn in _TURNS), key=lambda fit: fit.gain)
    if best.gain < _SURE or best.share < _LEAST:
        return None
    return LastingErrors(best.along_m, best.across_m, float(new[0]), float(new[1]), best.turn)


def _differences(
    frames: Frames, T: Array, landmark: IntArray, places: Array, cluster: IntArray, used: BoolArray
) -> list[tuple[Array, Array, Array]]:
    """Of each two neighbours: what they moved against each other (n, 3), its stated variances (n, 3), views (n, 3, 3).

    Along the ray, along u and along v, in the frames that saw both.
    """
    observation = np.full((len(places), frames.n_frames), -1)
    k = np.flatnonzero((landmark >= 0) & used)
    observation[landmark[k], frames.frame[k]] = k
    view, out = views(frames, T), []
    for f, g in _neighbours(places, cluster):
        both = np.flatnonzero((observation[[f, g]] >= 0).all(axis=0))
        if len(both) < _FEWEST_FRAMES:
            continue
        one, other = observation[f, both], observation[g, both]
        apart = np.swapaxes(T[both, :3, :3], 1, 2) @ (places[f] - places[g])
        axes = np.stack(_axes(frames.points[one] + frames.points[other]), axis=1)
        moved = (axes @ (frames.points[one] - frames.points[other] - apart)[..., None])[..., 0]
        var = np.einsum("nai,nij,naj->na", axes, frames.covs[one] + frames.covs[other], axes)
        out.append((moved, var, view[one]))
    return out


def _neighbours(places: Array, cluster: IntArray) -> list[tuple[int, int]]:
    """Pairs of a flower and the nearest of its cluster."""
    pairs = set()
    for f in range(len(places)):
        mates = np.flatnonzero((cluster == cluster[f]) & (np.arange(len(places)) != f))
        if len(mates):
            g = int(mates[np.linalg.norm(places[mates] - places[f], axis=1).argmin()])
            pairs.add((min(f, g), max(f, g)))
    return sorted(pairs)


@dataclass(frozen=True, slots=True, eq=False)
class _Means:
    """Of two neighbours the mean of each view (a, 3), its stated variance (a, 3), where it is seen from (a, 3, 3)."""

    mean: Array
    var: Array
    n: Array  # (a,) frames
    view: Array
    within: Array  # (3,) squares about the means, over the stated variance
    freedom: int

    @classmethod
    def of(cls, moved: Array, var: Array, view: Array) -> _Means:
        at = one_view(view, _STEP)
        n = np.bincount(at).astype(float)
        mean, stated = (np.stack([np.bincount(at, x[:, a]) / n for a in range(3)], axis=1) for x in (moved, var))
        centre = np.stack([np.bincount(at, x) / n for x in view.reshape(len(view), 9).T], axis=1).reshape(-1, 3, 3)
        within = ((moved - mean[at]) ** 2 / var).sum(axis=0)
        return cls(mean, stated / n[:, None], n, centre, within, len(moved) - len(n))

    def log_likelihood(self, axis: int, new: float, lasts: float, correlation: Array) -> float:
        """Of the means along an axis, their common mean unknown (restricted); ``lasts``: variance of each flower."""
        C = np.diag(new * self.var[:, axis]) + 2.0 * lasts * correlation
        L = np.linalg.cholesky(C)
        white = np.linalg.solve(L, np.column_stack([np.ones(len(C)), self.mean[:, axis]]))
        one, y = white.T
        known = float(one @ one)
        square = float(y @ y) - float(one @ y) ** 2 / known
        return -float(np.log(np.diag(L)).sum()) - 0.5 * (float(np.log(known)) + square)


class _Fit(NamedTuple):
    """How large what lasts is, at most as a share of one observation's variance, and how much likelier than nothing.

    That is the log of the ratio.
    """

    along_m: float
    across_m: float
    turn: float
    share: float
    gain: float


def _fit(pairs: list[_Means], new: Array, turn: float) -> _Fit:
    """The likeliest for errors that change over ``turn`` (rad), ``new`` (2,) of the stated variances new each time."""
    correlations = [np.exp(-turns(pair.view, pair.view) / turn) for pair in pairs]
    sigma, largest, gain = [], 0.0, 0.0
    for share, axes in zip(new.tolist(), ((0,), (1, 2)), strict=True):
        unit = float(np.median(np.concatenate([(pair.var * pair.n[:, None])[:, axes].ravel() for pair in pairs])))
        cost = partial(_cost, pairs, correlations, axes, share)
        found = minimize_scalar(lambda s, c=cost, u=unit: c(u * np.exp(2.0 * s)), **_SEARCH)
        sigma.append(float(np.sqrt(unit) * np.exp(found.x)))
        largest = max(largest, 2.0 * float(np.exp(2.0 * found.x)))  # the unit is of the difference of two flowers
        gain += cost(0.0) - float(found.fun)
    return _Fit(sigma[0], sigma[1], turn, largest, gain)


def _cost(pairs: list[_Means], correlations: list[Array], axes: tuple[int, ...], new: float, lasts: float) -> float:
    return -sum(
        pair.log_likelihood(axis, new, lasts, correlation)
        for pair, correlation in zip(pairs, correlations, strict=True)
        for axis in axes
    )
