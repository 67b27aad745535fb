"""The likeliest partition of flowers into clusters, from where they stand and from what their motion says.

Clusters stand anywhere in the space that was looked at; members scatter about their centroid with one sigma for all
clusters; the number of members is Poisson, and some flowers are loose. To this comes the evidence of each pair within a
cluster; of the pairs among n members that pairs tie together at most n - 1 say something new, so that they weigh no
more than that together. Members of whom no pair is known add nothing to it.

Neither clusters nor members come in an order: the density of c clusters in a volume V is c! / V^c, and that of n
members n! times their number's probability (a Neyman-Scott process; Daley and Vere-Jones, "An introduction to the
theory of point processes", 2003, section 6.3). It matters where clusters are many.
"""

from __future__ import annotations

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.special import gammaln

from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

_NEIGHBOURS = 6  # whose clusters a flower may move to
_MAX_SWEEPS = 10
_FEW = 3.0  # clusters
_PRIOR_SIZES = 30.0  # clusters: fewer say nothing certain of what sizes there are
_LOOSE = 0.25  # of the clusters, before the data
_SMALL = 32  # members of a cluster that is faster looked through as a table than as a graph
_USUAL_SIZE = 4.5  # members, before the data


class Likelihood:
    """Log-likelihood of partitions of flowers at ``places`` (l, 3)."""

    def __init__(self, places: Array, volume: float, spacing: float, evidence: csr_matrix | None) -> None:
        """``volume`` m^3 that was looked at, ``spacing`` m to the nearest flower, ``evidence`` (l, l) of motion."""
        sides = np.ptp(places, axis=0)
        self.places = places
        k, n = max(len(places), 3), len(places)
        # The range of k points in a box is (k - 1) / (k + 1) of its side.
        self.box = float(np.prod(np.maximum(sides, 0.1 * sides.max()) * (k + 1.0) / (k - 1.0)))
        self.view = volume
        self.log_volume = float(np.log(max(self.box, volume)))
        self.prior_sigma = 0.7 * spacing
        self.known: BoolArray = np.zeros((n, n), dtype=bool)
        self.evidence: Array = np.zeros((n, n))
        if evidence is not None:
            pairs = evidence.tocoo()
            self.known[pairs.row, pairs.col] = pairs.row != pairs.col
            self.evidence[pairs.row, pairs.col] = np.where(pairs.row != pairs.col, pairs.data, 0.0)
        self._motion_of: dict[bytes, float] = {}  # of clusters by their members: most are the same in many partitions

    def knowing(self, n_clusters: int) -> None:
        """Take the flowers' own extent for that of the plant, as far as so many clusters tell it."""
        few, c = _FEW * np.log(self.view), n_clusters * np.log(self.box)
        self.log_volume = float((few + c) / (_FEW + n_clusters))

    def __call__(self, label: IntArray) -> float:
        """Of the clusters that ``label`` (l,) names with any integers."""
        _, label, size = np.unique(label, return_inverse=True, return_counts=True)
        return self._scatter(label, size) + self._motion(label, size)

    def _scatter(self, label: IntArray, size: IntArray, prior_weight: float = 1.0) -> float:
        """Sigma takes its most probable value; a weak prior keeps it from zero."""
        centre = np.stack([np.bincount(label, self.places[:, a]) for a in range(3)], axis=-1) / size[:, None]
        n, c = len(self.places), len(size)
        square = float(((self.places - centre[label]) ** 2).sum())
        dof = 3.0 * (n - c)
        var = (square + 3.0 * prior_weight * self.prior_sigma**2) / (dof + 3.0 * prior_weight)
        scatter = -0.5 * dof * np.log(2.0 * np.pi * var) - 0.5 * square / var - 1.5 * np.log(size).sum()
        return float(scatter + gammaln(c + 1.0) - c * self.log_volume + _log_sizes(size))

    def _motion(self, label: IntArray, size: IntArray) -> float:
        total = 0.0
        order = np.argsort(label, kind="stable")
        for members in np.split(order, np.cumsum(size)[:-1]):
            if len(members) < 2:
                continue
            key = members.tobytes()
            if key not in self._motion_of:
                self._motion_of[key] = self._motion_within(members)
            total += self._motion_of[key]
        return total

    def _motion_within(self, members: IntArray) -> float:
        """Evidence of the pairs of one cluster's members (k,), sorted."""
        within = np.ix_(members, members)
        known = self.known[within]
        if len(members) > _SMALL:
            of = connected_components(csr_matrix(known.astype(np.int8)), directed=False)[1]
        else:
            together = known | np.eye(len(members), dtype=bool)
            for _ in range(int(np.ceil(np.log2(len(members))))):  # along paths twice as long each time
                together = together @ together
            of = together.argmax(axis=1)  # the first of those that pairs tie together
        n_tied, n_pairs = np.bincount(of), 0.5 * np.bincount(of, known.sum(axis=1))
        weight = np.minimum(1.0, (n_tied - 1.0) / np.maximum(n_pairs, 1.0))
        return float(0.5 * (self.evidence[within].sum(axis=1) * weight[of]).sum())


