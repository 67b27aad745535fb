"""Many plants: which of them, and from where, may a look show? An index over triples of groups of flowers.

Flowers near each other are a group, by the same rule in the map and in the look, whatever the clusters are called. A
key is three sides between the groups' centroids, in decreasing order, and the three groups' sizes: it does not change
with the pose. Triples whose keys agree give poses, and the other groups of the look tell which of these are worth a
closer look. (Keys of triangles within a cluster are not selective enough for thousands of plants; these are.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations, permutations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from cluster_slam.geometry import Array
from cluster_slam.localisation.landmarks import Landmarks
from cluster_slam.localisation.triples import poses_from_triples
from cluster_slam.records import IntArray

_N_NEIGHBOURS = 8  # of a group: triples are made among them
_SIGMAS = 2.6  # keys and places may differ by so many standard deviations
_UNSEEN_SHARE = 0.25  # how far a centroid may be off as flowers went unseen, over the group's size
_MOST_KEYS, _BATCH = 160, 16  # triples of a look that are tried, and how many at once
_MOST_POSES = 40_000  # of one batch that are scored
_APART = 1.0e3  # m: plants are laid so far from each other in a fourth direction
_WIDTHS = (1.0, 2.0)  # tolerances, one after the other
_SURE_SCORE = 5.2  # groups that lie on groups of the map: worth a closer look at once
_LINKS = (1.0, 0.65)  # of the length that links most flowers of a cluster: near clusters are one group by the first


@dataclass(frozen=True, slots=True, eq=False)
class Groups:
    """Groups of two flowers or more that hang together."""

    plant: IntArray  # (g,)
    centroids: Array  # (g, 3)
    sizes: Array  # (g,) root mean square distance of the flowers from the centroid, m

    def __len__(self) -> int:
        return len(self.plant)


@dataclass(frozen=True, slots=True, eq=False)
class Guess:
    """A plant and a rough pose in it."""

    plant: int
    T_map_camera: Array  # (4, 4)
    score: float  # groups of the look that lie on groups of the plant, each by how well


class Atlas:
    """The index, of groups by two lengths. Building it takes seconds for thousands of plants, asking it far less."""

    def __init__(self, plants: Sequence[Landmarks], sigma_m: float) -> None:
        """``sigma_m``: how far a group's centroid may be off an axis, one sigma: sway, drift, and errors of points."""
        places = np.concatenate([p.positions for p in plants])
        of = np.repeat(np.arange(len(plants)), [len(p) for p in plants])
        link_m = _link(plants)
        self.levels = [_Level(places, of, share * link_m, sigma_m) for share in _LINKS]

    def guesses(self, points: Array, n_most: int = 12) -> list[Guess]:
        """Rough poses that explain most of the points (n, 3), best first; distinct, at most ``n_most``."""
        found: list[Guess] = []
        for level in self.levels:
            more, is_sure = level.guesses(points, n_most)
            if is_sure:
                return more
            found = _best([*found, *more], n_most)
        return found


