"""How likely a partition of flowers into clusters is, from where they stand and from what their motion says.

Clusters stand anywhere in a box around the flowers; members scatter about their centroid with one sigma for all
clusters; the number of members is Poisson, and some flowers are loose. To this comes the evidence of each pair within a
cluster; of the pairs among n members that pairs tie together at most n - 1 say something new, so that they weigh no
more than that together. Members of whom no pair is known add nothing to it. One flower that moved apart from k others
says so beside each of them, but it is one flower: those pairs weigh no more than they do where all pairs of k + 1
flowers are known.

Neither clusters nor members come in an order: the density of c clusters in a volume V is c! / V^c, and that of n
members n! times their number's probability (a Neyman-Scott process; Daley and Vere-Jones, "An introduction to the
theory of point processes", 2003, section 6.3). It matters where clusters are many.

Neither the sides of the box nor sigma are known, and the likelihood is the mean over what they may be: where flowers
are few their own extent and spacing say little, and a likelihood at the best value would find clusters in any few.
"""

from __future__ import annotations

from collections.abc import Iterable
from functools import lru_cache
from math import exp, expm1, lgamma, log, pi
from typing import NamedTuple

import numpy as np
from scipy.sparse import csr_matrix
from scipy.sparse.csgraph import connected_components
from scipy.special import log_ndtr

from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

_SIDE = 0.5  # sigma of the log of a side of the plant's box, about that of what one look of the camera holds
_THIN = 0.1  # of the longest side: no box is thinner
_SMALLEST = 0.01  # sigma of members is anywhere from this to all of the side of what one look holds, in logs
_PRIOR_SIZES = 30.0  # clusters: fewer say nothing certain of what sizes there are
_LOOSE = 0.25  # of the clusters, before the data
_USUAL_SIZE = 4.5  # members, before the data
_SMALL = 32  # members of a cluster that is faster looked through as a table than as a graph


class Sums(NamedTuple):
    """What the likelihood must know of all clusters of a partition: a change of two of them changes little of it."""

    square: float  # m^2, of members from their centroid
    motion: float  # evidence of pairs within clusters
    sizes: dict[int, int]  # clusters by their number of members


