"""Which flowers are one cluster: by spacing and by common motion, with no number given; by K-means; or by branch."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.cluster.vq import kmeans2
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from scipy.spatial.distance import squareform
from scipy.special import gammaln

from cluster_slam.config import GroupingConfig
from cluster_slam.errors import ConfigError
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

_FEWEST = 3  # members of what is called a cluster where nothing else says that flowers come in clusters


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """How flowers moved: displacement from rest ``u`` (n, l, 3), NaN where unseen, and its noise variance (n, l)."""

    u: Array
    var: Array


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
    distance = np.linalg.norm(places[:, None] - places[None], axis=-1)
    if motion is not None:
        distance = distance * _motion_factor(distance, motion, 7.0 * _spacing(places))
    tree = linkage(squareform(distance, checks=False), "single" if config.method == "branch" else "average")
    if config.linkage_m is not None:
        return _numbered(fcluster(tree, config.linkage_m, "distance"))
    label = _likeliest_cut(tree, places, view_volume)
    return label if _come_in_clusters(places, presence, label) else np.arange(n)


def _numbered(label: NDArray[Any]) -> IntArray:
    """Labels 0..c-1 in the order of first appearance."""
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]


def _spacing(places: Array) -> float:
    """Median distance of a flower to its nearest, m."""
    return float(np.median(np.asarray(cKDTree(places).query(places, k=2)[0])[:, 1]))


def _likeliest_cut(tree: Array, places: Array, view_volume: float) -> IntArray:
    """Of all cuts of a linkage tree, the clusters that explain the places best.

    Clusters stand anywhere in the space that was looked at; members scatter about their centroid with one sigma for
    all clusters, the likeliest one; the number of members is Poisson. All heights of the tree are tried.
    """
    sides = np.ptp(places, axis=0)
    volume = max(float(np.prod(np.maximum(sides, 0.1 * sides.max()))), view_volume)
    prior_sigma = 0.7 * _spacing(places)
    best: IntArray = np.arange(len(places), dtype=np.int64)
    best_score = -np.inf
    for height in np.concatenate([[0.0], np.unique(tree[:, 2]) * (1.0 + 1e-12)]):
        label = fcluster(tree, height, "distance").astype(np.int64) - 1
        score = _log_likelihood(label, places, volume, prior_sigma)
        if score > best_score:
            best, best_score = label, score
    return _numbered(best)


def _log_likelihood(
    label: IntArray, places: Array, volume: float, prior_sigma: float, prior_weight: float = 1.0
) -> float:
    """Log-likelihood of a partition, sigma at its most probable value (a weak prior keeps it from zero)."""
    size = np.bincount(label)
    centre = np.stack([np.bincount(label, places[:, a]) for a in range(3)], axis=-1) / size[:, None]
    n, c = len(places), len(size)
    square = float(((places - centre[label]) ** 2).sum())
    dof = 3.0 * (n - c)
    var = (square + 3.0 * prior_weight * prior_sigma**2) / (dof + 3.0 * prior_weight)
    scatter = -0.5 * dof * np.log(2.0 * np.pi * var) - 0.5 * square / var - 1.5 * np.log(size).sum()
    mean = n / c
    members = (size * np.log(mean) - mean - gammaln(size + 1.0)).sum()
    return float(scatter - c * np.log(volume) + members)


def _come_in_clusters(places: Array, presence: csr_matrix, label: IntArray) -> bool:
    """Whether this session's flowers come in clusters at all: some have three members, which are seen together."""
    if np.bincount(label).max() < _FEWEST:
        return False
    nearest = np.asarray(cKDTree(places).query(places, k=2)[1])[:, 1]
    both = np.asarray(presence.multiply(presence[nearest]).sum(axis=1)).ravel()
    count = np.asarray(presence.sum(axis=1)).ravel()
    together = both / np.maximum(count + count[nearest] - both, 1)
    return bool(np.median(together) > 0.3)


def _motion_factor(distance: Array, motion: Motion, reach: float) -> Array:
    """Factors (l, l) on distances from how flowers f, g moved in the frames that saw both, one of them off its rest.

    The ratio sum |u_f - u_g|^2 / sum (|u_f|^2 + |u_g|^2), noise taken out of both, is zero within a cluster and one for
    flowers that move apart from each other; neighbouring clusters shaken by one touch lie between. Flowers that do not
    move together are no cluster; that they do says little, so only the first is believed.
    """
    factor = np.ones_like(distance)
    u = motion.u
    local = _local_mean(u)
    moving = (local * local).sum(-1) > 25.0 * 3.0 * motion.var / 5.0
    for f, g in zip(*np.nonzero(np.triu(distance < reach, 1)), strict=True):
        use = (moving[:, f] | moving[:, g]) & np.isfinite(u[:, f, 0]) & np.isfinite(u[:, g, 0])
        if use.sum() < 15:
            continue
        noise = motion.var[use, f] + motion.var[use, g]
        bias = 3.0 * noise.sum()
        apart = ((u[use, f] - u[use, g]) ** 2).sum() - bias
        signal = (u[use, f] ** 2).sum() + (u[use, g] ** 2).sum() - bias
        if signal > bias:
            surely = max(apart - 3.0 * np.sqrt(6.0 * (noise**2).sum()), 0.0) / signal
            factor[f, g] = factor[g, f] = float(np.interp(surely, [0.05, 0.1, 0.4], [0.8, 1.0, 2.5]))
    return factor


def _local_mean(u: Array, half: int = 2) -> Array:
    """Means over 2 half + 1 frames of those that saw the flower; NaN where fewer than half did."""
    seen = np.isfinite(u[..., :1])
    filled = np.where(seen, u, 0.0)
    total, count = np.zeros_like(filled), np.zeros(seen.shape)
    n = len(u)
    for shift in range(-half, half + 1):
        a, b = slice(max(0, shift), min(n, n + shift)), slice(max(0, -shift), min(n, n - shift))
        total[a] += filled[b]
        count[a] += seen[b]
    return np.where(count > half, total / np.maximum(count, 1), np.nan)
