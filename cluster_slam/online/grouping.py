"""Which flowers are one cluster, found again and again while the map grows, with what is known of common motion."""

from __future__ import annotations

import numpy as np
from scipy.cluster.hierarchy import fcluster, linkage
from scipy.sparse import csr_matrix
from scipy.spatial import cKDTree

from cluster_slam.config import GroupingConfig
from cluster_slam.geometry import Array
from cluster_slam.grouping import group_flowers
from cluster_slam.grouping.flowers import REACH, ratio_by_frames, ratio_by_moments, spacing_of
from cluster_slam.online.comotion import CommonMotion
from cluster_slam.online.moments import Moments
from cluster_slam.online.regrouping import Round, group_together
from cluster_slam.records import BoolArray, IntArray

_FEWEST = 3  # members of what is called a cluster
_ROOM = 64  # seats, at first; they double
_ENOUGH_LOOKS = 10  # before it can be said that neighbours are not seen together
_MANY_NEW = 0.05  # share of new flowers from which on all is grouped from scratch, too
_CHANGES = 1500.0  # of clusters that are tried in a second


class OnlineGrouping:
    """Groups flowers; remembers who was seen together and who moved together, by their seats."""

    def __init__(self, config: GroupingConfig) -> None:
        self.config = config
        self.motion = CommonMotion(_ROOM)
        self.counts = np.zeros((_ROOM, _ROOM))  # frames that saw both (the diagonal: that saw it)
        self.moments = Moments(_ROOM)
        self.free = list(range(_ROOM))[::-1]
        self.link = 0.0  # m, flowers nearer than this to a cluster join it
        self.reach = np.inf  # m, flowers so far apart are of two clusters
        self.is_stale = False  # flowers were confirmed since the last grouping
        self.round: Round | None = None  # that goes on
        self._known: IntArray = np.zeros(0, dtype=np.int64)  # flowers of the last one

    def sit(self) -> int:
        """A seat for one more flower."""
        if not self.free:
            old = len(self.counts)
            counts = np.zeros((2 * old, 2 * old))
            counts[:old, :old] = self.counts
            self.counts = counts
            self.moments.grow(2 * old)
            self.motion.grow(2 * old)
            self.free = list(range(old, 2 * old))[::-1]
        return self.free.pop()

    def leave(self, seats: IntArray) -> None:
        """These flowers are no more."""
        if len(seats):
            self.counts[seats], self.counts[:, seats] = 0.0, 0.0
            self.moments.clear(seats)
            self.motion.clear(seats)
            self.free += seats.tolist()

    def observe(self, stamp: float, seats: IntArray, w: Array, var: Array, places: Array) -> None:
        """Flowers (q,), at rest at ``places`` (q, 3), were seen in one frame at w (q, 3), variances (q,) of an axis."""
        self.motion.observe(stamp, seats, w, var, places, self.reach)
        self.counts[seats[:, None], seats] += 1.0
        self.moments.observe(seats)

    def together(self, a: int, b: int) -> tuple[float, float]:
        """Frames that saw both, and frames that saw the rarer one."""
        return float(self.counts[a, b]), float(min(self.counts[a, a], self.counts[b, b]))

    def at_once(self, seats: IntArray, places: Array, volume: float, rng: np.random.Generator) -> IntArray | None:
        """Cluster 0..c-1 of each flower (l,), where the method is not one that looks at motion; else None."""
        self.is_stale = False
        n, config = len(places), self.config
        if n < 2 or config.method == "none":
            return np.arange(n)
        if config.method == "spacing" and config.linkage_m is None:
            return None
        seen = csr_matrix(self.counts[seats[:, None], seats] > 0)
        return group_flowers(places, seen, None, volume, config, rng=rng)

    def begin(
        self, ids: IntArray, seats: IntArray, places: Array, now: IntArray, volume: float, asked: BoolArray
    ) -> None:
        """A round begins: flowers ``ids`` (l,) are in clusters ``now`` (l,); those ``asked`` (l,) have been seen."""
        self.reach = REACH * spacing_of(places)
        evidence = self.motion.evidence(seats, places, self.reach)
        is_other = float((~np.isin(ids, self._known)).mean()) > _MANY_NEW
        self.round = Round(ids, places, now, volume, evidence, asked, is_other)
        self._known = ids

    def carry_on(self, seat_of: dict[int, int], dt: float) -> tuple[IntArray, IntArray] | None:
        """A few changes more, as ``dt`` s from frame to frame leave time for.

        Flowers and clusters 0..c-1 (l,) of those that live (``seat_of``), when all is done.
        """
        going = self.round
        if going is None or not going.work(max(1, round(_CHANGES * dt))):
            return None
        self.round = None
        alive = np.array([i in seat_of for i in going.ids.tolist()], dtype=bool)
        label = going.label(self._together_ratio(going, alive, seat_of))
        self.link = going.link(label)
        return going.ids[alive], label[alive]

    def group_new(self, places: Array, volume: float) -> IntArray:
        """Cluster 0..c-1 of flowers (l,) that have all just been seen for the first time, together."""
        n = len(places)
        if self.config.method == "none" or n < 2:
            return np.arange(n)
        if self.link > 0.0 or n < _FEWEST:
            tree = linkage(places, "average")
            return np.unique(fcluster(tree, self.link, "distance"), return_inverse=True)[1]
        label, self.link = group_together(places, volume)
        return label

    def _together_ratio(self, going: Round, alive: BoolArray, seat_of: dict[int, int]) -> float:
        """Log-likelihood ratio that flowers come in clusters, by how often neighbours are seen together."""
        places = going.places[alive]
        if len(places) < 2:
            return 0.0
        seats = np.array([seat_of[i] for i in going.ids[alive].tolist()])
        nearest = np.asarray(cKDTree(places).query(places, k=2)[1])[:, 1]
        by_frames = ratio_by_frames(_shared(self.counts, seats, seats[nearest]))
        return max(by_frames, ratio_by_moments(_shared(self.moments.counts, seats, seats[nearest])))


def _shared(counts: Array, seats: IntArray, nearest: IntArray) -> float:
    """Median share of the frames (or moments) with the rarer of two neighbours that show both."""
    fewer = np.minimum(counts[seats, seats], counts[nearest, nearest])
    enough = fewer >= min(_ENOUGH_LOOKS, float(fewer.max()))
    return float(np.median(counts[seats, nearest][enough] / np.maximum(fewer[enough], 1.0)))
