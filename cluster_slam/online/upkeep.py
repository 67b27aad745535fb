"""Now and then: the map solved, doubles merged, flowers grouped again, and who is lost."""

from __future__ import annotations

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.online.world import World
from cluster_slam.records import BoolArray, IntArray

_FEW_LOOKS = 2  # of each of two landmarks, before it is believed that they are never seen together
_TOGETHER = 0.15  # share of the rarer one's looks that saw both: two flowers
_DOUBLE = 0.6  # of how close flowers stand: nearer landmarks may be one
_ALTERNATING = 6  # times of the rarer one, the other never there: then they may stand farther apart ...
_SWAYED = 1.2  # ... as the place of one was taken while it swayed


def solve_near(world: World, stamp: float, since: float) -> None:
    """Solve the map for the flowers seen lately, the others held."""
    table = world.flowers
    rows = np.flatnonzero(table.confirmed & (table.last >= since))
    if not len(rows):
        return
    ids = world.map.ids
    order = np.argsort(table.ids)
    known = table.place[order[np.searchsorted(table.ids[order], ids)]]
    table.place[rows], table.cov[rows] = world.map.solve_near(table.ids[rows], known)
    world.place_anchors(np.unique(table.slot[rows]))


def solve_all(world: World) -> Array:
    """Solve the whole map; returns the covariance (6, 6) of the hand-eye tangent."""
    table = world.flowers
    world.x, places, cov = world.map.solve()
    rows = np.flatnonzero(table.confirmed)
    at = world.map.rows(table.ids[rows])
    table.place[rows] = places[at]
    blocks = cov[6:, 6:].reshape(len(places), 3, len(places), 3)
    table.cov[rows] = blocks[at, :, at]
    world.place_anchors(np.unique(table.slot[rows]))
    return cov[:6, :6]


def merge_doubles(world: World) -> None:
    """Two landmarks at one place that are never seen in one frame are one flower: the older id lives on."""
    table = world.flowers
    rows = np.flatnonzero(table.confirmed)
    if len(rows) < 2 or not np.isfinite(world.spacing):
        return
    sigma = np.sqrt(np.trace(table.cov[rows], axis1=1, axis2=2) / 3.0)
    gap = np.linalg.norm(table.place[rows][:, None] - table.place[rows][None], axis=-1)
    likely = np.maximum(0.5 * _DOUBLE * world.spacing, 3.0 * (sigma[:, None] + sigma[None]))
    likely = np.minimum(_DOUBLE * world.spacing, likely)
    seat, slot = table.seat[rows], table.slot[rows]
    counts = world.grouping.counts[seat[:, None], seat]
    each = np.diag(counts)
    never = (counts == 0) & (np.minimum(each[:, None], each) >= _ALTERNATING) & (slot[:, None] == slot)
    close = np.argwhere(np.triu((gap < likely) | (never & (gap < _SWAYED * world.spacing)), 1))
    gone = np.zeros(len(table), dtype=bool)
    for a, b in rows[close].tolist():
        both, fewer = world.grouping.together(int(table.seat[a]), int(table.seat[b]))
        if gone[a] or gone[b] or fewer < _FEW_LOOKS or both > _TOGETHER * fewer:
            continue
        stays, goes = (a, b) if table.ids[a] < table.ids[b] else (b, a)
        from_id, to_id = int(table.ids[goes]), int(table.ids[stays])
        world.map.merge(from_id, to_id)
        table.n[stays] += table.n[goes]
        world.merged.append((from_id, to_id))
        world.say("merged", "flower", from_id, to_id, "one place, never seen together")
        world.births.were_false(table.kind[goes : goes + 1], table.n[goes : goes + 1])
        gone[goes] = True
    world.drop(gone)


def regroup(world: World, stamp: float, since: float) -> None:
    """Begin to group all flowers again, or do so at once; those not seen ``since`` then are not asked."""
    table = world.flowers
    rows = np.flatnonzero(table.confirmed)
    if len(rows) < 2:
        return
    seats, places, volume = table.seat[rows], table.place[rows], world.view_volume()
    label = world.grouping.at_once(seats, places, volume, np.random.default_rng(world.seed))
    if label is not None:
        regrouped(world, rows, label, stamp)
        return
    asked: BoolArray = table.last[rows] >= since
    world.grouping.begin(table.ids[rows], seats, places, table.slot[rows], volume, asked)