class Likelihood:
    """Log-likelihood of partitions of flowers at ``places`` (l, 3); members of a cluster are sorted indices."""

    def __init__(self, places: Array, volume: float, evidence: csr_matrix | None) -> None:
        """``volume`` m^3 that one look of the camera holds, ``evidence`` (l, l) of motion."""
        n = len(places)
        self.places = places
        sides = np.ptp(places, axis=0)
        view_side = volume ** (1.0 / 3.0) if volume > 0.0 else max(float(sides.max()), 1.0)
        self.log_view_side = log(view_side)
        self.log_sides = np.log(np.maximum(np.maximum(sides, _THIN * sides.max()), _SMALLEST * view_side))
        self.known: BoolArray = np.zeros((n, n), dtype=bool)
        self.evidence: Array = np.zeros((n, n))
        if evidence is not None:
            pairs = evidence.tocoo()
            self.known[pairs.row, pairs.col] = pairs.row != pairs.col
            self.evidence[pairs.row, pairs.col] = np.where(pairs.row != pairs.col, pairs.data, 0.0)
        self._anywhere_of: dict[int, float] = {}
        self._known_of: dict[bytes, tuple[float, float]] = {}  # of clusters: most are the same in many partitions

    def __call__(self, label: IntArray) -> float:
        """Of the clusters that ``label`` (l,) names with any integers."""
        return self.of(self.sums(members_by_label(label).values()))

    def sums(self, clusters: Iterable[IntArray]) -> Sums:
        """Of all clusters of a partition, each by its members."""
        return self.changed(Sums(0.0, 0.0, {}), (), clusters)

    def changed(self, sums: Sums, gone: Iterable[IntArray], come: Iterable[IntArray]) -> Sums:
        """The sums when some clusters are replaced by others."""
        square, motion, sizes = sums.square, sums.motion, dict(sums.sizes)
        for sign, clusters in ((-1, gone), (1, come)):
            for members in clusters:
                own_square, own_motion = self._cluster(members)
                square += sign * own_square
                motion += sign * own_motion
                sizes[len(members)] = sizes.get(len(members), 0) + sign
        return Sums(square, motion, sizes)

    def of(self, sums: Sums) -> float:
        """Of a partition with these sums."""
        c = sum(sums.sizes.values())
        return self._scatter(sums) + lgamma(c + 1.0) + self._anywhere(c) + _log_sizes(sums.sizes) + sums.motion

    def _scatter(self, sums: Sums) -> float:
        """Log-density of members about their centroids, the log of sigma being uniform."""
        half_dof = 1.5 * (len(self.places) - sum(sums.sizes.values()))
        if half_dof == 0.0:
            return 0.0
        # The integral goes over all sigmas; one more square as large as the least of them keeps it finite.
        square = sums.square + 3.0 * (_SMALLEST * exp(self.log_view_side)) ** 2
        prior = -log(-2.0 * log(_SMALLEST))
        centroids = 1.5 * sum(count * log(size) for size, count in sums.sizes.items())
        return lgamma(half_dof) - half_dof * log(pi * square) + prior - centroids

    def _anywhere(self, c: int) -> float:
        """Log-density of c clusters in a box that is as large as all flowers or larger; its sides are log-normal."""
        if c not in self._anywhere_of:
            most = (self.log_view_side - c * _SIDE**2 - self.log_sides) / _SIDE
            each = 0.5 * (c * _SIDE) ** 2 - c * self.log_view_side + log_ndtr(most)
            self._anywhere_of[c] = float(each.sum())
        return self._anywhere_of[c]

    def _cluster(self, members: IntArray) -> tuple[float, float]:
        """Square and motion of one cluster."""
        if len(members) < 2:
            return 0.0, 0.0
        key = members.tobytes()
        if key not in self._known_of:
            x = self.places[members]
            self._known_of[key] = float(((x - x.mean(axis=0)) ** 2).sum()), self._motion_within(members)
        return self._known_of[key]

    def _motion_within(self, members: IntArray) -> float:
        """Evidence of the pairs of one cluster's members (k,), sorted."""
        within = np.ix_(members, members)
        known = self.known[within]
        if not known.any():
            return 0.0
        if len(members) > _SMALL:
            of = connected_components(csr_matrix(known.astype(np.int8)), directed=False)[1]
        else:
            together = known | np.eye(len(members), dtype=bool)
            for _ in range(int(np.ceil(np.log2(len(members))))):  # along paths twice as long each time
                together = together @ together
            of = together.argmax(axis=1)  # the first of those that pairs tie together
        n_tied, n_pairs = np.bincount(of), 0.5 * np.bincount(of, known.sum(axis=1))
        evidence = self.evidence[within]
        n_apart = 1.0 + (evidence < 0.0).sum(axis=1)
        weight = np.minimum(1.0, (n_tied - 1.0) / np.maximum(n_pairs, 1.0))[of][:, None]
        of_one = np.minimum(weight, 2.0 / np.maximum(n_apart[:, None], n_apart))
        return float(0.5 * (evidence * np.where(evidence < 0.0, of_one, weight)).sum())


def members_by_label(label: IntArray) -> dict[int, IntArray]:
    """Members of each cluster, sorted, by its label."""
    name, first = np.unique(np.sort(label), return_index=True)
    members = np.split(np.argsort(label, kind="stable"), first[1:])
    return dict(zip(name.tolist(), members, strict=True))


def _log_sizes(sizes: dict[int, int]) -> float:
    """Log-density of members in no order, given how often each number of members occurs in this partition.

    Frequencies of sizes have a Dirichlet prior (as much as ``_PRIOR_SIZES`` clusters would tell) about a Poisson number
    from one upwards, but for one in four that is loose: plants have sizes of their own, which most clusters share.
    """
    c = sum(sizes.values())
    frequencies = lgamma(_PRIOR_SIZES) - lgamma(_PRIOR_SIZES + c)
    for size, count in sizes.items():
        prior = _prior_of(size)
        frequencies += lgamma(count + prior) - lgamma(prior) + count * lgamma(size + 1.0)
    return frequencies


@lru_cache(maxsize=4096)
def _prior_of(size: int) -> float:
    """How many clusters of that size the prior is worth."""
    poisson = exp(size * log(_USUAL_SIZE) - _USUAL_SIZE - lgamma(size + 1.0)) / -expm1(-_USUAL_SIZE)
    return max(_PRIOR_SIZES * ((1.0 - _LOOSE) * poisson + _LOOSE * (size == 1)), 1e-300)
