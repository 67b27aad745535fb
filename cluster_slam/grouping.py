"""Which flowers are one cluster: by spacing and by common motion, with no number given; by K-means; or by branch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.cluster.vq import kmeans2
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree
from scipy.spatial.distance import squareform

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
    places: Array, presence: csr_matrix, motion: Motion | None, config: GroupingConfig, *, rng: np.random.Generator
) -> IntArray:
    """Cluster 0..c-1 of each flower (l,).

    Parameters
    ----------
    places : (l, 3) at rest, m.
    presence : (l, n) which frames saw each flower.
    motion : what is known of the flowers' motion, or None.
    config : the method.
    rng : for K-means.
    """
    n = len(places)
    if config.method == "none" or n == 0:
        return np.arange(n)
    if config.method == "kmeans":
        if config.n_clusters is None:
            raise ConfigError("grouping.method kmeans wants grouping.n_clusters")
        _, label = kmeans2(places, min(config.n_clusters, n), minit="++", rng=rng)
        return _numbered(label)
    if n == 1:
        return np.zeros(1, dtype=np.int64)
    distance = np.linalg.norm(places[:, None] - places[None], axis=-1)
    if motion is not None:
        distance = distance * _motion_factor(distance, places, motion, _cut(places, config))
    tree = linkage(squareform(distance, checks=False), "single" if config.method == "branch" else "average")
    label = _numbered(fcluster(tree, _cut(places, config), "distance"))
    if config.linkage_m is None and not _come_in_clusters(places, presence, label):
        return np.arange(n)
    return label


def _numbered(label: Array) -> IntArray:
    """Labels 0..c-1 in the order of first appearance."""
    _, first, inverse = np.unique(label, return_index=True, return_inverse=True)
    rank = np.empty(len(first), dtype=np.int64)
    rank[np.argsort(first)] = np.arange(len(first))
    return rank[inverse]


def _cut(places: Array, config: GroupingConfig) -> float:
    """Where the linkage is cut, m: a multiple of how far flowers stand from their nearest."""
    if config.linkage_m is not None:
        return config.linkage_m
    nearest = cKDTree(places).query(places, k=2)[0][:, 1]
    return config.linkage_per_spacing * float(np.median(nearest))


def _come_in_clusters(places: Array, presence: csr_matrix, label: IntArray) -> bool:
    """Whether this session's flowers come in clusters at all: some have three members, which are seen together."""
    if np.bincount(label).max() < _FEWEST:
        return False
    nearest = cKDTree(places).query(places, k=2)[1][:, 1]
    both = np.asarray(presence.multiply(presence[nearest]).sum(axis=1)).ravel()
    count = np.asarray(presence.sum(axis=1)).ravel()
    together = both / np.maximum(count + count[nearest] - both, 1)
    return bool(np.median(together) > 0.3)


def _motion_factor(distance: Array, places: Array, motion: Motion, cut: float) -> Array:
    """Factors (l, l) on distances: below one for flowers that move together, above one for those that do not."""
    factor = np.ones_like(distance)
    u = motion.u
    local = _local_mean(u)
    power = (local * local).sum(-1)
    noise = 3.0 * motion.var / 5.0
    moving = power > np.maximum(25.0 * noise, (0.25 * np.median(np.sqrt(motion.var[np.isfinite(motion.var)]))) ** 2)
    for f, g in zip(*np.nonzero(np.triu(distance < 2.5 * cut, 1)), strict=True):
        use = (moving[:, f] | moving[:, g]) & np.isfinite(u[:, f, 0]) & np.isfinite(u[:, g, 0])
        if use.sum() < 15:
            continue
        bias = 3.0 * (motion.var[use, f] + motion.var[use, g]).sum()
        apart = ((u[use, f] - u[use, g]) ** 2).sum() - bias
        signal = (u[use, f] ** 2).sum() + (u[use, g] ** 2).sum() - bias
        if signal > bias:
            ratio = max(apart, 0.0) / signal
            factor[f, g] = factor[g, f] = float(np.interp(ratio, [0.2, 0.6, 0.8], [0.4, 1.0, 2.5]))
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
