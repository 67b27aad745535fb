"""Points that nobody claims begin tentative flowers: in which cluster, and in what kind of place."""

from __future__ import annotations

import numpy as np

from cluster_slam.association.frames import information, point_jacobian
from cluster_slam.geometry import Array
from cluster_slam.online.associate import Seen, View
from cluster_slam.online.births import ALONE, BESIDE, DOUBTFUL
from cluster_slam.online.world import World
from cluster_slam.records import BoolArray, IntArray, RejectReason
from tracking.gating import chi2_threshold

VIEW_RIM = -0.02  # of x / z: at the rim of the view nothing is a miss, and all is fresh


def bear(
    world: World,
    seen: Seen,
    view: View,
    T: Array,
    w: Array,
    row_of: IntArray,
    reasons: IntArray,
    missing: IntArray,
) -> None:
    """Points that nobody claims begin tentative flowers, in the cluster next to them or in one of their own."""
    left, known = np.flatnonzero(row_of < 0), np.flatnonzero(row_of >= 0)
    if len(left) and len(known):
        gap = w[left][:, None] - w[known][None]
        cov = view.S[left][:, None] + view.S[known][None]
        chi2 = np.einsum("abi,abij,abj->ab", gap, information(cov), gap)
        doubled = (chi2 < chi2_threshold(3, 0.9)).any(1)
        reasons[left[doubled]] = int(RejectReason.TAKEN)
        left = left[~doubled]
    if not len(left):
        return
    note_spacing(world, w)
    slot, beside = slots_for(world, w, left, known, row_of, view.stamp)
    d = np.zeros((len(world.clusters), 3))
    d[: len(seen.at.d)] = seen.at.d
    J = point_jacobian(T[:3, :3], view.c[left])
    cov = view.S[left] + J @ seen.pose.cov @ np.swapaxes(J, 1, 2)
    kind = world.births.kind(kind_of_place(world, slot, missing, beside), is_fresh(world, w[left]))
    row_of[left] = world.flowers.add(w[left] - d[slot], cov, J, slot, view.stamp)
    world.flowers.kind[row_of[left]] = kind
    world.place_anchors(np.unique(slot))


def kind_of_place(world: World, slot: IntArray, missing: IntArray, beside: BoolArray) -> IntArray:
    """Whether new flowers (k,) stand alone, or beside a known cluster, which may move, or be ``missing`` (c,) some.

    ``beside`` (k,): beside one that moves, in a cluster of their own.
    """
    known = np.array([cluster.state != "tentative" for cluster in world.clusters])
    misses = np.zeros(len(known), dtype=np.int64)
    misses[: len(missing)] = missing
    is_doubtful = misses >= np.bincount(slot, minlength=len(known))
    place: IntArray = np.where(known[slot], np.where(is_doubtful[slot], DOUBTFUL, BESIDE), ALONE)
    return np.where(beside, DOUBTFUL, place)


def is_fresh(world: World, w: Array) -> BoolArray:
    """Which places (k, 3) were not in view a moment ago."""
    if not world.births.past:
        return np.ones(len(w), dtype=bool)
    return ~world.in_view(world.births.past[0][1], w, VIEW_RIM)


def note_spacing(world: World, w: Array) -> None:
    """How close flowers stand: a low quantile of the distance to the nearest of the same frame, averaged."""
    if len(w) < 2:
        return
    gap = np.linalg.norm(w[:, None] - w[None], axis=-1)
    np.fill_diagonal(gap, np.inf)
    low = float(np.quantile(gap.min(1), 0.1))
    world.spacing = low if not np.isfinite(world.spacing) else world.spacing + 0.05 * (low - world.spacing)


def slots_for(
    world: World, w: Array, left: IntArray, known: IntArray, row_of: IntArray, stamp: float
) -> tuple[IntArray, BoolArray]:
    """Clusters (k,) for new flowers at ``w[left]``, and which of these stand beside one that moves.

    New clusters are made where none is near, or where it moves: who hangs beside a cluster that swings need not swing
    with it, and who does is found by the grouping.
    """
    table, link = world.flowers, world.grouping.link
    host = np.full(len(left), -1, dtype=np.int64)
    if link > 0.0 and len(known):
        gap = np.linalg.norm(w[left][:, None] - w[known][None], axis=-1)
        near = gap.min(1) < link
        host[near] = table.slot[row_of[known[gap.argmin(1)]]][near]
    if link > 0.0 and len(table):
        gap = np.linalg.norm(w[left][:, None] - table.place[None], axis=-1)
        near = (host < 0) & (gap.min(1) < link)
        host[near] = table.slot[gap.argmin(1)][near]
    moves = np.array([cluster.is_moving for cluster in world.clusters] + [False])
    beside: BoolArray = moves[host]
    slot = np.where(beside, -1, host)
    free = np.flatnonzero(slot < 0)
    if len(free):
        label = world.grouping.group_new(w[left[free]], world.view_volume())
        for k in range(int(label.max()) + 1):
            slot[free[label == k]] = world.new_cluster(stamp)
    return slot, beside
