"""Clusters that lost their flowers, and what a search found of them, many at once."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Lost:
    """The clusters to search for, g of them, sorted by lane: as their springs have them."""

    lane: IntArray  # (g,)
    predicted: Array  # (g, 3) displacement
    cov: Array  # (g, 3, 3)
    is_unseen: BoolArray  # (g,) for so long that it may be anywhere

    def only(self, which: IntArray) -> Lost:
        """Some of them."""
        return Lost(self.lane[which], self.predicted[which], self.cov[which], self.is_unseen[which])


@dataclass(frozen=True, slots=True, eq=False)
class Found:
    """Where each of g clusters is, with its score (-inf: not found), and q matches of flowers with points."""

    score: Array  # (g,)
    d: Array  # (g, 3)
    cov: Array  # (g, 3, 3)
    cluster: IntArray  # (q,) 0..g-1, sorted
    flower: IntArray  # (q,)
    point: IntArray  # (q,)
    chi2: Array  # (q,)

    def only(self, which: BoolArray) -> Found:
        """The same with some clusters (g,) found only."""
        q = which[self.cluster]
        return Found(
            np.where(which, self.score, -np.inf),
            self.d,
            self.cov,
            self.cluster[q],
            self.flower[q],
            self.point[q],
            self.chi2[q],
        )

    def merged(self, other: Found) -> Found:
        """Of each cluster the one with the larger score, this one where they are equal."""
        use = other.score > self.score
        a, b = self.only(~use), other.only(use)
        cluster = np.concatenate([a.cluster, b.cluster])
        order = np.argsort(cluster, kind="stable")
        return Found(
            np.where(use, b.score, a.score),
            np.where(use[:, None], b.d, a.d),
            np.where(use[:, None, None], b.cov, a.cov),
            cluster[order],
            np.concatenate([a.flower, b.flower])[order],
            np.concatenate([a.point, b.point])[order],
            np.concatenate([a.chi2, b.chi2])[order],
        )


def nothing_found(n: int) -> Found:
    """None of n clusters found."""
    none = np.empty(0, dtype=np.int64)
    return Found(np.full(n, -np.inf), np.zeros((n, 3)), np.zeros((n, 3, 3)), none, none, none, np.empty(0))
