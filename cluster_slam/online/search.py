"""The search for clusters that lost their flowers in a frame: a touch moves them farther than any filter predicts.

Each pair of one of its flowers and one point that no healthy cluster holds is a hypothesis of its displacement, scored
by how many of its members it explains, one to one, by points claimed by nobody else, against flowers that should be
seen and are not, and against how unlikely the jump is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.frames import information
from cluster_slam.config import TemplateConfig
from cluster_slam.geometry import Array
from cluster_slam.online.matching import Matches
from cluster_slam.records import BoolArray, IntArray

_FEW = 0.55  # a cluster that keeps fewer of its expected flowers is in trouble ...
_POOR_CHI2 = 7.0  # ... or whose flowers fit so badly on average (3 degrees of freedom)
_UNLIKELY_JUMP = -6.0  # log-likelihood that a touch happens now
_RECENT_S = 0.17  # unseen for longer: it may have gone farther
_TRIED = 2  # hypotheses that are refined
_MOST_POINTS = 60  # free points that are tried: more of them are a flood, not flowers


@dataclass(frozen=True, slots=True, eq=False)
class Scene:
    """What the search looks at: flowers that should be in view, free and other points, and the clusters' states.

    ``places`` (v, 3) of the flowers at rest, ``slot`` (v,) their clusters; ``w`` (p, 3) points with ``S`` (p, 3, 3);
    ``d`` (c, 3) predicted displacements with ``P`` (c, 3, 3), ``unseen_s`` (c,) how long each was not seen.
    """

    places: Array
    slot: IntArray
    w: Array
    S: Array
    d: Array
    P: Array
    unseen_s: Array


@dataclass(frozen=True, slots=True, eq=False)
class Moved:
    """A cluster found displaced by ``d`` (3,): its flowers (k,), points (k,), and chi-square (k,)."""

    score: float
    rows: IntArray
    cols: IntArray
    chi2: Array
    d: Array
    is_jump: bool


_NONE: IntArray = np.zeros(0, dtype=np.int64)
_NOTHING = Moved(-np.inf, _NONE, _NONE, np.zeros(0), np.zeros(3), False)


def find_moved(scene: Scene, matches: Matches, config: TemplateConfig) -> dict[int, Moved]:
    """Clusters (by slot) that lost their flowers and were found again; ``matches.rows`` index the scene's flowers."""
    n = len(scene.d)
    expected = np.bincount(scene.slot, minlength=n)
    owner = scene.slot[matches.rows]
    kept = np.bincount(owner, minlength=n)
    mean_chi2 = np.bincount(owner, matches.chi2, n) / np.maximum(kept, 1)
    troubled = (expected >= 2) & ((kept < _FEW * expected) | (mean_chi2 > _POOR_CHI2))
    free = np.ones(len(scene.w), dtype=bool)
    free[matches.cols[~troubled[owner]]] = False
    found: dict[int, Moved] = {}
    if not troubled.any() or not 2 <= free.sum() <= _MOST_POINTS:
        return found
    waiting = {j: _best(j, scene, free, config) for j in _promising(scene, troubled, free, kept, config)}
    while waiting:
        j = max(waiting, key=lambda k: (waiting[k].score, -k))
        best = waiting.pop(j)
        if best.score < config.min_score or len(best.cols) < 2:
            break
        found[j] = best
        free[best.cols] = False
        for k, other in waiting.items():
            if not free[other.cols].all():
                waiting[k] = _best(k, scene, free, config)
    return found


def _promising(scene: Scene, troubled: BoolArray, free: BoolArray, kept: IntArray, config: TemplateConfig) -> list[int]:
    """Clusters in trouble that have more free points about them than they kept."""
    flowers = np.flatnonzero(troubled[scene.slot])
    slot = scene.slot[flowers]
    reach = np.where(scene.unseen_s[slot] < _RECENT_S, config.reach_m, config.reach_unseen_m)
    gap = scene.w[free][None] - scene.places[flowers][:, None]
    near = np.einsum("fpi,fpi->fp", gap, gap) < (reach**2)[:, None]
    about = np.zeros((len(troubled), int(free.sum())), dtype=bool)
    np.logical_or.at(about, slot, near)
    return [int(j) for j in np.flatnonzero(troubled & (about.sum(1) > np.maximum(kept, 1)))]


def with_moved(matches: Matches, found: dict[int, Moved], slot: IntArray, n_points: int) -> Matches:
    """The matches with those of the found clusters in place of what these and their points had before."""
    moved = np.zeros(int(slot.max()) + 1, dtype=bool)
    moved[list(found)] = True
    taken = np.zeros(n_points, dtype=bool)
    taken[np.concatenate([h.cols for h in found.values()])] = True
    stays = ~moved[slot[matches.rows]] & ~taken[matches.cols]
    return Matches(
        np.concatenate([matches.rows[stays], *[h.rows for h in found.values()]]),
        np.concatenate([matches.cols[stays], *[h.cols for h in found.values()]]),
        np.concatenate([matches.chi2[stays], *[h.chi2 for h in found.values()]]),
    )