def _log_sizes(size: IntArray) -> float:
    """Log-density of members in no order, given how often each number of members occurs in this partition.

    Frequencies of sizes have a Dirichlet prior (as much as ``_PRIOR_SIZES`` clusters would tell) about a Poisson number
    from one upwards, but for one in four that is loose: plants have sizes of their own, which most clusters share.
    """
    c, mean = len(size), _USUAL_SIZE
    n, count = np.unique(size, return_counts=True)
    poisson = np.exp(n * np.log(mean) - mean - gammaln(n + 1.0)) / -np.expm1(-mean)
    prior = _PRIOR_SIZES * ((1.0 - _LOOSE) * poisson + _LOOSE * (n == 1))
    frequencies = gammaln(_PRIOR_SIZES) - gammaln(_PRIOR_SIZES + c) + (gammaln(count + prior) - gammaln(prior)).sum()
    return float(frequencies + (count * gammaln(n + 1.0)).sum())


def likeliest_cut(tree: Array, likelihood: Likelihood) -> IntArray:
    """Of all cuts of a linkage tree the likeliest."""
    n = len(likelihood.places)
    label = np.arange(n, dtype=np.int64)
    best, best_score = label.copy(), likelihood(label)
    for k, (a, b, height, _) in enumerate(tree):
        label[(label == int(a)) | (label == int(b))] = n + k  # as `linkage` numbers what it joins
        if k + 1 < len(tree) and tree[k + 1, 2] <= height * (1.0 + 1e-12):
            continue  # joined at the same height
        score = likelihood(label)
        if score > best_score:
            best, best_score = label.copy(), score
    return np.unique(best, return_inverse=True)[1].astype(np.int64)


def improve(label: IntArray, likelihood: Likelihood) -> IntArray:
    """Move single flowers, join neighbours and split clusters as long as that makes the partition likelier."""
    label, score = label.copy(), likelihood(label)
    neighbours = _neighbours(likelihood.places)
    for _ in range(_MAX_SWEEPS):
        before = score
        for f in range(len(label)):
            score = _try_each(label, score, likelihood, _moves(label, f, neighbours[f]))
        for a in np.unique(label).tolist():
            score = _try_each(label, score, likelihood, _splits(label, a, likelihood.places))
            score = _try_each(label, score, likelihood, _joins(label, a, neighbours))
        if score <= before + 1e-9:
            break
    return label


def _try_each(label: IntArray, score: float, likelihood: Likelihood, changes: list[tuple[IntArray, int]]) -> float:
    """Carry out, in place, the change that helps most, if any: these flowers get that label."""
    best: tuple[IntArray, int] | None = None
    for flowers, new in changes:
        old = label[flowers]
        label[flowers] = new
        value = likelihood(label)
        label[flowers] = old
        if value > score + 1e-9:
            best, score = (flowers, new), value
    if best is not None:
        label[best[0]] = best[1]
    return score


def _neighbours(places: Array) -> IntArray:
    k = min(_NEIGHBOURS + 1, len(places))
    return np.asarray(cKDTree(places).query(places, k=k)[1])[:, 1:].astype(np.int64)


def _moves(label: IntArray, f: int, neighbours: IntArray) -> list[tuple[IntArray, int]]:
    """The flower to a neighbour's cluster, or into one of its own."""
    others = [int(j) for j in np.unique(label[neighbours]) if j != label[f]]
    alone = [] if (label == label[f]).sum() == 1 else [int(label.max()) + 1]
    return [(np.array([f]), j) for j in others + alone]


def _joins(label: IntArray, a: int, neighbours: IntArray) -> list[tuple[IntArray, int]]:
    """The whole cluster to one of its neighbours."""
    mine = np.flatnonzero(label == a)
    return [(mine, int(j)) for j in np.unique(label[neighbours[mine]]) if j != a] if len(mine) else []


def _splits(label: IntArray, a: int, places: Array) -> list[tuple[IntArray, int]]:
    """The cluster in two, where it is widest."""
    mine = np.flatnonzero(label == a)
    if len(mine) < 4:
        return []
    half = fcluster(linkage(places[mine], "average"), 2, "maxclust")
    return [(mine[half == 2], int(label.max()) + 1)]
