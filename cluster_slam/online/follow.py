"""Each seen cluster's state brought up to date, and the frame put into the map."""

from __future__ import annotations

import numpy as np

from cluster_slam.association.frames import chi2_and_log_det, information, point_jacobian
from cluster_slam.geometry import Array, se3_exp, transform
from cluster_slam.graph.incremental import FrameMatches
from cluster_slam.online.associate import Seen, View
from cluster_slam.online.cluster import WAKE_M
from cluster_slam.online.shape import Shape, seen_shape
from cluster_slam.online.world import World
from cluster_slam.records import IntArray

_FEWEST = 3  # flowers that have a shape


def follow(world: World, seen: Seen, w: Array, S: Array, stamp: float) -> None:
    """Weigh what each cluster does, and step the filters of those that move (and now and then of those that rest)."""
    pose, at = seen.pose, seen.at
    if not len(pose.slots):
        return
    slots = world.flowers.slot[seen.rows]
    n_seen = np.bincount(slots, minlength=len(world.clusters))
    u = at.d[pose.slots] + pose.shift
    tremble = world.motion.tremble_m**2 * np.eye(3)
    rest_cov = pose.shift_cov + tremble
    chi2, log_det = chi2_and_log_det(u, rest_cov)
    wide, log_det_wide = chi2_and_log_det(u, pose.shift_cov + WAKE_M**2 * np.eye(3))
    at_rest, waking = -0.5 * (chi2 + log_det), -0.5 * (wide + log_det_wide)
    gain = tremble @ information(rest_cov)
    rest_d = (gain @ u[..., None])[..., 0]
    rest_P = tremble - gain @ tremble
    mine_not: IntArray = np.zeros(0, dtype=np.int64)
    for cluster in world.clusters:
        cluster.trembling = None
    for k, slot in enumerate(pose.slots.tolist()):
        cluster = world.clusters[slot]
        since = stamp - cluster.last
        cluster.weigh(float(at_rest[k]), float(waking[k]), pose.shift[k], pose.shift_cov[k], since)
        cluster.awaken(stamp)
        if cluster.wants_filter(stamp):
            mine = np.flatnonzero(slots == slot) if cluster.wants_shape(stamp) else mine_not
            shape = shape_of(world, seen, mine, slot, w, S)
            cluster.update(at.anchor[slot] + u[k], pose.shift_cov[k], shape, stamp)
        if not cluster.is_moving:
            cluster.trembling = rest_d[k], rest_P[k]
            cluster.rest(u[k], since, stamp)
        cluster.last = stamp
        cluster.n += int(n_seen[slot])


def shape_of(world: World, seen: Seen, mine: IntArray, slot: int, w: Array, S: Array) -> Shape | None:
    """Descriptor of a cluster's seen flowers, matches ``mine`` (k,)."""
    if len(mine) < _FEWEST:
        return None
    var = np.trace(S[seen.cols[mine]], axis1=1, axis2=2) / 3.0
    return seen_shape(world.flowers.place[seen.rows[mine]] - seen.at.anchor[slot], w[seen.cols[mine]], var)


def remember(world: World, seen: Seen, view: View) -> None:
    """Put the frame's matches into the map, with how far each cluster may stand from rest."""
    rows, cols, pose = seen.rows, seen.cols, seen.pose
    if not len(rows):
        return
    T = view.T @ se3_exp(pose.z)
    J = point_jacobian(T[:3, :3], view.c[cols])
    slot = world.flowers.slot[rows]
    # Trembling that lasts for a while counts once, not once a frame.
    once = np.sqrt(max(2.0 * world.motion.tremble_s / max(world.usual_dt, 1e-3), 1.0))
    reach = np.array([k.reach for k in world.clusters])
    W = information(view.S[cols] + world.config.slack_m**2 * np.eye(3)) * pose.weight[:, None, None]
    lever = world.flowers.lever
    lever[rows] += (J - lever[rows]) / world.flowers.n[rows][:, None, None]
    world.map.add(
        FrameMatches(
            stamp=view.stamp,
            ids=world.flowers.ids[rows],
            points=transform(T, view.c[cols]) - J @ world.x,
            J=J,
            J_x=J,
            W=W,
            cluster=slot,
            sway_var=(reach[slot] * once) ** 2,
            z=pose.z,
            prior=np.asarray(np.linalg.inv(view.cov), np.float64),
        )
    )