def _best(j: int, scene: Scene, free: BoolArray, config: TemplateConfig) -> Moved:
    """The likeliest displacement of cluster j among the free points."""
    mine = np.flatnonzero(scene.slot == j)
    is_recent = scene.unseen_s[j] < _RECENT_S
    reach = config.reach_m if is_recent else config.reach_unseen_m
    pool = np.flatnonzero(free)
    places = scene.places[mine]
    step = scene.w[pool][None] - places[:, None]
    near = (step * step).sum(-1) < reach * reach
    used = near.any(axis=0)
    if used.sum() < 2:
        return _NOTHING
    pool, step, near = pool[used], step[:, used], near[:, used]
    W = information(scene.S[pool] + config.landmark_sigma_m**2 * np.eye(3))
    d = np.concatenate([step[near], scene.d[j : j + 1], np.zeros((1, 3))])
    prior = _JumpPrior(scene.d[j], scene.P[j], config.jump_sigma_m * (1.0 if is_recent else 2.0))
    total = _gains(d, places, scene.w[pool], 0.5 * W, config.match_gain).max(axis=2).sum(axis=1) + prior(d)
    best = _NOTHING
    for h in np.argsort(-total, kind="stable")[:_TRIED]:
        if total[h] < max(config.min_score, best.score):
            break
        tried = _refined(d[h], scene, mine, pool, W, prior, config)
        best = tried if tried.score > best.score else best
    return best


def _refined(
    d: Array, scene: Scene, mine: IntArray, pool: IntArray, W: Array, prior: _JumpPrior, config: TemplateConfig
) -> Moved:
    """The displacement from all flowers that fit it, matched one to one, and its final score."""
    places, points = scene.places[mine], scene.w[pool]
    for scale in (0.5, 1.0):
        rows, cols = _greedy(_gains(d[None], places, points, scale * W, config.match_gain)[0])
        if len(rows) < 2:
            return _NOTHING
        total = W[cols].sum(0)
        pull = (W[cols] @ (points[cols] - places[rows])[..., None])[..., 0].sum(0)
        d = np.linalg.solve(total, pull)
    # The noise of so few points looks like a small jump: as predicted is the other explanation of the same matches.
    as_predicted = np.linalg.solve(total + prior.information, pull + prior.information @ prior.predicted)
    tried: list[Moved] = []
    for shift, log_prior in ((d, prior.jump(d)), (as_predicted, prior.stay(as_predicted))):
        residual = points[cols] - places[rows] - shift
        chi2 = np.einsum("qi,qij,qj->q", residual, W[cols], residual)
        score = np.maximum(config.match_gain - 0.5 * chi2, 0.0).sum() - (len(places) - len(rows)) + float(log_prior)
        tried.append(Moved(float(score), mine[rows], pool[cols], chi2, shift, is_jump=not tried))
    return max(tried, key=lambda m: m.score)


class _JumpPrior:
    """Log-likelihood of displacements (h, 3): as the filter predicts, or after a touch."""

    def __init__(self, predicted: Array, P: Array, jump_sigma: float) -> None:
        self.predicted, self.jump_sigma = predicted, jump_sigma
        self.information = information(P + 1e-12 * np.eye(3))

    def stay(self, d: Array) -> Array:
        """As the filter predicts."""
        step = d - self.predicted
        return np.asarray(-0.5 * ((step @ self.information) * step).sum(-1))

    def jump(self, d: Array) -> Array:
        """After a touch."""
        step = d - self.predicted
        return np.asarray(_UNLIKELY_JUMP - 0.5 * (step * step).sum(-1) / self.jump_sigma**2)

    def __call__(self, d: Array) -> Array:
        return np.maximum(self.stay(d), self.jump(d))


def _gains(d: Array, places: Array, points: Array, W: Array, match_gain: float) -> Array:
    """Gains (h, f, p) of matching flowers, displaced, with points: match_gain - chi2 / 2, at least zero."""
    x, y, z = np.moveaxis(points[None, None] - (places[None, :] + d[:, None])[:, :, None], -1, 0)
    chi2 = x * (W[:, 0, 0] * x + 2.0 * (W[:, 0, 1] * y + W[:, 0, 2] * z))
    chi2 += y * (W[:, 1, 1] * y + 2.0 * W[:, 1, 2] * z) + W[:, 2, 2] * z * z
    return np.asarray(np.maximum(match_gain - 0.5 * chi2, 0.0))


def _greedy(gain: Array) -> tuple[IntArray, IntArray]:
    """One-to-one pairs, largest gain first: exact enough inside one cluster, whose flowers stand apart."""
    gain = gain.copy()
    rows, cols = [], []
    for _ in range(min(gain.shape)):
        r, c = divmod(int(gain.argmax()), gain.shape[1])
        if gain[r, c] <= 0:
            break
        rows.append(r)
        cols.append(c)
        gain[r, :] = gain[:, c] = 0.0
    return np.array(rows, dtype=np.int64), np.array(cols, dtype=np.int64)
