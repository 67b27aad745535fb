"""Which flowers are one cluster: by spacing and by common motion, with no number given; by K-means; or by branch."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.cluster.vq import kmeans2
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from scipy.spatial.distance import squareform

from cluster_slam.config import GroupingConfig
from cluster_slam.errors import ConfigError
from cluster_slam.geometry import Array
from cluster_slam.grouping.comotion import Motion, motion_evidence
from cluster_slam.grouping.likelihood import Likelihood, members_by_label
from cluster_slam.grouping.partition import improve, likeliest_cut
from cluster_slam.records import IntArray

_TOGETHER = (0.8, 0.15)  # share of a flower's frames that show its nearest, too, in sessions of clusters: mean, sigma
_TOGETHER_OF_NONE = (0.45, 0.13)  # in sessions of things that stand alone
_APART, _APART_OF_NONE = 0.04, 0.22  # mean share of moments, too long to miss a flower, that show one of two alone
_MISSED = 0.05  # probability that a flower in view is missed for a whole moment
_LONGEST = 20  # frames of a moment
_SURE = 3.0  # log-likelihood, 20 to 1, that flowers move as one
_LIKELIER = 1.0  # log-likelihood: six flowers that are all loose gain as much by chance in one of twelve draws
REACH = 7.0  # spacings; flowers that far apart are of two clusters, whatever they do


def group_flowers(
    places: Array,
    presence: csr_matrix,
    motion: Motion | None,
    view_volume: float,
    config: GroupingConfig,
    *,
    rng: np.random.Generator,
) -> IntArray:
    """Cluster 0..c-1 of each flower (l,).

    Parameters
    ----------
    places : (l, 3) at rest, m.
    presence : (l, n) which frames saw each flower.
    motion : what is known of the flowers' motion, or None.
    view_volume : m^3, how much space one look of the camera holds.
    config : the method.
    rng : for K-means.
    """
    n = len(places)
    if config.method == "none" or n == 0:
        return np.arange(n)
    if config.method == "kmeans":
        if config.n_clusters is None:
            raise ConfigError("grouping.method kmeans wants grouping.n_clusters")
        return _numbered(kmeans2(places, min(config.n_clusters, n), minit="++", rng=rng)[1])
    if n == 1:
        return np.zeros(1, dtype=np.int64)
    evidence = None if motion is None else motion_evidence(places, motion, REACH * spacing_of(places))
    tree = _tree(places, evidence, "single" if config.method == "branch" else "average")
    if config.linkage_m is not None:
        return _numbered(fcluster(tree, config.linkage_m, "distance"))
    likelihood = Likelihood(places, view_volume, evidence)
    label = likeliest_cut(tree, likelihood)
    if config.method == "spacing":
        label = improve(label, likelihood)
    return _numbered(label) if come_in_clusters(label, likelihood, together_ratio(places, presence)) else np.arange(n)


def _numbered(label: NDArray[Any]) -> IntArray:
    """Labels 0..c-1 in the order of first appearance."""
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]


def spacing_of(places: Array) -> float:
    """Median distance of a flower to its nearest, m."""
    return float(np.median(np.asarray(cKDTree(places).query(places, k=2)[0])[:, 1]))


def _tree(places: Array, evidence: csr_matrix | None, method: Literal["single", "average"]) -> Array:
    """Linkage tree of stretched distances."""
    tree: Array = linkage(squareform(stretched_distances(places, evidence), checks=False), method)
    return tree


def stretched_distances(places: Array, evidence: csr_matrix | None) -> Array:
    """Distances (l, l) of flowers, which evidence against common motion stretches and evidence for it shrinks."""
    distance: Array = np.linalg.norm(places[:, None] - places[None], axis=-1)
    if evidence is not None:
        pairs = evidence.tocoo()
        distance[pairs.row, pairs.col] *= np.interp(pairs.data, [-2.0, 0.0, 2.0], [2.5, 1.0, 0.8])
    return distance


def come_in_clusters(label: IntArray, likelihood: Likelihood, together: float) -> bool:
    """Whether this session's flowers come in clusters at all; ``together``: ratio by when they are seen.

    They do where they stand nearer than flowers that are all loose would, and are seen together: things that stand in
    groups, but do not belong together, hide each other or face another way. Where they are seldom seen together they
    must move as one, the more surely the more seldom.
    """
    clustered = likelihood.sums(members_by_label(label).values())
    if clustered.motion > _SURE:
        return True
    if likelihood.of(clustered) - likelihood(np.arange(len(label))) < _LIKELIER:
        return False
    return together >= 0.0 or clustered.motion > -together


def together_ratio(places: Array, presence: csr_matrix) -> float:
    """Log-likelihood ratio that flowers come in clusters, by how much of the time neighbours are seen together.

    Frames tell it where nearly all that is in view is seen. Where a detector misses many flowers, one at a time, frames
    part neighbours that moments of several frames show together: of the two the one that speaks for clusters counts.

    Parameters
    ----------
    places : (l, 3) m.
    presence : (l, n) which frames saw each flower.
    """
    nearest = np.asarray(cKDTree(places).query(places, k=2)[1])[:, 1]
    seen = csr_matrix(presence, dtype=np.float64)
    return max(ratio_by_frames(_shared(seen, nearest)), ratio_by_moments(_shared(_in_moments(seen), nearest)))


def ratio_by_frames(together: float) -> float:
    """The same by the share of frames alone that show neighbours together."""
    (mean, sigma), (mean_of_none, sigma_of_none) = _TOGETHER, _TOGETHER_OF_NONE
    ratio = 0.5 * ((together - mean_of_none) / sigma_of_none) ** 2 - 0.5 * ((together - mean) / sigma) ** 2
    return float(ratio + np.log(sigma_of_none / sigma))


def ratio_by_moments(together: float) -> float:
    """The same by the share of moments that show neighbours together."""
    apart = 1.0 - together
    return float(apart / _APART_OF_NONE - apart / _APART + np.log(_APART_OF_NONE / _APART))


def moment_length(again: float) -> int:
    """Frames of a moment, where of the flowers in one frame a share ``again`` is seen in the next."""
    missed = np.clip(1.0 - again, 1e-3, 1.0 - 1e-3)
    return int(np.clip(np.ceil(np.log(_MISSED) / np.log(missed)), 1, _LONGEST))


def _shared(seen: csr_matrix, nearest: IntArray) -> float:
    """Share of a flower's columns that its nearest has, too; the median over flowers (l,)."""
    both = np.asarray(seen.multiply(seen[nearest]).sum(axis=1)).ravel()
    count = np.asarray(seen.sum(axis=1)).ravel()
    # Of the columns that saw the one that is seen less: that one of two is often hidden says nothing of the other.
    return float(np.median(both / np.maximum(np.minimum(count, count[nearest]), 1)))


def _in_moments(seen: csr_matrix) -> csr_matrix:
    """The same (l, n) in moments of so many frames that a flower in view is hardly missed in all of them."""
    used = seen[:, np.flatnonzero(np.asarray(seen.sum(axis=0)).ravel())].tocsc()
    n = used.shape[1]
    again = used[:, 1:].multiply(used[:, :-1]).sum() / max(used[:, :-1].sum(), 1.0)
    length = moment_length(again)
    into = csr_matrix((np.ones(n), (np.arange(n), np.arange(n) // length)))
    moments: csr_matrix = (used @ into).sign().tocsr()
    return moments
