"""The likeliest partition of flowers into clusters: the best cut of a linkage tree, improved change by change."""

from __future__ import annotations

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.spatial import cKDTree
from scipy.spatial.distance import squareform

from cluster_slam.geometry import Array
from cluster_slam.grouping.likelihood import Likelihood, members_by_label
from cluster_slam.records import IntArray

_NEIGHBOURS = 6  # whose clusters a flower may move to
_MAX_SWEEPS = 10
_LEAST_GAIN = 1e-9  # log-likelihood

Change = tuple[IntArray, int]  # these flowers of one cluster, sorted, get that label


def likeliest_cut(tree: Array, likelihood: Likelihood) -> IntArray:
    """Of all cuts of a linkage tree the likeliest."""
    cuts = Cuts(tree, likelihood)
    cuts.work(len(tree))
    return cuts.label


class Cuts:
    """All cuts of a linkage tree, tried from the leaves up."""

    def __init__(self, tree: Array, likelihood: Likelihood) -> None:
        self.tree, self.likelihood = tree, likelihood
        self._nodes = [np.array([i], dtype=np.int64) for i in range(len(tree) + 1)]
        self._sums = likelihood.sums(self._nodes)
        self._height, self.score = -1.0, likelihood.of(self._sums)

    def work(self, n_merges: int) -> bool:
        """Try the cuts above so many merges more; whether all have been tried."""
        tree, nodes, height = self.tree, self._nodes, self.tree[:, 2]
        begin = len(nodes) - len(tree) - 1
        for i, (a, b) in enumerate(tree[begin : begin + n_merges, :2].astype(np.int64).tolist(), begin):
            nodes.append(np.sort(np.concatenate([nodes[a], nodes[b]])))
            self._sums = self.likelihood.changed(self._sums, (nodes[a], nodes[b]), nodes[-1:])
            is_cut = i + 1 == len(tree) or height[i + 1] > height[i] * (1.0 + 1e-12)
            if is_cut and (score := self.likelihood.of(self._sums)) > self.score:
                self._height, self.score = float(height[i]) * (1.0 + 1e-12), score
        return begin + n_merges >= len(tree)

    @property
    def label(self) -> IntArray:
        """Clusters (l,) of the likeliest so far."""
        if self._height < 0.0:
            return np.arange(len(self.tree) + 1, dtype=np.int64)
        return fcluster(self.tree, self._height, "distance").astype(np.int64) - 1


def improve(label: IntArray, likelihood: Likelihood) -> IntArray:
    """Move single flowers, join neighbours and split clusters as long as that makes the partition likelier."""
    partition = Partition(label, likelihood)
    neighbours = neighbours_of(likelihood.places)
    for _ in range(_MAX_SWEEPS):
        before = partition.score
        for f in range(len(label)):
            partition.try_each(partition.moves(f, neighbours[f]))
        for a in list(partition.members):
            partition.try_each(partition.splits(a))
            partition.try_each(partition.joins(a, neighbours))
        if partition.score <= before + _LEAST_GAIN:
            break
    return partition.label


class Partition:
    """A partition that changes: labels (l,), members by label, and its log-likelihood.

    Clusters are split where ``distance`` (l, l) is widest, where they stand if that is not given.
    """

    def __init__(self, label: IntArray, likelihood: Likelihood, distance: Array | None = None) -> None:
        self.label = label.copy()
        self.members = members_by_label(label)
        self.likelihood = likelihood
        self.sums = likelihood.sums(self.members.values())
        self.score = likelihood.of(self.sums)
        self.distance = distance

    def try_each(self, changes: list[Change]) -> None:
        """Carry out the change that helps most, if any."""
        best, score = None, self.score + _LEAST_GAIN
        for flowers, new in changes:
            gone, come = self._replaced(flowers, new)
            sums = self.likelihood.changed(self.sums, gone, come)
            if (value := self.likelihood.of(sums)) > score:
                best, score = (flowers, new, sums), value
        if best is not None:
            self._carry_out(*best[:2])
            self.sums, self.score = best[2], score

    def moves(self, f: int, neighbours: IntArray) -> list[Change]:
        """The flower to a neighbour's cluster, or into one of its own."""
        a = int(self.label[f])
        others = sorted({int(j) for j in self.label[neighbours]} - {a})
        alone = [] if len(self.members[a]) == 1 else [self._new_label()]
        return [(np.array([f]), j) for j in others + alone]

    def joins(self, a: int, neighbours: IntArray) -> list[Change]:
        """The whole cluster to one of its neighbours."""
        if a not in self.members:
            return []
        mine = self.members[a]
        return [(mine, j) for j in np.unique(self.label[neighbours[mine]]).tolist() if j != a]

    def splits(self, a: int) -> list[Change]:
        """The cluster in two, where it is widest."""
        if a not in self.members or len(self.members[a]) < 4:
            return []
        mine = self.members[a]
        if self.distance is None:
            tree = linkage(self.likelihood.places[mine], "average")
        else:
            tree = linkage(squareform(self.distance[np.ix_(mine, mine)], checks=False), "average")
        half = fcluster(tree, 2, "maxclust")
        return [(mine[half == 2], self._new_label())]

    def _new_label(self) -> int:
        return max(self.members) + 1

    def _replaced(self, flowers: IntArray, new: int) -> tuple[list[IntArray], list[IntArray]]:
        """Clusters that are gone after a change, and those that come for them."""
        old = self.members[int(self.label[flowers[0]])]
        left = old[old != flowers[0]] if len(flowers) == 1 else old[~np.isin(old, flowers)]
        gone, come = [old], [left] if len(left) else []
        if new not in self.members:
            return gone, [*come, flowers]
        joined = np.sort(np.concatenate([self.members[new], flowers]))
        return [*gone, self.members[new]], [*come, joined]

    def _carry_out(self, flowers: IntArray, new: int) -> None:
        old = int(self.label[flowers[0]])
        self.label[flowers] = new
        for a in (old, new):
            self.members[a] = np.flatnonzero(self.label == a)
        if not len(self.members[old]):
            del self.members[old]


def neighbours_of(places: Array) -> IntArray:
    """The nearest flowers (l, k) of each, to whose clusters it may move."""
    k = min(_NEIGHBOURS + 1, len(places))
    return np.asarray(cKDTree(places).query(places, k=k)[1])[:, 1:].astype(np.int64)
