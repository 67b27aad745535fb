"""The life of flowers: born of points that nobody claims, confirmed when seen M times of N, forgotten when not found.

A miss counts only where the flower was in view, one of its cluster was seen, and nothing stood before it.
"""

from __future__ import annotations

import numpy as np

from cluster_slam.association.frames import information, point_jacobian
from cluster_slam.geometry import Array, inverse, transform
from cluster_slam.online.associate import Seen, View
from cluster_slam.online.bear import VIEW_RIM, bear
from cluster_slam.online.matching import match
from cluster_slam.online.world import Snapshot, World
from cluster_slam.records import BoolArray, IntArray, RejectReason

_KEEP = 0.998  # of the count of looks, from look to look
_WANDER_SPEED = 0.1  # m/s, one sigma an axis of what has just been found and may be swaying ...
_WANDER_SHARE = 0.2  # ... but never so much of how close flowers stand that they could be mistaken
_GHOST_LOOKS = 15  # looks at a landmark before it can be found to be none ...
_GHOST_SHARE = 0.3  # ... seen in so small a share of them, compared with the others
_WILD_CHI2 = 150.0  # 3 degrees of freedom: errors of up to five times what is stated ...
_WILD_SHARE = 0.6  # ... and within this share of how close flowers stand
_MOST_MET = 200  # flowers, before those that wait no more for their id are left out
_MISSING_S = 1.0  # a landmark that was seen so lately may have been moved by a touch
_FLOWER_SHARE = 0.3  # radius of a flower over how close they stand


def live(world: World, seen: Seen, view: View, T: Array, w: Array) -> tuple[IntArray, IntArray]:
    """Flower id of each point (q,), -1 for none, and the reason (q,) of each."""
    table = world.flowers
    row_of = np.full(len(w), -1, dtype=np.int64)
    row_of[seen.cols] = seen.rows
    claim_wild(world, seen, view, w, row_of)
    match_tentative(world, seen, view, T, w, row_of)
    count_hits(world, row_of[row_of >= 0], view.stamp)
    missing = count_misses(world, seen.at, T, view.c, row_of[row_of >= 0])
    note_motion(world, seen, w, view)
    reasons = np.where(row_of >= 0, int(RejectReason.ACCEPTED), int(RejectReason.POSITION_GATE))
    bear(world, seen, view, T, w, row_of, reasons, missing)
    world.births.note_view(view.stamp, T)
    shown = row_of >= 0
    rows = row_of[shown]
    n = table.n[rows]
    is_seen_often = (n >= world.config.confirm_hits) & ~world.births.is_doubtful(table.kind[rows])
    is_known = table.confirmed[rows] | is_seen_often | world.births.is_flower(table.kind[rows], n)
    table.told[rows] |= is_known & ~may_be_missing(world, rows, seen.at, T, view.stamp)
    shown[shown] = table.told[rows]
    reasons[(row_of >= 0) & ~shown] = int(RejectReason.UNCONFIRMED)
    confirm(world, seen, view.stamp)
    return np.where(shown, table.ids[row_of] if len(table) else -1, -1), reasons


def may_be_missing(world: World, rows: IntArray, at: Snapshot, T: Array, stamp: float) -> BoolArray:
    """Which flowers (k,) seen in this frame, whose ids were not yet given out, may be landmarks that a touch has moved.

    One that hangs within reach was seen a moment ago and should be in view, is not seen now, and never was together
    with this one.
    """
    table = world.flowers
    found: BoolArray = np.zeros(len(rows), dtype=bool)
    new = np.flatnonzero(~table.told[rows])
    others = np.flatnonzero(table.told & table.confirmed & (table.last > stamp - _MISSING_S))
    if not (len(new) and len(others)):
        return found
    others = others[world.in_view(T, world.expected(others, at), VIEW_RIM)]
    gap = table.place[rows[new]][:, None] - world.expected(others, at)[None]
    near = np.einsum("abi,abi->ab", gap, gap) < world.config.follow.reach_m**2
    is_here = table.last[others] >= stamp
    for k, nearby in zip(new.tolist(), near, strict=True):
        met = world.met.setdefault(int(table.ids[rows[k]]), set())
        met.update(table.ids[others[nearby & is_here]].tolist())
        found[k] = any(i not in met for i in table.ids[others[nearby & ~is_here]].tolist())
    return found


