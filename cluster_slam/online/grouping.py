"""Which flowers are one cluster, found again and again while the map grows, with what is known of common motion."""

from __future__ import annotations

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.sparse import csr_matrix
from scipy.spatial.distance import squareform
from scipy.special import gammaln

from cluster_slam.config import GroupingConfig
from cluster_slam.geometry import Array
from cluster_slam.grouping import group_flowers
from cluster_slam.records import IntArray

_FORGET = 1.0 / 3.0  # of the local mean of a flower's displacement: it then has a fifth of the noise
_FEWEST = 3  # members of what is called a cluster
_CLEARLY = 3.0  # log-likelihood by which another grouping must be better than the one that is
_TORN = 2.0  # factor on the distance of two flowers that certainly do not move together
_ROOM = 64  # seats, at first; they double
_ENOUGH_LOOKS = 10  # before it can be said that neighbours are not seen together


class CommonMotion:
    """Sums over the frames that saw two flowers, one of them off its rest: do they swing together?

    All matrices are (n, n) over seats.
    """

    def __init__(self) -> None:
        self.sums = np.zeros((5, _ROOM, _ROOM))  # |u_f - u_g|^2, |u_f|^2 + |u_g|^2, noise, noise^2, count
        self.mean = np.zeros((_ROOM, 3))  # local mean of displacements

    def grow(self, n: int) -> None:
        """Room for ``n`` seats."""
        old = len(self.mean)
        sums, mean = np.zeros((5, n, n)), np.zeros((n, 3))
        sums[:, :old, :old], mean[:old] = self.sums, self.mean
        self.sums, self.mean = sums, mean

    def clear(self, seats: IntArray) -> None:
        """Nothing is known of who sits there."""
        self.sums[:, seats] = 0.0
        self.sums[:, :, seats] = 0.0
        self.mean[seats] = 0.0

    def observe(self, rows: IntArray, u: Array, var: Array) -> None:
        """Displacements u (q, 3) of flowers from their own rest, with variances (q,) along an axis."""
        self.mean[rows] += _FORGET * (u - self.mean[rows])
        moving = (self.mean[rows] ** 2).sum(1) > 15.0 * var
        if not moving.any():
            return
        difference = u[:, None] - u[None]
        power = (u * u).sum(1)
        noise = var[:, None] + var[None]
        both = (moving[:, None] | moving[None]).astype(float)
        new = np.stack([(difference**2).sum(-1), power[:, None] + power[None], noise, noise**2, np.ones_like(noise)])
        self.sums[:, rows[:, None], rows] += both * new

    def factor(self, rows: IntArray) -> Array:
        """Factors (k, k) on the distances of these flowers, as in the offline grouping."""
        apart, power, noise, noise_sq, count = self.sums[:, rows[:, None], rows]
        bias = 3.0 * noise
        signal = power - bias
        known = (count >= 15) & (signal > bias)
        spread = 3.0 * np.sqrt(6.0 * noise_sq)
        surely = np.maximum(apart - bias - spread, 0.0) / np.where(known, signal, 1.0)
        return np.where(known, np.interp(surely, [0.05, 0.1, 0.4], [0.8, 1.0, 2.5]), 1.0)


class OnlineGrouping:
    """Groups flowers; remembers who was seen together and who moved together, by their seats."""

    def __init__(self, config: GroupingConfig) -> None:
        self.config = config
        self.motion = CommonMotion()
        self.counts = np.zeros((_ROOM, _ROOM))  # frames that saw both (the diagonal: that saw it)
        self.free = list(range(_ROOM))[::-1]
        self.link = 0.0  # m, flowers nearer than this to a cluster join it
        self.is_stale = False  # flowers were confirmed since the last grouping

    def sit(self) -> int:
        """A seat for one more flower."""
        if not self.free:
            old = len(self.counts)
            counts = np.zeros((2 * old, 2 * old))
            counts[:old, :old] = self.counts
            self.counts = counts
            self.motion.grow(2 * old)
            self.free = list(range(old, 2 * old))[::-1]
        return self.free.pop()

    def leave(self, seats: IntArray) -> None:
        """These flowers are no more."""
        if len(seats):
            self.counts[seats], self.counts[:, seats] = 0.0, 0.0
            self.motion.clear(seats)
            self.free += seats.tolist()

    def observe(self, rows: IntArray, u: Array, var: Array) -> None:
        """Flowers (q,) were seen in one frame, displaced by u (q, 3), variances (q,) along an axis."""
        self.motion.observe(rows, u, var)
        self.counts[rows[:, None], rows] += 1.0

    def together(self, a: int, b: int) -> tuple[float, float]:
        """Frames that saw both, and frames that saw the rarer one."""
        return float(self.counts[a, b]), float(min(self.counts[a, a], self.counts[b, b]))

    def group(self, rows: IntArray, places: Array, now: IntArray, volume: float, rng: np.random.Generator) -> IntArray:
        """Cluster 0..c-1 of each flower (l,), by their seats (l,).

        ``now`` (l,) are the clusters that they are in, which stay unless others are clearly likelier.
        """
        n = len(places)
        if self.config.method == "none" or n < 2:
            return np.arange(n)
        counts = self.counts[rows[:, None], rows]
        if self.config.method != "spacing":
            return group_flowers(places, csr_matrix(counts > 0), None, volume, self.config, rng=rng)
        now = np.unique(now, return_inverse=True)[1]
        return self._by_spacing(places, self.motion.factor(rows), counts, volume, now)

    def group_new(self, places: Array, volume: float) -> IntArray:
        """Cluster 0..c-1 of flowers (l,) that have all just been seen for the first time, together."""
        n = len(places)
        if self.config.method == "none" or n < 2:
            return np.arange(n)
        if self.link > 0.0 or n < _FEWEST:
            tree = linkage(places, "average")
            return np.unique(fcluster(tree, self.link, "distance"), return_inverse=True)[1]
        return self._by_spacing(places, np.ones((n, n)), np.ones((n, n)), volume, None)

    def _by_spacing(self, places: Array, factor: Array, counts: Array, volume: float, now: IntArray | None) -> IntArray:
        n = len(places)
        distance = np.linalg.norm(places[:, None] - places[None], axis=-1)
        apart = distance + np.diag(np.full(n, np.inf))
        spacing = float(np.median(apart.min(0)))
        distance = distance * np.where(distance < 7.0 * spacing, factor, 1.0)
        tree = linkage(squareform(0.5 * (distance + distance.T), checks=False), "average")
        volume = _whole_volume(places, volume)
        label, score = likeliest_cut(tree, places, volume, 0.7 * spacing)
        if not come_in_clusters(apart.argmin(0), counts, label):
            self.link = 0.0
            return np.arange(n)
        cut = n - 1 - int(label.max())  # merges below the cut
        low = tree[cut - 1, 2]
        self.link = float(np.sqrt(low * (tree[cut, 2] if cut < n - 1 else 2.0 * low)))
        if now is None or (factor[now[:, None] == now] > _TORN).any():
            return label
        return label if score > partition_score(now, places, volume, 0.7 * spacing) + _CLEARLY else now


