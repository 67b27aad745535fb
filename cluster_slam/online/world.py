"""What the live tracker knows at one time: flowers, clusters, the map, how it looks at them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.depth_noise import DepthSums, stretched
from cluster_slam.config import OnlineConfig
from cluster_slam.geometry import Array, inverse, rotate_cov, transform
from cluster_slam.graph.incremental import IncrementalMap
from cluster_slam.online.births import Births
from cluster_slam.online.cluster import ClusterTrack, unseen_var
from cluster_slam.online.flowers import FlowerTable
from cluster_slam.online.grouping import OnlineGrouping
from cluster_slam.online.records import Revision, RevisionKind, Subject
from cluster_slam.records import BoolArray, IntArray
from tracking.motion import MotionConfig

_UNCLAIMED_GAIN = 0.02  # of a frame, in the mean number of points that nobody claims


@dataclass(frozen=True, slots=True, eq=False)
class Snapshot:
    """All clusters as predicted for one frame: ``anchor`` at rest, displacement ``d`` with ``P``, ``scale``."""

    anchor: Array  # (c, 3)
    d: Array  # (c, 3)
    P: Array  # (c, 3, 3)
    scale: Array  # (c,)
    unseen_s: Array  # (c,)


class World:
    """Flowers in clusters; rows of the table refer to clusters by their place in the list (``slot``)."""

    def __init__(self, config: OnlineConfig, hand_eye_information: Array | None, seed: int) -> None:
        self.config = config
        self.motion = MotionConfig()
        self.flowers = FlowerTable()
        self.clusters: list[ClusterTrack] = []
        self.map = IncrementalMap(hand_eye_information, config.undo_s)
        self.grouping = OnlineGrouping(config.grouping)
        self.seed = seed
        self.merged: list[tuple[int, int]] = []  # flowers: from, to
        self.merged_clusters: list[tuple[int, int]] = []
        self.revisions: list[Revision] = []  # of the present frame
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)  # of x / z, y / z and z of all points so far
        self.most_points = 2  # in one frame
        self.spacing = np.inf  # m, how close flowers stand
        self.births = Births()
        self.met: dict[int, set[int]] = {}  # landmarks that were seen together with a flower without an id as yet
        self.depth_sums = DepthSums()  # how the stated noise grows with depth
        self.usual_dt = 1.0 / 30.0
        self.x = np.zeros(6)  # hand-eye tangent
        self.unclaimed = 1.0  # points a frame that no known flower claims, averaged
        self._next_cluster = 0

    def new_cluster(self, stamp: float) -> int:
        """A cluster of which nothing is known; returns its slot."""
        self.clusters.append(ClusterTrack(self._next_cluster, stamp, self.motion))
        self._next_cluster += 1
        return len(self.clusters) - 1

    def names(self) -> IntArray:
        """Ids (c,) of the clusters."""
        return np.array([k.id for k in self.clusters], dtype=np.int64)

    def anchors(self) -> Array:
        """Centroids at rest (c, 3)."""
        zero = np.zeros(3)
        return np.array([zero if k.anchor is None else k.anchor for k in self.clusters]).reshape(-1, 3)

    def covs_at_rest(self, stamp: float) -> Array:
        """Covariances (c, 6, 6) of position and velocity of clusters that rest, each the wider the longer unseen."""
        m, n = self.motion, len(self.clusters)
        last = np.array([k.last for k in self.clusters])
        var = np.zeros((n, 6))
        var[:, :3] = (m.tremble_m**2 + unseen_var(np.maximum(stamp - last, 0.0)))[:, None]
        var[:, 3:] = (m.tremble_m / m.tremble_s) ** 2
        covs = var[:, :, None] * np.eye(6)
        if n:
            covs[:, :3, :3] += np.array([k.anchor_cov for k in self.clusters])
        return covs

    def snapshot(self, stamp: float) -> Snapshot:
        """The clusters as predicted; moving ones must have been brought to this time."""
        n = len(self.clusters)
        d, P, scale, unseen = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.ones(n), np.zeros(n)
        for j, cluster in enumerate(self.clusters):
            d[j], P[j] = cluster.displacement(stamp)
            scale[j], unseen[j] = cluster.scale, stamp - cluster.last
        return Snapshot(self.anchors(), d, P, scale, np.maximum(unseen, 0.0))

    def expected(self, rows: IntArray, at: Snapshot) -> Array:
        """Where flowers (k,) should be (k, 3), by the states of their clusters."""
        slot = self.flowers.slot[rows]
        offset = self.flowers.place[rows] - at.anchor[slot]
        return np.asarray(at.anchor[slot] + at.d[slot] + at.scale[slot][:, None] * offset)

    def widen_view(self, c: Array) -> None:
        """Points (q, 3) of the camera frame have been seen: this far it sees at least."""
        if len(c):
            self.most_points = max(self.most_points, len(c))
            rays = np.column_stack([c[:, 0] / c[:, 2], c[:, 1] / c[:, 2], c[:, 2]])
            self.low, self.high = np.minimum(self.low, rays.min(0)), np.maximum(self.high, rays.max(0))

    def noise_at(self, T: Array, expected: Array, c: Array, S: Array) -> Array:
        """Covariances S (q, 3, 3), world, of points c (q, 3), camera frame, as stated at the depths of ``expected``.

        Where a flower is expected (q, 3), world, is where its noise is right: at the depth that was measured, what
        comes out too near seems to be surer.
        """
        powers = self.depth_sums.powers()
        ahead = c[:, 2] > 0
        if powers == (0.0, 0.0) or not ahead.all():
            return S
        R, depth = T[:3, :3], transform(inverse(T), expected)[:, 2]
        return rotate_cov(R, stretched(c, rotate_cov(R.T, S), depth, powers))

    def in_view(self, T: Array, places: Array, slack: float) -> BoolArray:
        """Which places (k, 3) lie in the field of view, widened by ``slack`` (of x / z) on all sides."""
        p = transform(inverse(T), places)
        z = np.where(p[:, 2] > 1e-6, p[:, 2], 1e-6)
        rays = np.column_stack([p[:, 0] / z, p[:, 1] / z, p[:, 2]])
        margin = np.array([slack, slack, 0.1 * max(self.high[2], 0.0)])
        visible: BoolArray = ((rays > self.low - margin) & (rays < self.high + margin)).all(axis=1)
        return visible

    def view_depth(self) -> float:
        """Middle of the depths in which points were seen, m; zero before any was."""
        return float(0.5 * (self.low[2] + self.high[2])) if np.isfinite(self.low[2]) else 0.0

    def view_volume(self) -> float:
        """How much space one look holds, m^3.

        The range of n points that lie anywhere is (n - 1) / (n + 1) of the range in which they may.
        """
        if not np.isfinite(self.low).all():
            return 1.0
        depth = self.view_depth()
        width, height = np.maximum(self.high - self.low, 0.1)[:2] * depth
        unseen = (self.most_points + 1.0) / (self.most_points - 1.0)
        return float(unseen**2 * width * height * depth)

    def note_unclaimed(self, n: int) -> None:
        """So many points of a frame belong to no known flower."""
        self.unclaimed += _UNCLAIMED_GAIN * (n - self.unclaimed)

    def unclaimed_density(self) -> float:
        """Points in one look that belong to no known flower, 1 / m^3."""
        return max(self.unclaimed, _UNCLAIMED_GAIN) / self.view_volume()

    def place_anchors(self, slots: IntArray) -> None:
        """Centroids at rest of these clusters, from their flowers: the confirmed ones, where there are any."""
        table = self.flowers
        for slot in slots.tolist():
            mine = np.flatnonzero(table.slot == slot)
            sure = mine[table.confirmed[mine]]
            mine = sure if len(sure) else mine
            self.clusters[slot].place(table.place[mine].mean(0), table.ids[mine])
            self.clusters[slot].anchor_cov = table.cov[mine].mean(0) / np.sqrt(len(mine))

    def drop(self, gone: BoolArray) -> None:
        """Remove flowers (f,), and the clusters that have none any more."""
        if not gone.any():
            return
        touched = np.unique(self.flowers.slot[gone])
        seats = self.flowers.seat[gone]
        self.grouping.leave(seats[seats >= 0])
        self.flowers.keep(~gone)
        self.drop_empty(touched)

    def drop_empty(self, touched: IntArray) -> None:
        """Remove clusters without flowers; move the centroids of those that were touched."""
        table = self.flowers
        size = np.bincount(table.slot, minlength=len(self.clusters))
        self.place_anchors(touched[size[touched] > 0])
        if (size == 0).any():
            table.slot = (np.cumsum(size > 0) - 1)[table.slot]
            self.clusters = [k for k, n in zip(self.clusters, size, strict=True) if n]

    def say(self, kind: RevisionKind, subject: Subject, before: int, after: int, reason: str) -> None:
        """Something is known better than a frame ago."""
        self.revisions.append(Revision(kind, subject, before, after, reason))