def claim_wild(world: World, seen: Seen, view: View, w: Array, row_of: IntArray) -> None:
    """A point outside of all gates, next to a flower that was not seen, is that flower with a wild error.

    No other flower can stand so near. The point tells whose it is and nothing else: no state takes it in.
    """
    table = world.flowers
    left, rows = np.flatnonzero(row_of < 0), np.flatnonzero(table.confirmed)
    if not (len(left) and len(rows) and np.isfinite(world.spacing)):
        return
    expected = world.expected(rows, seen.at)
    gap = w[left][:, None] - expected[None]
    nearest = np.einsum("abi,abi->ab", gap, gap).argmin(1)
    gap = gap[np.arange(len(left)), nearest]
    slot = table.slot[rows[nearest]]
    cov = view.S[left] + table.cov[rows[nearest]] + seen.at.P[slot] + world.config.slack_m**2 * np.eye(3)
    chi2 = np.einsum("ai,aij,aj->a", gap, information(cov), gap)
    free = np.ones(len(table), dtype=bool)
    free[seen.rows] = False
    near = np.sqrt((gap * gap).sum(1)) < _WILD_SHARE * world.spacing
    for k in np.argsort(chi2, kind="stable").tolist():
        row = int(rows[nearest[k]])
        if near[k] and chi2[k] < _WILD_CHI2 and free[row]:
            row_of[left[k]], free[row] = row, False


def match_tentative(world: World, seen: Seen, view: View, T: Array, w: Array, row_of: IntArray) -> None:
    """What is left may be tentative flowers, displaced as their cluster is; fills ``row_of`` (q,)."""
    table = world.flowers
    left, tentative = np.flatnonzero(row_of < 0), np.flatnonzero(~table.confirmed)
    if not (len(left) and len(tentative)):
        return
    slot = table.slot[tentative]
    slack = world.config.slack_m**2 * np.eye(3)
    J = point_jacobian(T[:3, :3], view.c[left])
    cov = view.S[left] + J @ seen.pose.cov @ np.swapaxes(J, 1, 2)
    at = table.place[tentative] + seen.at.d[slot]
    table.cov[tentative] += wander(world, tentative, view.stamp)[:, None, None] * np.eye(3)
    m = match(at, table.cov[tentative] + seen.at.P[slot] + slack, w[left], cov, world.config.gate_chi2)
    rows, cols = tentative[m.rows], left[m.cols]
    row_of[cols] = rows
    P = table.cov[rows] + slack
    gain = P @ information(P + world.noise_at(T, at[m.rows], view.c[cols], view.S[cols]))
    table.place[rows] += (gain @ (w[cols] - seen.at.d[table.slot[rows]] - table.place[rows])[..., None])[..., 0]
    P = P - gain @ P
    table.cov[rows] = 0.5 * (P + np.swapaxes(P, 1, 2))


def wander(world: World, rows: IntArray, stamp: float) -> Array:
    """Variance (k,) of how far new flowers may have gone since the last frame, unless their cluster rests."""
    table = world.flowers
    may_sway = np.array([k.state == "tentative" or k.is_moving for k in world.clusters])[table.slot[rows]]
    far = min(_WANDER_SPEED * world.usual_dt, _WANDER_SHARE * world.spacing)
    return np.where(may_sway & (table.first[rows] < stamp), far * far, 0.0)


def count_hits(world: World, hit: IntArray, stamp: float) -> None:
    table = world.flowers
    table.hits[hit] = (table.hits[hit] << 1) | 1
    table.vain[hit] = 0
    table.n[hit] += 1
    table.last[hit] = stamp
    table.looks[hit] = _KEEP * table.looks[hit] + 1.0
    table.found[hit] = _KEEP * table.found[hit] + 1.0