class _Level:
    """Groups by one length, and the index of their triples."""

    def __init__(self, places: Array, of: IntArray, link_m: float, sigma_m: float) -> None:
        self.link_m, self.sigma_m = link_m, sigma_m
        self.groups = group(places, of, link_m)
        self.tree = cKDTree(_lifted(self.groups.centroids, self.groups.plant))
        self.triples, sides = self._triples()
        self.scale = _SIGMAS * sigma_m * np.repeat([np.sqrt(2.0), 1.0], 3)
        self.keys = cKDTree(
            np.hstack([sides, self.groups.sizes[self.triples]]) / self.scale, balanced_tree=False, compact_nodes=False
        )

    def _triples(self) -> tuple[IntArray, Array]:
        """Triples of neighbouring groups (t, 3), the corner opposite the longest side first, and their sides (t, 3)."""
        k = min(_N_NEIGHBOURS + 1, len(self.groups))
        apart, near = self.tree.query(_lifted(self.groups.centroids, self.groups.plant), k=k)
        near = np.where(np.asarray(apart).reshape(-1, k) < 0.5 * _APART, np.asarray(near).reshape(-1, k), -1)
        first, second = np.array(list(combinations(range(1, k), 2)), dtype=np.int64).reshape(-1, 2).T
        all_of = np.stack(
            [np.broadcast_to(near[:, :1], near[:, first].shape), near[:, first], near[:, second]], axis=-1
        )
        each = all_of.reshape(-1, 3)
        each = np.sort(each[(each >= 0).all(1)], axis=1)
        n = len(self.groups) + 1
        each = each[np.unique((each[:, 0] * n + each[:, 1]) * n + each[:, 2], return_index=True)[1]]
        sides = _sides(self.groups.centroids[each])
        order = np.argsort(-sides, axis=1, kind="stable")
        return np.take_along_axis(each, order, 1), np.take_along_axis(sides, order, 1)

    def guesses(self, points: Array, n_most: int) -> tuple[list[Guess], bool]:
        """Rough poses, best first, and whether the first explains so much that others need not be looked for."""
        seen = group(points, np.zeros(len(points), np.int64), self.link_m)
        if len(seen) < 3 or len(self.triples) == 0:
            return [], False
        found: list[Guess] = []
        corners, sides = _query_triples(seen)
        for width in _WIDTHS:
            for begin in range(0, len(corners), _BATCH):
                batch = slice(begin, begin + _BATCH)
                found = _best([*found, *self._look_up(seen, corners[batch], sides[batch], width)], n_most)
                if found and found[0].score >= _SURE_SCORE and _leads(found):
                    return found, True
        return found, False

    def _look_up(self, seen: Groups, corners: IntArray, sides: Array, width: float) -> list[Guess]:
        """The best poses that a few triples (b, 3) of the look give."""
        keys = np.hstack([sides, seen.sizes[corners]]) / self.scale
        hits = np.asarray(self.keys.query_ball_point(keys, width, p=np.inf), dtype=object).tolist()
        out: list[Guess] = []
        left = _MOST_POSES
        for k in np.argsort([len(h) for h in hits], kind="stable").tolist():
            rows = np.asarray(hits[k], dtype=np.int64)
            if not 0 < len(rows) <= left:
                continue
            left -= len(rows)
            target = self.triples[rows]
            T = poses_from_triples(seen.centroids[corners[k]], self.groups.centroids[target])
            plant = self.groups.plant[target[:, 0]]
            score = self._score(seen, corners[k], T, plant, width)
            for i in np.argsort(-score, kind="stable")[:6].tolist():
                out.append(Guess(int(plant[i]), T[i], float(score[i])))
        return out

    def _score(self, seen: Groups, corner: IntArray, T: Array, plant: IntArray, width: float) -> Array:
        """How many groups of the look, as a sum (h,) of how well, lie on groups of the map under poses T (h, 4, 4)."""
        triangle = seen.centroids[corner]
        edge = triangle[1:] - triangle[0]
        height = float(np.linalg.norm(np.cross(edge[0], edge[1]))) / float(_sides(triangle[None]).max())
        away = ((seen.centroids - triangle.mean(0)) ** 2).sum(1)
        loose = self.sigma_m**2 + (_UNSEEN_SHARE * (width - 1.0) * seen.sizes) ** 2
        var = loose + self.sigma_m**2 * (1.0 / 3.0 + away / (1.5 * max(height, 1e-3) ** 2))
        reach = _SIGMAS * np.sqrt(3.0 * np.minimum(var, (6.0 * self.sigma_m) ** 2))
        there = seen.centroids @ np.swapaxes(T[:, :3, :3], 1, 2) + T[:, None, :3, 3]
        flat = _lifted(there.reshape(-1, 3), np.repeat(plant, len(seen)))
        apart, near = self.tree.query(flat, distance_upper_bound=float(reach.max()))
        sizes = np.append(self.groups.sizes, np.inf)[near].reshape(-1, len(seen))
        alike = np.abs(sizes - seen.sizes) < width * self.scale[3]
        share = np.asarray(apart).reshape(-1, len(seen)) / reach
        return np.asarray(np.where(alike & (share < 1.0), 1.0 - 0.5 * np.minimum(share, 1.0) ** 2, 0.0).sum(1))


