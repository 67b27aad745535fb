"""Which confirmed flower each point of a frame shows, clusters that were touched included, and the frame's pose."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.association.frames import information, point_jacobian
from cluster_slam.geometry import Array, se3_exp, transform
from cluster_slam.online.matching import Matches, match
from cluster_slam.online.pose import PoseSolution, no_pose, solve_pose
from cluster_slam.online.search import Scene, find_moved, with_moved
from cluster_slam.online.strays import find_strays
from cluster_slam.online.world import Snapshot, World
from cluster_slam.records import IntArray
from tracking.motion import touch_noise

_NEAR_VIEW = 0.15  # of x / z: moving clusters so far outside of the view are still followed
_VIEW = 0.02
_JUMP_SIGMA_M = 0.005  # of a displacement that the search has found, before the frame's own pose is known
_LONG_S = 0.5  # a cluster unseen for longer is searched for ...
_SOMETIMES = 5  # ... in one of so many frames
_STRAY_S = 0.25  # a flower unseen for longer may be anywhere
_YOUNG_SHARE = 0.3  # of how close flowers stand: a point so near to where a new flower was seen is that one


@dataclass(frozen=True, slots=True, eq=False)
class View:
    """One frame's points: ``c`` (q, 3) camera, ``S`` (q, 3, 3) world, with the pose as predicted and its covariance."""

    T: Array
    cov: Array
    c: Array
    S: Array
    stamp: float
    number: int


@dataclass(frozen=True, slots=True, eq=False)
class Seen:
    """Confirmed flowers (q,) rows and points (q,) that belong together, and the frame's pose."""

    rows: IntArray
    cols: IntArray
    chi2: Array
    pose: PoseSolution
    at: Snapshot


def associate(world: World, view: View, cov_hand_eye: Array) -> tuple[Seen, View]:
    """Match, find the pose, match again, search for what was touched, and find the pose of all that.

    Returns what was seen, and the view with the noise that its points have at the depth of what they show.
    """
    table, config = world.flowers, world.config
    predict_moving(world, view)
    rows = np.flatnonzero(table.confirmed)
    at = world.snapshot(view.stamp)
    J = point_jacobian(view.T[:3, :3], view.c)
    cov_z = view.cov + cov_hand_eye
    prior = np.asarray(np.linalg.inv(cov_z), np.float64)
    w = transform(view.T, view.c)
    place_cov = table.cov[rows] + config.slack_m**2 * np.eye(3)
    predicted = world.expected(rows, at)
    P = at.P[table.slot[rows]] + place_cov
    found = match(predicted, P, w, view.S + J @ cov_z @ np.swapaxes(J, 1, 2), config.gate_chi2)

    def pose_of(m: Matches, S: Array, n_iterations: int = 3) -> PoseSolution:
        if not len(m.rows):
            return no_pose(cov_z)
        W = information(S[m.cols] + place_cov[m.rows])
        slot = table.slot[rows[m.rows]]
        return solve_pose(J[m.cols], predicted[m.rows] - w[m.cols], W, slot, at.P, prior, n_iterations=n_iterations)

    pose = pose_of(found, view.S, 2)
    moved = transform(view.T @ se3_exp(pose.z), view.c)
    found = match(predicted, P, moved, view.S + J @ pose.cov @ np.swapaxes(J, 1, 2), config.gate_chi2)
    better = search(world, view, rows, found, predicted, moved, at)
    if better is not None:
        found, at = better, world.snapshot(view.stamp)
        predicted = world.expected(rows, at)
    better = with_strays(world, view, rows, found, predicted, P, moved, at)
    if better is not None:
        found, at = better, world.snapshot(view.stamp)
        predicted = world.expected(rows, at)
    S = view.S.copy()
    k = found.cols
    S[k] = world.noise_at(view.T @ se3_exp(pose.z), predicted[found.rows], view.c[k], S[k])
    return Seen(rows[found.rows], k, found.chi2, pose_of(found, S), at), replace(view, S=S)