def count_misses(world: World, at: Snapshot, T: Array, c: Array, hit: IntArray) -> IntArray:
    """Count the looks in vain; returns how many landmarks of each cluster (c,) were in view and not seen."""
    table, n = world.flowers, len(world.clusters)
    if not len(table) or not len(c):
        return np.zeros(n, dtype=np.int64)
    expected = world.expected(np.arange(len(table)), at)
    missed = world.in_view(T, expected, VIEW_RIM)
    missed[hit] = False
    missing = np.bincount(table.slot[missed & table.confirmed], minlength=n)
    witness = np.zeros(n, dtype=bool)
    witness[table.slot[hit]] = True
    alone = np.bincount(table.slot, minlength=n) < 2
    rows = np.flatnonzero(missed & (witness[table.slot] | alone[table.slot] | ~table.confirmed))
    if not len(rows):
        return missing
    clear = ~is_hidden(transform(inverse(T), expected[rows]), c, _FLOWER_SHARE * min(world.spacing, 0.1))
    rows = rows[clear]
    table.hits[rows] <<= 1
    table.vain[rows] += 1
    table.looks[rows] = _KEEP * table.looks[rows] + 1.0
    table.found[rows] *= _KEEP
    return missing


def is_hidden(p: Array, c: Array, radius: float) -> BoolArray:
    """Which points p (k, 3) have a seen point c (q, 3) before them, camera frame; flowers have a radius, m."""
    depth = c[:, 2]
    across = p[:, None, :2] / p[:, None, 2:] - c[None, :, :2] / depth[None, :, None]
    near = (across * across).sum(-1) * depth**2 < radius * radius
    hidden: BoolArray = (near & (depth < p[:, 2:] - radius)).any(1)
    return hidden


def note_motion(world: World, seen: Seen, w: Array, view: View) -> None:
    """Who was seen together, and who moved together."""
    if not len(seen.rows):
        return
    table, rows = world.flowers, seen.rows
    var = np.trace(view.S[seen.cols], axis1=1, axis2=2) / 3.0 + np.trace(seen.pose.cov[3:, 3:]) / 3.0
    world.grouping.observe(view.stamp, table.seat[rows], w[seen.cols], var, table.place[rows])


def confirm(world: World, seen: Seen, stamp: float) -> None:
    """M of N: tentative flowers that were seen often enough become landmarks.

    What they were seen at so far errs with the poses of the same few frames, all in common. The map is told of each by
    itself: with k times the common variance, which k flowers together never say too much with.
    """
    table, config = world.flowers, world.config
    times = np.where(world.births.is_doubtful(table.kind), 2, 1)  # a known flower that moved will have been found
    count = np.bitwise_count(table.hits & ((1 << times * config.confirm_of) - 1))
    new = np.flatnonzero(~table.confirmed & (count >= times * config.confirm_hits))
    world.births.became_flowers(table.kind[new])
    common = (len(seen.rows) + len(new)) * seen.pose.cov
    for row in new.tolist():
        table.confirmed[row] = True
        table.seat[row] = world.grouping.sit()
        cluster, lever = world.clusters[int(table.slot[row])], table.lever[row]
        cov = table.cov[row] + (cluster.reach**2 + config.slack_m**2) * np.eye(3) + lever @ common @ lever.T
        world.map.include(int(table.ids[row]), table.place[row] - lever @ world.x, cov, lever)
        if cluster.state == "tentative":
            cluster.state = "confirmed"
            world.say("confirmed", "cluster", cluster.id, cluster.id, "its flowers were seen again")
        cluster.awaken(stamp)
        world.grouping.is_stale = True


def forget(world: World) -> None:
    """Remove tentative flowers looked for in vain, and landmarks that are hardly ever where they should be."""
    table, config = world.flowers, world.config
    if not len(table):
        return
    patience = np.where(table.n <= 1, config.confirm_of - config.confirm_hits, config.forget_looks)
    gone = ~table.confirmed & (table.vain >= patience)
    world.births.were_false(table.kind[gone], table.n[gone])
    share = table.found / np.maximum(table.looks, 1.0)
    sure = table.confirmed & (table.looks > _GHOST_LOOKS)
    if sure.any():
        ghost = sure & (share < _GHOST_SHARE * float(np.median(share[sure]))) & (table.vain > 4)
        for row in np.flatnonzero(ghost).tolist():
            world.map.remove(int(table.ids[row]))
            world.say("forgotten", "flower", int(table.ids[row]), -1, "it was looked for in vain")
            world.births.were_false(table.kind[row : row + 1], table.n[row : row + 1])
        gone |= ghost
    world.drop(gone)
    if len(world.met) > _MOST_MET:
        waiting = table.ids[~table.told].tolist()
        world.met = {i: world.met[i] for i in waiting if i in world.met}