def group(places: Array, of: IntArray, link_m: float) -> Groups:
    """Flowers (n, 3) of plants (n,) by single linkage: nearer than ``link_m`` to one of a group is of the group."""
    n = len(places)
    pairs = cKDTree(_lifted(places, of)).query_pairs(link_m, output_type="ndarray")
    graph = coo_array((np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n))
    label = connected_components(graph, directed=False)[1]
    count = np.bincount(label).astype(np.float64)
    mean = np.stack([np.bincount(label, x) for x in places.T], axis=1) / count[:, None]
    square = np.bincount(label, ((places - mean[label]) ** 2).sum(1)) / count
    plant = np.zeros(len(count), np.int64)
    plant[label] = of
    some = count > 1
    return Groups(plant[some], mean[some], np.sqrt(square[some]))


def _lifted(places: Array, plant: IntArray) -> Array:
    """Places (n, 4) in which plants lie far from each other."""
    return np.column_stack([places, _APART * plant])


def _link(plants: Sequence[Landmarks], n_most: int = 300) -> float:
    """The length (m) that links most flowers of a cluster, and hardly any of two: of a sample of the plants."""
    within, between = [], []
    for p in plants[:: max(1, len(plants) // n_most)]:
        if len(p) < 2:
            continue
        k = min(3, len(p))
        apart, near = (np.asarray(x) for x in cKDTree(p.positions).query(p.positions, k=k))
        same = p.cluster[near[:, 1:]] == p.cluster[:, None]
        within += apart[:, 1:][same].tolist()
        between += apart[:, 1:][~same].tolist()
    if not within:
        return float(np.median(between)) if between else 0.05
    return float(1.3 * np.quantile(within, 0.9))


def _sides(corners: Array) -> Array:
    """Sides (t, 3) of triangles (t, 3, 3), each opposite its corner."""
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    return np.stack([np.linalg.norm(b - c, axis=1), np.linalg.norm(c - a, axis=1), np.linalg.norm(a - b, axis=1)], 1)


def _query_triples(seen: Groups) -> tuple[IntArray, Array]:
    """Triples (q, 3) of the look's groups with their sides, small ones first, in every order that errors leave open."""
    each = np.array(list(combinations(range(len(seen)), 3)), dtype=np.int64)
    sides = _sides(seen.centroids[each])
    each = each[np.argsort(sides.sum(1), kind="stable")[:_MOST_KEYS]]
    orders = np.array(list(permutations(range(3))))
    several = each[:, orders].reshape(-1, 3)
    sides = _sides(seen.centroids[several])
    open_ = (np.diff(sides, axis=1) < 0.02 * sides.mean(1, keepdims=True)).all(1)
    return several[open_], sides[open_]


def _best(found: list[Guess], n_most: int) -> list[Guess]:
    """Without those that a better one in the same plant stands for."""
    kept: list[Guess] = []
    for g in sorted(found, key=lambda g: -g.score):
        if not any(g.plant == k.plant and _same(g.T_map_camera, k.T_map_camera) for k in kept):
            kept.append(g)
        if len(kept) == n_most:
            break
    return kept


def _same(a: Array, b: Array) -> bool:
    turned = float(np.trace(a[:3, :3].T @ b[:3, :3]))
    return turned > 1.0 + 2.0 * np.cos(0.1) and float(np.linalg.norm(a[:3, 3] - b[:3, 3])) < 0.1


def _leads(found: list[Guess]) -> bool:
    return len(found) < 2 or found[0].score > found[1].score + 1.0
