"""One round of the grouping, spread over many frames: a few flowers a frame are asked where they belong.

The likelihood of partitions is that of ``smooth`` (``cluster_slam.grouping``). A round begins with the clusters that
are, or, where many flowers are new, with the likeliest cut of a linkage tree, if that is likelier. Flowers that were
seen since the last round are asked whether they belong to a neighbour's cluster, and their clusters whether they are
two, or one with a neighbour's.
"""

from __future__ import annotations

import numpy as np
from scipy.cluster.hierarchy import linkage
from scipy.sparse import csr_matrix
from scipy.spatial.distance import squareform

from cluster_slam.geometry import Array
from cluster_slam.grouping.flowers import come_in_clusters, stretched_distances
from cluster_slam.grouping.likelihood import Likelihood
from cluster_slam.grouping.partition import Cuts, Partition, improve, likeliest_cut, neighbours_of
from cluster_slam.records import BoolArray, IntArray

_FEWEST = 3  # members of what is called a cluster


class Round:
    """Flowers ``ids`` (l,) at ``places`` (l, 3), in clusters ``label`` (l,); those ``asked`` (l,) are asked.

    ``anew``: whether to look for all clusters from scratch, too.
    """

    def __init__(
        self,
        ids: IntArray,
        places: Array,
        label: IntArray,
        volume: float,
        evidence: csr_matrix,
        asked: BoolArray,
        anew: bool = True,
    ) -> None:
        self.ids, self.places = ids, places
        self.likelihood = Likelihood(places, volume, evidence)
        self._distance = stretched_distances(places, evidence)
        self._label = np.unique(label, return_inverse=True)[1].astype(np.int64)
        self._asked, self._anew, self._is_prepared = asked, anew, False

    def _prepare(self) -> None:
        """What takes as long as many changes, and has a frame of its own."""
        distance = 0.5 * (self._distance + self._distance.T)
        self.tree = linkage(squareform(distance, checks=False), "average")
        self.partition = Partition(self._label, self.likelihood, self._distance)
        self.neighbours = neighbours_of(self.places)
        self._cuts = Cuts(self.tree, self.likelihood) if self._anew else None
        self._flowers = np.flatnonzero(self._asked).tolist()[::-1]
        self._clusters = np.unique(self._label[self._asked]).tolist()[::-1]
        self._is_prepared = True

    def work(self, n_changes: int) -> bool:
        """Try so many changes or a few more; whether all have been asked."""
        if not self._is_prepared:
            self._prepare()
            return False
        if self._cuts is not None:
            if self._cuts.work(n_changes):
                self._take(self._cuts)
                self._cuts = None
            return False
        partition, n = self.partition, 0
        while n < n_changes and self._flowers:
            f = self._flowers.pop()
            changes = partition.moves(f, self.neighbours[f])
            partition.try_each(changes)
            n += len(changes)
        while n < n_changes and self._clusters:
            a = self._clusters.pop()
            for of in (partition.splits, lambda a: partition.joins(a, self.neighbours)):
                changes = of(a)
                partition.try_each(changes)
                n += len(changes) + 1
        return not (self._flowers or self._clusters)

    def _take(self, cuts: Cuts) -> None:
        """Begin with the likeliest cut, if it is likelier than what is; then all are asked."""
        if cuts.score > self.partition.score:
            self.partition = Partition(cuts.label, self.likelihood, self.partition.distance)
            self._flowers = list(range(len(self.ids)))[::-1]
            self._clusters = np.unique(cuts.label).tolist()[::-1]

    def label(self, together: float) -> IntArray:
        """Cluster (l,) of each flower; ``together``: ratio by when neighbours are seen."""
        label = self.partition.label
        if np.bincount(label).max() < _FEWEST or not come_in_clusters(label, self.likelihood, together):
            return np.arange(len(label))
        return label

    def link(self, label: IntArray) -> float:
        """How near, m, to a cluster of this partition a new flower must stand to belong to it; zero without clusters.

        Between the distances at which a tree of as many clusters was last joined and would be joined next.
        """
        n, c = len(label), len(np.unique(label))
        if c == n:
            return 0.0
        low = float(self.tree[n - c - 1, 2])
        high = float(self.tree[n - c, 2]) if c > 1 else 2.0 * low
        return float(np.sqrt(low * high))


def group_together(places: Array, volume: float) -> tuple[IntArray, float]:
    """Clusters 0..c-1 of flowers (l,) that are all seen for the first time, in one frame; the link, m."""
    n = len(places)
    nothing = csr_matrix((n, n))
    tree = linkage(squareform(stretched_distances(places, nothing), checks=False), "average")
    likelihood = Likelihood(places, volume, None)
    begun = improve(likeliest_cut(tree, likelihood), likelihood)
    round_of = Round(np.arange(n), places, begun, volume, nothing, np.zeros(n, dtype=bool), anew=False)
    while not round_of.work(1):
        pass
    label = np.unique(round_of.label(1.0), return_inverse=True)[1].astype(np.int64)
    return label, round_of.link(label)