def predict_moving(world: World, view: View) -> None:
    """Bring the clusters that move, and may be seen, to the time of the frame."""
    moving = [k for k in world.clusters if k.is_moving and k.anchor is not None]
    if not moving:
        return
    anchors = np.array([k.anchor for k in moving])
    for cluster, is_near in zip(moving, world.in_view(view.T, anchors, _NEAR_VIEW), strict=True):
        if is_near:
            cluster.predict(view.stamp)


def search(
    world: World, view: View, rows: IntArray, matches: Matches, predicted: Array, w: Array, at: Snapshot
) -> Matches | None:
    """Better matches, where clusters had lost their flowers and were found elsewhere; None where none was."""
    if not len(rows) or not len(w):
        return None
    table = world.flowers
    slots = table.slot[rows]
    turn = (np.arange(len(world.clusters)) + view.number) % _SOMETIMES == 0
    looked = world.in_view(view.T, predicted, _VIEW) & ((at.unseen_s < _LONG_S) | turn)[slots]
    looked[matches.rows] = True
    flowers = np.flatnonzero(looked)
    index = np.full(len(rows), -1)
    index[flowers] = np.arange(len(flowers))
    scene = Scene(table.place[rows[flowers]], slots[flowers], w, view.S, at.d, at.P, at.unseen_s)
    before = replace(matches, rows=index[matches.rows])
    found = find_moved(scene, before, world.config.follow)
    if not found:
        return None
    for slot, moved in found.items():
        if moved.is_jump:
            jump(world, slot, moved.d, at, "it was found elsewhere, by its shape", view.stamp)
    after = with_moved(before, found, slots[flowers], len(w))
    return replace(after, rows=flowers[after.rows])


def with_strays(
    world: World, view: View, rows: IntArray, found: Matches, predicted: Array, P: Array, w: Array, at: Snapshot
) -> Matches | None:
    """More matches, of flowers that are alone: one that is missed may be a point nearby that nobody claims."""
    table = world.flowers
    slot = table.slot[rows]
    unclaimed = np.ones(len(w), dtype=bool)
    unclaimed[found.cols] = False
    world.note_unclaimed(int(unclaimed.sum()))
    missed = np.bincount(slot, minlength=len(world.clusters))[slot] == 1
    missed[found.rows] = False
    unseen_s = view.stamp - table.last[rows]
    lost = np.flatnonzero(missed & (unseen_s < _STRAY_S) & world.in_view(view.T, predicted, 0.0))
    young = np.flatnonzero(~table.confirmed & (table.n > 1))
    if len(lost) and len(young) and len(w):
        gap = np.linalg.norm(w[:, None] - world.expected(young, at)[None], axis=-1)
        unclaimed &= gap.min(1) > _YOUNG_SHARE * min(world.spacing, 0.1)
    free = np.flatnonzero(unclaimed)
    if not (len(lost) and len(free)):
        return None
    touch = np.array([touch_noise(t, world.motion)[:3, :3] for t in unseen_s[lost]])
    r, c = find_strays(predicted[lost], P[lost] + touch, w[free], view.S[free], world.unclaimed_density())
    if not len(r):
        return None
    r, c = lost[r], free[c]
    for row, col in zip(r.tolist(), c.tolist(), strict=True):
        d = w[col] - predicted[row] + at.d[slot[row]]
        jump(world, int(slot[row]), d, at, "it was found elsewhere, the likeliest of what is near", view.stamp)
    return Matches(
        np.concatenate([found.rows, r]), np.concatenate([found.cols, c]), np.concatenate([found.chi2, np.zeros(len(r))])
    )


def jump(world: World, slot: int, d: Array, at: Snapshot, reason: str, stamp: float) -> None:
    """A cluster was found where nobody would have predicted it: it is followed from there."""
    cluster, velocity = world.clusters[slot], None
    if at.unseen_s[slot] < 1.5 * world.usual_dt:
        velocity = cluster.velocity + (d - at.d[slot]) / max(at.unseen_s[slot], 1e-6)
    cov, speed = _JUMP_SIGMA_M**2 * np.eye(3), world.config.follow.jump_speed
    cluster.jump(d, cov, speed, velocity, reason, stamp)