def _whole_volume(places: Array, volume: float) -> float:
    """The space in which clusters may stand, m^3: what one look holds, or all that was found, if that is more."""
    sides = np.ptp(places, axis=0)
    return max(float(np.prod(np.maximum(sides, 0.1 * sides.max()))), volume, 1e-12)


def likeliest_cut(tree: Array, places: Array, volume: float, prior_sigma: float) -> tuple[IntArray, float]:
    """Of all cuts of a linkage tree, the clusters 0..c-1 of the flowers (l,) that explain their places best; its score.

    Clusters stand anywhere in ``volume`` m^3, members scatter about their centroid with one sigma (its prior as good as
    one observation of ``prior_sigma`` m), and the number of members is Poisson. One pass up the tree: a merge of two
    clusters adds a b / (a + b) times their squared distance to the sum of squares.
    """
    n = len(places)
    size, centre = np.ones(2 * n - 1), np.zeros((2 * n - 1, 3))
    centre[:n] = places
    square = logs = factorials = 0.0
    best, best_score = 0, -np.inf
    for k in range(n):
        if k:
            a, b, new = int(tree[k - 1, 0]), int(tree[k - 1, 1]), n + k - 1
            na, nb = size[a], size[b]
            size[new] = na + nb
            centre[new] = (na * centre[a] + nb * centre[b]) / (na + nb)
            square += na * nb / (na + nb) * float(((centre[a] - centre[b]) ** 2).sum())
            logs += np.log(na + nb) - np.log(na) - np.log(nb)
            factorials += float(gammaln(na + nb + 1.0) - gammaln(na + 1.0) - gammaln(nb + 1.0))
        score = _score(n, n - k, square, logs, factorials, volume, prior_sigma)
        if score > best_score:
            best, best_score = k, score
    root = np.arange(2 * n - 1)
    for k in range(best, 0, -1):
        root[tree[k - 1, :2].astype(np.int64)] = root[n + k - 1]
    return np.unique(root[:n], return_inverse=True)[1], best_score


def partition_score(label: IntArray, places: Array, volume: float, prior_sigma: float) -> float:
    """Log-likelihood of clusters 0..c-1 of the flowers (l,), on the scale of ``likeliest_cut``."""
    size = np.bincount(label).astype(float)
    centre = np.stack([np.bincount(label, places[:, a]) for a in range(3)], axis=-1) / size[:, None]
    square = float(((places - centre[label]) ** 2).sum())
    logs, factorials = float(np.log(size).sum()), float(gammaln(size + 1.0).sum())
    return _score(len(places), len(size), square, logs, factorials, volume, prior_sigma)


def _score(n: int, c: int, square: float, logs: float, factorials: float, volume: float, prior_sigma: float) -> float:
    dof = 3.0 * (n - c)
    var = (square + 3.0 * prior_sigma**2) / (dof + 3.0)
    scatter = -0.5 * dof * np.log(2.0 * np.pi * var) - 0.5 * square / var - 1.5 * logs
    return float(scatter - c * np.log(volume) + n * np.log(n / c) - n - factorials)


def come_in_clusters(nearest: IntArray, counts: Array, label: IntArray) -> bool:
    """Whether these flowers come in clusters at all: some have three members, and neighbours are seen together.

    ``nearest`` (l,) is each one's neighbour, ``counts`` (l, l) how many frames saw both.
    """
    if np.bincount(label).max() < _FEWEST:
        return False
    each = np.diag(counts)
    fewer = np.minimum(each, each[nearest])
    enough = fewer >= min(_ENOUGH_LOOKS, float(fewer.max()))
    both = counts[np.arange(len(nearest)), nearest]
    return bool(np.median(both[enough] / np.maximum(fewer[enough], 1.0)) > 0.3)
