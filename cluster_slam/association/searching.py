"""Searching for clusters that lost their flowers (a shake begins with a jump in velocity that no filter predicts).

Each pair of one of a cluster's flowers and one free point near it is a hypothesis of where the cluster is; two flowers
at least must fit it. The clusters of many frames are searched for at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.association.frames import information
from cluster_slam.association.lanes import pairs_in_lanes, run_starts, sums
from cluster_slam.association.lost import Found, Lost, nothing_found
from cluster_slam.config import TemplateConfig
from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

_LOG_JUMP = -6.0  # log-likelihood of a jump, before its length
_N_REFINED = 3  # hypotheses of a cluster that are looked at closely


def find_lost(
    lost: Lost,
    places: Array,
    cluster: IntArray,
    free: BoolArray,
    w: Array,
    S: Array,
    point_lane: IntArray,
    config: TemplateConfig,
) -> Found:
    """Where lost clusters are: the surest take their points first, and who wanted one of them looks again.

    Rest ``places`` (f, 3) of the flowers in view with the lost ``cluster`` 0..g-1 (f,) of each, sorted; points w (p, 3)
    with covariances S (p, 3, 3), of which those that are ``free`` (p,) may be taken, and their lanes, sorted.
    """
    free = free.copy()
    found = nothing_found(len(lost.lane))
    seeking = np.arange(len(lost.lane))
    while len(seeking):
        mine = np.flatnonzero(np.isin(cluster, seeking))
        number = np.searchsorted(seeking, cluster[mine])
        new = Search(lost.only(seeking), places[mine], number, config).best(np.flatnonzero(free), w, S, point_lane)
        takes, again = _surest_first(new, free)
        new = new.only(takes)
        everywhere = nothing_found(len(lost.lane))
        everywhere.score[seeking], everywhere.d[seeking], everywhere.cov[seeking] = new.score, new.d, new.cov
        found = found.merged(
            replace(everywhere, cluster=seeking[new.cluster], flower=mine[new.flower], point=new.point, chi2=new.chi2)
        )
        seeking = seeking[again]
    return found


def _surest_first(found: Found, free: BoolArray) -> tuple[BoolArray, BoolArray]:
    """Which clusters (g,) take their points, no longer ``free`` then, and which must look again."""
    takes, again = np.zeros((2, len(found.score)), dtype=bool)
    starts = np.searchsorted(found.cluster, np.arange(len(found.score) + 1))
    for j in np.argsort(-found.score, kind="stable"):
        if found.score[j] == -np.inf:
            break
        points = found.point[starts[j] : starts[j + 1]]
        takes[j] = free[points].all()
        again[j] = not takes[j]
        if takes[j]:
            free[points] = False
    return takes, again


@dataclass(frozen=True, slots=True, eq=False)
class _Edges:
    """Pairs of a flower and a point that may be it, sorted by cluster, then flower."""

    cluster: IntArray
    flower: IntArray
    point: IntArray
    step: Array  # (e, 3) from the flower's rest to the point
    W: Array  # (e, 3, 3) information of the point
    is_near: BoolArray


class Search:
    """The flowers of lost clusters among the points of their frames."""

    def __init__(self, lost: Lost, places: Array, cluster: IntArray, config: TemplateConfig) -> None:
        """Rest ``places`` (f, 3) of the flowers in view with the lost ``cluster`` 0..g-1 (f,) of each, sorted."""
        self.lost, self.places, self.cluster, self.config = lost, places, cluster, config
        self.n_flowers = np.bincount(cluster, minlength=len(lost.lane))
        self._information = information(lost.cov + 1e-12 * np.eye(3))
        self._jump_sigma = config.jump_sigma_m * np.where(lost.is_unseen, 2.0, 1.0)

    def best(self, free: IntArray, w: Array, S: Array, point_lane: IntArray) -> Found:
        """The best hypothesis of each cluster among the points ``free``, of all points w (p, 3) with S (p, 3, 3)."""
        edges = self._edges(free, w, S, point_lane)
        cluster, d, total = self._hypotheses(edges)
        order = np.lexsort((-total, cluster))
        h = order[(_rank(cluster[order]) < _N_REFINED) & (total[order] >= self.config.min_score)]
        return self._refined(cluster[h], d[h], edges) if len(h) else nothing_found(len(self.lost.lane))

    def _edges(self, free: IntArray, w: Array, S: Array, point_lane: IntArray) -> _Edges:
        """Flowers with the points that lie within reach of any flower of their cluster, where there are two of both."""
        cfg, n = self.config, len(self.lost.lane)
        reach = np.where(self.lost.is_unseen, cfg.reach_unseen_m, cfg.reach_m)
        lane = self.lost.lane[self.cluster]
        flower, at = pairs_in_lanes(lane, point_lane[free], int(lane[-1]) + 1 if len(lane) else 0)
        point, cluster = free[at], self.cluster[flower]
        step = w[point] - self.places[flower]
        near = (step * step).sum(-1) < reach[cluster] ** 2
        used = np.zeros((n, len(free)), dtype=bool)
        used[cluster[near], at[near]] = True
        used &= ((used.sum(axis=1) >= 2) & (self.n_flowers >= 2))[:, None]
        keep = used[cluster, at]
        W = information(S[free] + cfg.landmark_sigma_m**2 * np.eye(3))
        return _Edges(cluster[keep], flower[keep], point[keep], step[keep], W[at[keep]], near[keep])

    def _hypotheses(self, edges: _Edges) -> tuple[IntArray, Array, Array]:
        """Cluster (h,), displacement (h, 3) and score (h,) of what is worth a closer look: two flowers fit it."""
        near = np.flatnonzero(edges.is_near)
        seeking = np.unique(edges.cluster)
        cluster = np.concatenate([edges.cluster[near], seeking, seeking])
        d = np.concatenate([edges.step[near], self.lost.predicted[seeking], np.zeros((len(seeking), 3))])
        order = np.argsort(cluster, kind="stable")
        cluster, d = cluster[order], d[order]
        h, e = pairs_in_lanes(cluster, edges.cluster, len(self.lost.lane))
        if len(h) == 0:
            return cluster[:0], d[:0], np.empty(0)
        gain = _gains(edges.step[e] - d[h], 0.5 * edges.W[e], self.config.match_gain)
        starts = run_starts(h * len(self.places) + edges.flower[e])
        of_flower = np.maximum.reduceat(gain, starts)  # the point that fits a flower best
        total: Array = np.bincount(h[starts], of_flower, len(d)) + self.log_prior(cluster, d)
        two = np.bincount(h[starts], of_flower > 0.0, len(d)) >= 2
        return cluster[two], d[two], total[two]

    def _refined(self, cluster: IntArray, d: Array, edges: _Edges) -> Found:
        """Of hypotheses (h,), displacements from all flowers that fit, matched one to one: the best of each cluster."""
        cfg = self.config
        h, e = pairs_in_lanes(cluster, edges.cluster, len(self.lost.lane))
        total = np.tile(np.eye(3), (len(d), 1, 1))
        for scale in (0.5, 1.0):
            gain = _gains(edges.step[e] - d[h], scale * edges.W[e], cfg.match_gain)
            taken = _greedy(gain, h, edges.flower[e], edges.point[e])
            fits = np.bincount(h[taken], minlength=len(d)) >= 2
            taken = taken[fits[h[taken]]]
            W, step = edges.W[e[taken]], edges.step[e[taken]]
            total[fits] = sums(W, h[taken], len(d))[fits]
            moment = sums((W @ step[..., None])[..., 0], h[taken], len(d))
            d = np.where(fits[:, None], (information(total) @ moment[..., None])[..., 0], d)
            last = h[taken], e[taken]
            rest = fits[h]
            h, e = h[rest], e[rest]
        h, e = last
        chi2 = _chi2(edges.step[e] - d[h], edges.W[e])
        q = np.bincount(h, minlength=len(d))
        total_gain = np.bincount(h, np.maximum(cfg.match_gain - 0.5 * chi2, 0.0), len(d))
        score = total_gain - (self.n_flowers[cluster] - q) + self.log_prior(cluster, d)
        score[(q < 2) | (score < cfg.min_score)] = -np.inf
        order = np.lexsort((-score, cluster))
        best = order[run_starts(cluster[order])]
        found = nothing_found(len(self.lost.lane))
        found.score[cluster[best]], found.d[cluster[best]] = score[best], d[best]
        found.cov[cluster[best]] = information(total[best])
        is_best = np.zeros(len(d), dtype=bool)
        is_best[best] = np.isfinite(score[best])
        kept = np.flatnonzero(is_best[h])
        kept = kept[np.argsort(cluster[h[kept]], kind="stable")]
        h, e = h[kept], e[kept]
        return replace(found, cluster=cluster[h], flower=edges.flower[e], point=edges.point[e], chi2=chi2[kept])

    def log_prior(self, cluster: IntArray, d: Array) -> Array:
        """Log-likelihood of displacements (h, 3): as the spring predicts, or after a jump."""
        step = d - self.lost.predicted[cluster]
        chi2 = _chi2(step, self._information[cluster])
        jump = _LOG_JUMP - 0.5 * (step * step).sum(1) / self._jump_sigma[cluster] ** 2
        value: Array = np.maximum(-0.5 * chi2, jump)
        return value


def _rank(sorted_keys: IntArray) -> IntArray:
    """Place of each row within its run of equal keys."""
    if len(sorted_keys) == 0:
        return sorted_keys
    starts = run_starts(sorted_keys)
    return np.arange(len(sorted_keys)) - np.repeat(starts, np.diff(np.append(starts, len(sorted_keys))))


def _chi2(diff: Array, W: Array) -> Array:
    """Squared distances (q,) of differences (q, 3) with information (q, 3, 3)."""
    x, y, z = diff.T
    chi2 = x * (W[:, 0, 0] * x + 2.0 * (W[:, 0, 1] * y + W[:, 0, 2] * z))
    chi2 += y * (W[:, 1, 1] * y + 2.0 * W[:, 1, 2] * z) + W[:, 2, 2] * z * z
    return np.asarray(chi2)


def _gains(diff: Array, W: Array, match_gain: float) -> Array:
    """Gains (q,) of matching flowers with points: match_gain - chi2 / 2, at least zero."""
    gain: Array = np.maximum(match_gain - 0.5 * _chi2(diff, W), 0.0)
    return gain


def _greedy(gain: Array, group: IntArray, row: IntArray, col: IntArray) -> IntArray:
    """Pairs (q,) taken one to one within each group (sorted), largest gain first, while there is any gain.

    Exact enough inside one cluster, whose flowers stand apart.
    """
    left = np.flatnonzero(gain > 0.0)
    taken = []
    while len(left):
        starts = run_starts(group[left])
        run = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(left))))
        is_best = gain[left] == np.maximum.reduceat(gain[left], starts)[run]
        at = np.flatnonzero(is_best)
        best = left[at[np.searchsorted(at, starts)]]  # the first of each group
        taken.append(best)
        left = left[(row[left] != row[best][run]) & (col[left] != col[best][run])]
    return np.concatenate(taken) if taken else left