def carry_on(world: World, stamp: float) -> None:
    """A round of the grouping goes on, and at last has its say."""
    if world.grouping.round is None:
        return
    table = world.flowers
    confirmed = np.flatnonzero(table.confirmed)
    row_of = dict(zip(table.ids[confirmed].tolist(), confirmed.tolist(), strict=True))
    found = world.grouping.carry_on({i: int(table.seat[row]) for i, row in row_of.items()}, world.usual_dt)
    if found is not None and len(found[0]):
        ids, label = found
        regrouped(world, np.array([row_of[i] for i in ids.tolist()], dtype=np.int64), label, stamp)


def regrouped(world: World, rows: IntArray, label: IntArray, stamp: float) -> None:
    """Flowers (l,) are in these clusters; each keeps the id of the cluster that most of it came from."""
    table = world.flowers
    old = table.slot[rows]
    label = np.unique(label, return_inverse=True)[1].astype(np.int64)
    weight, n_seen = np.zeros((2, int(label.max()) + 1, len(world.clusters)))
    np.add.at(weight, (label, old), 1.0)
    np.add.at(n_seen, (label, old), table.n[rows])
    if ((weight > 0).sum(0) <= 1).all() and ((weight > 0).sum(1) <= 1).all():
        return
    slot_of = keep_names(world, weight, n_seen, stamp)
    before = table.slot.copy()
    table.slot[rows] = slot_of[label]
    left_out = np.ones(len(table), dtype=bool)
    left_out[rows] = False
    for s in np.unique(old).tolist():
        if not (table.slot[rows] == s).any():
            to = int(np.bincount(table.slot[rows[old == s]]).argmax())
            table.slot[(before == s) & left_out] = to
            a, b = world.clusters[s], world.clusters[to]
            b.first, b.n = min(a.first, b.first), a.n + b.n
            world.merged_clusters.append((a.id, b.id))
            world.say("merged", "cluster", a.id, b.id, "their flowers stand as one")
    size = np.bincount(table.slot, minlength=len(world.clusters))
    changed = np.unique(np.concatenate([before, table.slot]))
    world.place_anchors(changed[size[changed] > 0])
    for cluster in world.clusters:
        if cluster.state != "tentative":
            cluster.awaken(stamp)
    world.drop_empty(np.zeros(0, dtype=np.int64))


def keep_names(world: World, weight: Array, n_seen: Array, stamp: float) -> IntArray:
    """Slots (g,) of groups that share ``weight`` (g, c) flowers with the clusters: largest shares first.

    Of equal ones that which was seen more often (g, c): of two flowers that part, the older one keeps the name.
    """
    slot_of = np.full(len(weight), -1, dtype=np.int64)
    taken = np.zeros(len(world.clusters), dtype=bool)
    shares = [
        (-weight[g, s], -n_seen[g, s], world.clusters[s].first, g, s) for g, s in np.argwhere(weight > 0).tolist()
    ]
    for *_, g, s in sorted(shares):
        if slot_of[g] < 0 and not taken[s]:
            slot_of[g], taken[s] = s, True
    for g in np.flatnonzero(slot_of < 0).tolist():
        parent = world.clusters[int(weight[g].argmax())]
        slot_of[g] = world.new_cluster(stamp)
        child = world.clusters[-1]
        child.first, child.last, child.state = parent.first, parent.last, "confirmed"
        world.say("moved", "cluster", parent.id, child.id, "its flowers do not belong together")
    return slot_of


def tell_lost(world: World, stamp: float) -> None:
    """Who has not been seen for long, and who is back."""
    lost_s = world.config.lost_s
    for cluster in world.clusters:
        if cluster.state == "confirmed" and stamp - cluster.last > lost_s:
            cluster.state = "lost"
            world.say("lost", "cluster", cluster.id, cluster.id, f"not seen for {lost_s:g} s")
        elif cluster.state == "lost" and stamp - cluster.last <= lost_s:
            cluster.state = "confirmed"
            world.say("returned", "cluster", cluster.id, cluster.id, "seen again")
