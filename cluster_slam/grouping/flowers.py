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
    return _numbered(label) if come_in_clusters(label, likelihood, _seen_together(places, presence)) else np.arange(n)


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
    """Whether this session's flowers come in clusters at all; ``together`` is how often neighbours are seen so.

    They do where they stand nearer than flowers that are all loose would, and are seen together: things that stand in
    groups, but do not belong together, hide each other or face another way. Where they are seldom seen together they
    must move as one, the more surely the more seldom.
    """
    clustered = likelihood.sums(members_by_label(label).values())
    if clustered.motion > _SURE:
        return True
    if likelihood.of(clustered) - likelihood(np.arange(len(label))) < _LIKELIER:
        return False
    doubt = -_of_clusters(together)
    return doubt <= 0.0 or clustered.motion > doubt


def _seen_together(places: Array, presence: csr_matrix) -> float:
    """Share of a flower's frames that show its nearest, too; the median over flowers."""
    nearest = np.asarray(cKDTree(places).query(places, k=2)[1])[:, 1]
    both = np.asarray(presence.multiply(presence[nearest]).sum(axis=1)).ravel()
    count = np.asarray(presence.sum(axis=1)).ravel()
    # Of the frames that saw the one that is seen less: that one of two is often hidden says nothing of the other.
    together = both / np.maximum(np.minimum(count, count[nearest]), 1)
    return float(np.median(together))


def _of_clusters(together: float) -> float:
    """Log-likelihood ratio that flowers come in clusters, by how much of the time neighbours are seen together."""
    (mean, sigma), (mean_of_none, sigma_of_none) = _TOGETHER, _TOGETHER_OF_NONE
    ratio = 0.5 * ((together - mean_of_none) / sigma_of_none) ** 2 - 0.5 * ((together - mean) / sigma) ** 2
    return float(ratio + np.log(sigma_of_none / sigma))
