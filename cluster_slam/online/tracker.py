"""The live tracker, to be read like the method section of a paper: one frame in, one update out.

A step takes a frame in, predicts the clusters, matches flowers and points, finds the pose, follows each cluster, keeps
the map, looks after the life of flowers, and, now and then, solves the map and groups the flowers again.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.association.frames import information, point_jacobian
from cluster_slam.config import OnlineConfig
from cluster_slam.geometry import Array, adjoint, inverse, rotate_cov, se3_exp, se3_log, transform
from cluster_slam.graph.incremental import FrameMatches, IncrementalMap
from cluster_slam.online.cluster import ClusterTrack, seen_shape
from cluster_slam.online.flowers import FlowerTable
from cluster_slam.online.grouping import OnlineGrouping
from cluster_slam.online.intake import Intake
from cluster_slam.online.matching import Matches, match
from cluster_slam.online.pose import PoseSolution, solve_pose
from cluster_slam.online.records import Revision, Tracks, Update
from cluster_slam.online.search import Scene, find_moved, with_moved
from cluster_slam.records import (
    BoolArray,
    Calibration,
    Frame,
    IntArray,
    PoseError,
    RejectReason,
    StatedNoise,
)
from tracking.motion import MotionConfig

_NONE = np.zeros(0, dtype=np.int64)
_FEW_LOOKS = 2  # of each of two landmarks, before it is believed that they are never seen together


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """Confirmed flowers (q,) rows and points (q,) that belong together, and the frame's pose."""

    rows: IntArray
    cols: IntArray
    chi2: Array
    pose: PoseSolution


def _no_pose(cov: Array) -> PoseSolution:
    return PoseSolution(np.zeros(6), cov, _NONE, np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0))


def _inverse(cov: Array) -> Array:
    """Information of a well-scaled covariance (n, n)."""
    return np.asarray(np.linalg.inv(cov), np.float64)


def _is_hidden(p: Array, c: Array, radius: float) -> BoolArray:
    """Which points p (k, 3) have one of the seen points c (q, 3) before them, camera frame; flowers have a radius."""
    depth = c[:, 2]
    across = p[:, None, :2] / p[:, None, 2:] - c[None, :, :2] / depth[None, :, None]
    near = (across * across).sum(-1) * depth**2 < radius * radius
    hidden: BoolArray = (near & (depth < p[:, 2:] - radius)).any(1)
    return hidden


class OnlineTracker:
    """Follows clusters of flowers and the camera, frame by frame.

    Parameters
    ----------
    noise : what the source states about its errors.
    T_flange_camera : (4, 4) as measured, where poses are the flange's; None where they are the camera's.
    calibration : a better one, with its covariance; it is then frozen from the start.
    pose_error : "absolute" or "odometry".
    config : the options.
    """

    def __init__(
        self,
        noise: StatedNoise | None = None,
        T_flange_camera: Array | None = None,
        *,
        calibration: Calibration | None = None,
        pose_error: PoseError = "absolute",
        config: OnlineConfig | None = None,
        seed: int = 0,
    ) -> None:
        self.config = config or OnlineConfig()
        self.noise = noise or StatedNoise()
        self.pose_error = pose_error
        self.motion = MotionConfig()
        self.rng = np.random.default_rng(seed)
        self.X0 = T_flange_camera if calibration is None else calibration.T_flange_camera
        self.X = self.X0
        n = self.noise
        rest_of = np.diag(np.repeat([max(n.pose_rotation, 1e-7), max(n.pose_translation, 1e-7)], 3) ** 2)
        self.cov_given = (
            rest_of if self.X0 is None else adjoint(inverse(self.X0)) @ rest_of @ adjoint(inverse(self.X0)).T
        )
        self.cov_X = np.zeros((6, 6))
        prior = None
        if self.X0 is not None and calibration is None:
            self.cov_X = np.diag(np.repeat([n.hand_eye_rotation, n.hand_eye_translation], 3) ** 2)
            prior = _inverse(self.cov_X)
        elif calibration is not None:
            self.cov_X = calibration.cov
        self.map = IncrementalMap(prior, self.config.undo_s)
        self.flowers = FlowerTable()
        self.clusters: list[ClusterTrack] = []
        self.grouping = OnlineGrouping(self.config.grouping)
        self.intake = Intake()
        self.next_cluster = 0
        self.merged: list[tuple[int, int]] = []
        self.low, self.high = np.full(3, np.inf), np.full(3, -np.inf)
        self.first_stamp = self.last_solve = self.last_group = -np.inf
        self.last_stamp = -np.inf
        self.usual_dt = 1.0 / 30.0
        self.is_dirty = False
        self.clutter_rate = self.config.clutter_per_frame
        self.spacing = np.inf
        self.x = np.zeros(6)
        self.T = np.eye(4) if self.X0 is None else self.X0
        self.pose_cov = np.eye(6)
        self.last_given: Array | None = None
        self.n_frames = 0
        self._revisions: list[Revision] = []

    # --- one step

    def step(self, frame: Frame) -> Update:
        """Take in one frame and say what is known now."""
        taken = self.intake.take(frame)
        if isinstance(taken, str):
            return self._refusal(frame, taken)
        self._revisions = []
        stamp, dt = taken.stamp, max(taken.stamp - self.last_stamp, 0.0)
        if self.n_frames == 0:
            self.first_stamp, dt = stamp, 0.0
        elif dt < 3.0 * self.usual_dt:
            self.usual_dt += 0.05 * (dt - self.usual_dt)
        use = np.flatnonzero(taken.usable)
        c, S_c = frame.points[use], frame.covs[use]
        T0, cov0 = self._predicted_pose(frame, dt)
        self._widen_view(c)
        S = rotate_cov(T0[:3, :3], S_c)
        seen = self._associate(T0, cov0, c, S, stamp)
        T = T0 @ se3_exp(seen.pose.z)
        w = transform(T, c)
        self._follow(seen, w, S, stamp)
        self._remember(seen, T0, cov0, c, S, stamp)
        labels, reasons = self._live(seen, T, w, S, c, stamp)
        self.T, self.pose_cov, self.last_given = T, seen.pose.cov, frame.pose
        self.last_stamp = stamp
        self.n_frames += 1
        self._tidy(stamp)
        return self._update(frame, taken.warnings, use, labels, reasons, seen, stamp)

    def _predicted_pose(self, frame: Frame, dt: float) -> tuple[Array, Array]:
        """The camera's pose (4, 4) before the flowers speak, and its covariance (6, 6)."""
        X = np.eye(4) if self.X is None else self.X
        if self.pose_error == "absolute":
            return frame.pose @ X, self.cov_given
        if self.last_given is None:
            return frame.pose @ X, 1e-14 * np.eye(6)
        D = inverse(self.last_given) @ frame.pose
        moved = se3_log(D)
        D = inverse(X) @ D @ X
        A = adjoint(inverse(D))
        return self.T @ D, A @ self.pose_cov @ A.T + self._step_cov(moved, dt, X)

    def _step_cov(self, moved: Array, dt: float, X: Array) -> Array:
        """Covariance (6, 6) of one step of odometry, in the camera's frame; over a gap the way may have been longer."""
        n = self.noise
        times = np.sqrt(max(dt / max(self.usual_dt, 1e-9), 1.0))
        turned, travelled = np.linalg.norm(moved[:3]) * times, np.linalg.norm(moved[3:]) * times
        rotation = np.hypot(n.pose_rotation * times, n.odometry_rotation * turned)
        along = np.hypot(n.pose_translation * times, n.odometry_translation * travelled)
        along = np.hypot(along, rotation * travelled / np.sqrt(3.0))
        cov = np.diag(np.maximum(np.repeat([rotation, along], 3), 1e-7) ** 2)
        A = adjoint(inverse(X))
        return np.asarray(A @ cov @ A.T)

    def _widen_view(self, c: Array) -> None:
        if len(c):
            rays = np.column_stack([c[:, 0] / c[:, 2], c[:, 1] / c[:, 2], c[:, 2]])
            self.low, self.high = np.minimum(self.low, rays.min(0)), np.maximum(self.high, rays.max(0))

    def _in_view(self, T: Array, places: Array, slack: float = 0.02) -> BoolArray:
        p = transform(inverse(T), places)
        z = np.where(p[:, 2] > 1e-6, p[:, 2], 1e-6)
        rays = np.column_stack([p[:, 0] / z, p[:, 1] / z, p[:, 2]])
        margin = np.array([slack, slack, 0.1 * max(self.high[2], 0.0)])
        visible: BoolArray = ((rays > self.low - margin) & (rays < self.high + margin)).all(axis=1)
        return visible

    # --- association

    def _states(self) -> tuple[Array, Array, Array]:
        """Displacements (c, 3), covariances (c, 3, 3) and scales (c,) of all clusters."""
        n = len(self.clusters)
        d, P, scale = np.zeros((n, 3)), np.zeros((n, 3, 3)), np.ones(n)
        for j, cluster in enumerate(self.clusters):
            d[j], P[j] = cluster.displacement
            scale[j] = cluster.scale
        return d, P, scale

    def _anchors(self) -> Array:
        zero = np.zeros(3)
        return np.array([zero if k.anchor is None else k.anchor for k in self.clusters]).reshape(-1, 3)

    def _predict_clusters(self, T: Array, stamp: float) -> None:
        if not self.clusters:
            return
        near = self._in_view(T, self._anchors(), 0.15)
        for cluster, is_near in zip(self.clusters, near, strict=True):
            if is_near:
                cluster.predict(stamp)

    def _expected(self, rows: IntArray) -> Array:
        """Where flowers (k,) should be now (k, 3), by the states of their clusters."""
        d, _, scale = self._states()
        slot, anchor = self.flowers.slot[rows], self._anchors()
        offset = self.flowers.place[rows] - anchor[slot]
        return np.asarray(anchor[slot] + d[slot] + scale[slot][:, None] * offset)

    def _associate(self, T0: Array, cov0: Array, c: Array, S: Array, stamp: float) -> _Seen:
        """Which confirmed flower each point shows, clusters that moved included, and the frame's pose."""
        cfg, table = self.config, self.flowers
        self._predict_clusters(T0, stamp)
        rows = np.flatnonzero(table.confirmed)
        J = point_jacobian(T0[:3, :3], c)
        cov_z = cov0 if self.map.is_frozen else cov0 + self.cov_X
        prior = _inverse(cov_z)
        w = transform(T0, c)
        place_cov = table.cov[rows] + cfg.slack_m**2 * np.eye(3)
        predicted = self._expected(rows)
        _, P, _ = self._states()
        P_f = P[table.slot[rows]] + place_cov
        m = match(predicted, P_f, w, S + J @ cov_z @ np.swapaxes(J, 1, 2), cfg.gate_chi2)
        pose = _no_pose(cov_z)
        if len(m.rows):
            pose = self._pose(m.rows, m.cols, rows, predicted, place_cov, w, S, J, P, prior)
            w = transform(T0 @ se3_exp(pose.z), c)
            m = match(predicted, P_f, w, S + J @ pose.cov @ np.swapaxes(J, 1, 2), cfg.gate_chi2)
        found = self._search_moved(T0, rows, m, predicted, w, S, stamp)
        if found is not None:
            m = found
            predicted = self._expected(rows)
            _, P, _ = self._states()
        if len(m.rows):
            pose = self._pose(m.rows, m.cols, rows, predicted, place_cov, transform(T0, c), S, J, P, prior)
        return _Seen(rows[m.rows], m.cols, m.chi2, pose)

    def _pose(
        self,
        a: IntArray,
        b: IntArray,
        rows: IntArray,
        predicted: Array,
        place_cov: Array,
        w: Array,
        S: Array,
        J: Array,
        P: Array,
        prior: Array,
    ) -> PoseSolution:
        W = information(S[b] + place_cov[a])
        return solve_pose(J[b], predicted[a] - w[b], W, self.flowers.slot[rows[a]], P, prior)

    def _search_moved(
        self, T: Array, rows: IntArray, matches: Matches, predicted: Array, w: Array, S: Array, stamp: float
    ) -> Matches | None:
        """Search for clusters that lost their flowers; those that are found have jumped."""
        table, cfg = self.flowers, self.config.follow
        if not len(rows) or not len(w):
            return None
        d, P, _ = self._states()
        unseen = np.array([max(stamp - k.last, 0.0) for k in self.clusters])
        looked = self._in_view(T, predicted)
        looked[matches.rows] = True
        flowers = np.flatnonzero(looked)
        index = np.full(len(rows), -1)
        index[flowers] = np.arange(len(flowers))
        slot = table.slot[rows[flowers]]
        scene = Scene(table.place[rows[flowers]], slot, w, S, d, P, unseen)
        before = replace(matches, rows=index[matches.rows])
        found = find_moved(scene, before, cfg)
        if not found:
            return None
        for k, moved in found.items():
            if moved.is_jump:
                self._jump(self.clusters[k], moved.d, d[k], unseen[k])
        after = with_moved(before, found, slot, len(w))
        return replace(after, rows=flowers[after.rows])

    def _jump(self, cluster: ClusterTrack, found: Array, predicted: Array, unseen_s: float) -> None:
        """A cluster was found where its filter would not have it: begin again from there."""
        velocity = None
        if cluster.filter is not None and unseen_s < 1.5 * self.usual_dt:
            velocity = cluster.filter.x[3:6] + (found - predicted) / max(unseen_s, 1e-6)
        speed = self.config.follow.jump_speed
        cluster.jump(found, 0.005**2 * np.eye(3), speed, velocity, "it was found elsewhere, by its shape")

    # --- following and mapping

    def _follow(self, seen: _Seen, w: Array, S: Array, stamp: float) -> None:
        """Update each seen cluster's filter with where its flowers stood."""
        table, pose = self.flowers, seen.pose
        slots = table.slot[seen.rows]
        order = np.argsort(slots, kind="stable")
        bounds = np.searchsorted(slots[order], pose.slots)
        for k, slot in enumerate(pose.slots.tolist()):
            cluster = self.clusters[slot]
            mine = order[bounds[k] : (bounds[k + 1] if k + 1 < len(bounds) else len(order))]
            cluster.predict(stamp)
            cluster.awaken(stamp)
            shape = None
            if len(mine) >= 3 and cluster.anchor is not None:
                var = np.trace(S[seen.cols[mine]], axis1=1, axis2=2) / 3.0
                shape = seen_shape(table.place[seen.rows[mine]] - cluster.anchor, w[seen.cols[mine]], var)
            cluster.update(pose.shift[k], pose.shift_cov[k], shape, stamp)
            cluster.last = stamp
            cluster.n += len(mine)

    def _remember(self, seen: _Seen, T0: Array, cov0: Array, c: Array, S: Array, stamp: float) -> None:
        """Put the frame's matches into the map, with how far each cluster may stand from rest."""
        rows, cols, pose = seen.rows, seen.cols, seen.pose
        if not len(rows):
            return
        T = T0 @ se3_exp(pose.z)
        J = point_jacobian(T[:3, :3], c[cols])
        slot = self.flowers.slot[rows]
        # Trembling that lasts for a while counts once, not once a frame.
        once = np.sqrt(max(2.0 * self.motion.tremble_s / max(self.usual_dt, 1e-3), 1.0))
        reach = np.array([k.reach for k in self.clusters])
        W = information(S[cols] + self.config.slack_m**2 * np.eye(3)) * pose.weight[:, None, None]
        self.map.add(
            FrameMatches(
                stamp=stamp,
                ids=self.flowers.ids[rows],
                points=transform(T, c[cols]) - (0.0 if self.X is None else J @ self.x),
                J=J,
                J_x=J,
                W=W,
                cluster=slot,
                sway_var=(reach[slot] * once) ** 2,
                z=pose.z,
                prior=_inverse(cov0),
            )
        )

    # --- life of flowers

    def _live(self, seen: _Seen, T: Array, w: Array, S: Array, c: Array, stamp: float) -> tuple[IntArray, IntArray]:
        """Tentative flowers matched, new ones born, misses counted, the sure confirmed: id or -1 of each point."""
        table = self.flowers
        row_of = np.full(len(w), -1, dtype=np.int64)
        row_of[seen.cols] = seen.rows
        left = np.flatnonzero(row_of < 0)
        tentative = np.flatnonzero(~table.confirmed)
        d, P, _ = self._states()
        if len(left) and len(tentative):
            at = table.place[tentative] + d[table.slot[tentative]]
            P_t = table.cov[tentative] + P[table.slot[tentative]] + self.config.slack_m**2 * np.eye(3)
            J = point_jacobian(T[:3, :3], c[left])
            m = match(at, P_t, w[left], S[left] + J @ seen.pose.cov @ np.swapaxes(J, 1, 2), self.config.gate_chi2)
            a, b = m.rows, m.cols
            row_of[left[b]] = tentative[a]
            self._refine_tentative(tentative[a], w[left[b]] - d[table.slot[tentative[a]]], S[left[b]])
        hit = row_of[row_of >= 0]
        table.hits[hit] = (table.hits[hit] << 1) | 1
        table.vain[hit] = 0
        table.n[hit] += 1
        table.last[hit] = stamp
        table.looks[hit] = 0.998 * table.looks[hit] + 1.0
        table.found[hit] = 0.998 * table.found[hit] + 1.0
        self._count_misses(T, w, c, hit)
        self._note_motion(seen, w, S, stamp)
        reasons = np.where(row_of >= 0, int(RejectReason.ACCEPTED), int(RejectReason.POSITION_GATE))
        born = self._births(row_of, seen, w, S, T, c, stamp, reasons)
        labels = np.full(len(w), -1, dtype=np.int64)
        shown = row_of >= 0
        young = shown & (table.n[row_of] < 2)
        if len(born) <= 2.0 * self.clutter_rate:
            shown &= ~young
        reasons[young & ~shown] = int(RejectReason.UNCONFIRMED)
        labels[shown] = table.ids[row_of[shown]]
        self._confirm(stamp)
        return labels, reasons

    def _refine_tentative(self, rows: IntArray, points: Array, S: Array) -> None:
        table = self.flowers
        P = table.cov[rows] + self.config.slack_m**2 * np.eye(3)
        gain = P @ information(P + S)
        table.place[rows] += (gain @ (points - table.place[rows])[..., None])[..., 0]
        P = P - gain @ P
        table.cov[rows] = 0.5 * (P + np.swapaxes(P, 1, 2))

    def _count_misses(self, T: Array, w: Array, c: Array, hit: IntArray) -> None:
        """A miss counts where the flower was in view, one of its cluster was seen, and nothing stood before it."""
        table = self.flowers
        if not len(table) or not len(w):
            return
        expected = self._expected(np.arange(len(table)))
        missed = self._in_view(T, expected, -0.02)
        missed[hit] = False
        witness = np.zeros(len(self.clusters), dtype=bool)
        witness[table.slot[hit]] = True
        alone = np.bincount(table.slot, minlength=len(self.clusters)) < 2
        candidates = np.flatnonzero(missed & (witness[table.slot] | alone[table.slot] | ~table.confirmed))
        if not len(candidates):
            return
        p = transform(inverse(T), expected[candidates])
        clear = ~_is_hidden(p, c, 0.3 * min(self.spacing, 0.1))
        rows = candidates[clear]
        table.hits[rows] <<= 1
        table.vain[rows] += 1
        table.looks[rows] = 0.998 * table.looks[rows] + 1.0
        table.found[rows] *= 0.998

    def _note_motion(self, seen: _Seen, w: Array, S: Array, stamp: float) -> None:
        del stamp
        motion, table = self.grouping.motion, self.flowers
        motion.resize(None, len(table))
        if len(seen.rows):
            u = w[seen.cols] - table.place[seen.rows]
            var = np.trace(S[seen.cols], axis1=1, axis2=2) / 3.0 + np.trace(seen.pose.cov[3:, 3:]) / 3.0
            motion.observe(seen.rows, u, var)
            if self.n_frames < 100 or self.n_frames % 3 == 0:
                self.grouping.looks.append(table.ids[seen.rows])

    def _births(
        self,
        row_of: IntArray,
        seen: _Seen,
        w: Array,
        S: Array,
        T: Array,
        c: Array,
        stamp: float,
        reasons: IntArray,
    ) -> IntArray:
        """Points that nobody claims begin tentative flowers, in the cluster next to them or in one of their own."""
        left = np.flatnonzero(row_of < 0)
        if not len(left):
            return left
        known = np.flatnonzero(row_of >= 0)
        if len(known):
            gap = w[left][:, None] - w[known][None]
            cov = S[left][:, None] + S[known][None]
            chi2 = np.einsum("abi,abij,abj->ab", gap, information(cov), gap)
            doubled = (chi2 < 6.25).any(1)
            reasons[left[doubled]] = int(RejectReason.TAKEN)
            left = left[~doubled]
        if not len(left):
            return left
        self._note_spacing(w, S)
        slot = self._slots_for(w, left, known, row_of, stamp)
        d, _, _ = self._states()
        J = point_jacobian(T[:3, :3], c[left])
        cov = S[left] + J @ seen.pose.cov @ np.swapaxes(J, 1, 2)
        rows = self.flowers.add(w[left] - d[slot], cov, J, slot, stamp)
        row_of[left] = rows
        self.grouping.motion.resize(None, len(self.flowers))
        self._place_anchors(np.unique(slot))
        return left

    def _note_spacing(self, w: Array, S: Array) -> None:
        """How close flowers stand: a low running quantile of the distance to the nearest of the same frame."""
        if len(w) < 2:
            return
        gap = np.linalg.norm(w[:, None] - w[None], axis=-1)
        np.fill_diagonal(gap, np.inf)
        nearest = gap.min(1)
        low = float(np.quantile(nearest, 0.1))
        self.spacing = low if not np.isfinite(self.spacing) else self.spacing + 0.05 * (low - self.spacing)

    def _slots_for(self, w: Array, left: IntArray, known: IntArray, row_of: IntArray, stamp: float) -> IntArray:
        """Clusters (k,) for new flowers at ``w[left]``; new clusters are made where none is near."""
        table, link = self.flowers, self.grouping.link
        slot = np.full(len(left), -1, dtype=np.int64)
        if link > 0.0:
            if len(known):
                gap = np.linalg.norm(w[left][:, None] - w[known][None], axis=-1)
                near = gap.min(1) < link
                slot[near] = table.slot[row_of[known[gap.argmin(1)]]][near]
            if len(table):
                gap = np.linalg.norm(w[left][:, None] - table.place[None], axis=-1)
                near = (slot < 0) & (gap.min(1) < link)
                slot[near] = table.slot[gap.argmin(1)][near]
        free = np.flatnonzero(slot < 0)
        if len(free):
            label = self.grouping.group_new(w[left[free]], self._view_volume())
            for k in range(int(label.max()) + 1):
                self.clusters.append(ClusterTrack(self.next_cluster, stamp, self.motion))
                self.next_cluster += 1
                slot[free[label == k]] = len(self.clusters) - 1
        return slot

    def _view_volume(self) -> float:
        if not np.isfinite(self.low).all():
            return 1.0
        depth = 0.5 * (self.low[2] + self.high[2])
        width, height = np.maximum(self.high - self.low, 0.1)[:2] * depth
        return float(width * height * depth)

    def _confirm(self, stamp: float) -> None:
        """M of N: tentative flowers that were seen often enough become landmarks."""
        table, cfg = self.flowers, self.config
        window = (1 << cfg.confirm_of) - 1
        recent = table.hits & window
        count = np.array([int(b).bit_count() for b in recent.tolist()], dtype=np.int64)
        ripe = np.flatnonzero(~table.confirmed & (count >= cfg.confirm_hits))
        for row in ripe.tolist():
            table.confirmed[row] = True
            cluster = self.clusters[int(table.slot[row])]
            cov = table.cov[row] + (cluster.reach**2 + self.config.slack_m**2) * np.eye(3)
            lever = table.lever[row]
            self.map.include(int(table.ids[row]), table.place[row] - lever @ self.x, cov, lever)
            if cluster.state == "tentative":
                cluster.state = "confirmed"
                self._say("confirmed", "cluster", cluster.id, cluster.id, "its flowers were seen again")
            cluster.awaken(stamp)
            self.is_dirty = True

    def _place_anchors(self, slots: IntArray) -> None:
        """Centroids at rest of these clusters, from their flowers: the confirmed ones, where there are any."""
        table = self.flowers
        for slot in slots.tolist():
            mine = np.flatnonzero(table.slot == slot)
            sure = mine[table.confirmed[mine]]
            self.clusters[slot].place(table.place[sure if len(sure) else mine].mean(0))

    # --- now and then

    def _tidy(self, stamp: float) -> None:
        """Forget what was none, solve the map, group again, say who is lost."""
        self._forget()
        cfg = self.config
        fresh = self.is_dirty and stamp - self.last_group >= min(cfg.keyframe_s, cfg.regroup_s)
        if stamp - self.last_solve >= cfg.keyframe_s and len(self.map):
            self._solve_map(stamp)
            self._merge_doubles()
        if fresh or stamp - self.last_group >= cfg.regroup_s:
            self._regroup(stamp)
        for cluster in self.clusters:
            if cluster.state == "confirmed" and stamp - cluster.last > cfg.lost_s:
                cluster.state = "lost"
                self._say("lost", "cluster", cluster.id, cluster.id, f"not seen for {cfg.lost_s:g} s")
            elif cluster.state == "lost" and stamp - cluster.last <= cfg.lost_s:
                cluster.state = "confirmed"
                self._say("returned", "cluster", cluster.id, cluster.id, "seen again")

    def _forget(self) -> None:
        table, cfg = self.flowers, self.config
        if not len(table):
            return
        gone = ~table.confirmed & (table.vain >= np.where(table.n <= 1, cfg.confirm_of - 2, cfg.forget_looks))
        n_born_in_vain = int((gone & (table.n <= 2)).sum())
        self.clutter_rate += 0.02 * (n_born_in_vain - self.clutter_rate)
        share = table.found / np.maximum(table.looks, 1.0)
        sure = table.confirmed & (table.looks > 15)
        if sure.any():
            usual = float(np.median(share[sure]))
            ghost = table.confirmed & (table.looks > 15) & (share < 0.3 * usual) & (table.vain > 4)
            for row in np.flatnonzero(ghost).tolist():
                self.map.remove(int(table.ids[row]))
                self._say("forgotten", "flower", int(table.ids[row]), -1, "it was looked for in vain")
            gone |= ghost
        if gone.any():
            slots = np.unique(table.slot[gone])
            table.keep(~gone)
            self.grouping.motion.resize(~gone, len(table))
            self._drop_empty(slots)

    def _drop_empty(self, touched: IntArray) -> None:
        """Remove clusters without flowers; move the centroids of the others that lost one."""
        table = self.flowers
        size = np.bincount(table.slot, minlength=len(self.clusters))
        self._place_anchors(touched[size[touched] > 0])
        if (size == 0).any():
            number = np.cumsum(size > 0) - 1
            table.slot = number[table.slot]
            self.clusters = [k for k, n in zip(self.clusters, size, strict=True) if n]

    def _solve_map(self, stamp: float) -> None:
        x, places, cov = self.map.solve()
        table = self.flowers
        order = np.argsort(self.map.ids)
        rows = np.flatnonzero(table.confirmed)
        at = order[np.searchsorted(self.map.ids[order], table.ids[rows])]
        table.place[rows] = places[at]
        blocks = cov[6:, 6:].reshape(len(places), 3, len(places), 3)
        table.cov[rows] = blocks[at, :, at]
        self.last_solve = stamp
        self._place_anchors(np.unique(table.slot))
        if self.X0 is not None and not self.map.is_frozen:
            self.x, self.cov_X = x, cov[:6, :6]
            self.X = self.X0 @ se3_exp(x)
            if stamp - self.first_stamp > self.config.calibrate_s:
                self.map.freeze(x)
                self._say("calibrated", "hand_eye", 0, 0, "estimated from the flowers, frozen from now on")

    def _merge_doubles(self) -> None:
        """Two landmarks at one place that are never seen in one frame are one flower: the older id lives on."""
        table = self.flowers
        rows = np.flatnonzero(table.confirmed)
        if len(rows) < 2 or not np.isfinite(self.spacing):
            return
        sigma = np.sqrt(np.trace(table.cov[rows], axis1=1, axis2=2) / 3.0)
        gap = np.linalg.norm(table.place[rows][:, None] - table.place[rows][None], axis=-1)
        radius = np.minimum(0.6 * self.spacing, np.maximum(0.3 * self.spacing, 3.0 * (sigma[:, None] + sigma[None])))
        close = np.argwhere(np.triu(gap < radius, 1))
        if not len(close):
            return
        gone = np.zeros(len(table), dtype=bool)
        for i, j in close.tolist():
            a, b = rows[i], rows[j]
            if gone[a] or gone[b]:
                continue
            ids = table.ids[[a, b]]
            both = [np.isin(ids, look) for look in self.grouping.looks]
            n_both = sum(bool(s.all()) for s in both)
            n_each = [sum(bool(s[k]) for s in both) for k in (0, 1)]
            if min(n_each) < _FEW_LOOKS or n_both > 0.15 * min(n_each):
                continue
            stays, goes = (a, b) if table.ids[a] < table.ids[b] else (b, a)
            self.map.merge(int(table.ids[goes]), int(table.ids[stays]))
            table.n[stays] += table.n[goes]
            self.merged.append((int(table.ids[goes]), int(table.ids[stays])))
            self._say("merged", "flower", int(table.ids[goes]), int(table.ids[stays]), "one place, never seen together")
            gone[goes] = True
        if gone.any():
            slots = np.unique(table.slot[gone])
            table.keep(~gone)
            self.grouping.motion.resize(~gone, len(table))
            self._drop_empty(slots)

    def _regroup(self, stamp: float) -> None:
        """Group all flowers again; each group keeps the id of the cluster that most of it came from."""
        table = self.flowers
        self.last_group, self.is_dirty = stamp, False
        rows = np.flatnonzero(table.confirmed)
        if len(rows) < 2:
            return
        old = table.slot[rows]
        label = self.grouping.group(table.ids[rows], rows, table.place[rows], old, self._view_volume(), self.rng)
        weight = np.zeros((int(label.max()) + 1, len(self.clusters)))
        np.add.at(weight, (label, old), 1.0)
        if ((weight > 0).sum(0) <= 1).all() and ((weight > 0).sum(1) <= 1).all():
            return
        self._rename(rows, label, weight, stamp)

    def _rename(self, rows: IntArray, label: IntArray, weight: Array, stamp: float) -> None:
        table = self.flowers
        slot_of = np.full(len(weight), -1, dtype=np.int64)
        taken = np.zeros(len(self.clusters), dtype=bool)
        age = np.array([k.first for k in self.clusters])
        order = sorted(
            ((-weight[g, s], age[s], g, s) for g, s in np.argwhere(weight > 0).tolist()), key=lambda t: t[:2]
        )
        for _, _, g, s in order:
            if slot_of[g] < 0 and not taken[s]:
                slot_of[g], taken[s] = s, True
        for g in np.flatnonzero(slot_of < 0).tolist():
            parent = self.clusters[int(weight[g].argmax())]
            child = ClusterTrack(self.next_cluster, parent.first, self.motion)
            child.last, child.n, child.state = parent.last, 0, "confirmed"
            self.next_cluster += 1
            self.clusters.append(child)
            slot_of[g] = len(self.clusters) - 1
            self._say("moved", "cluster", parent.id, child.id, "its flowers do not belong together")
        before = table.slot.copy()
        table.slot[rows] = slot_of[label]
        for s in np.unique(before[rows]).tolist():
            if not (table.slot[rows] == s).any():
                to = np.bincount(table.slot[rows[before[rows] == s]]).argmax()
                table.slot[(before == s) & ~table.confirmed] = to
                self.merged_cluster(s, int(to))
        changed = np.unique(np.concatenate([before, table.slot]))
        size = np.bincount(table.slot, minlength=len(self.clusters))
        self._place_anchors(changed[size[changed] > 0])
        for k in self.clusters:
            if k.state != "tentative":
                k.awaken(stamp)
        self._drop_empty(_NONE)

    def merged_cluster(self, goes: int, stays: int) -> None:
        a, b = self.clusters[goes], self.clusters[stays]
        b.first, b.n = min(a.first, b.first), a.n + b.n
        self._say("merged", "cluster", a.id, b.id, "their flowers stand as one")

    # --- what is said

    def _say(self, kind: str, subject: str, before: int, after: int, reason: str) -> None:
        self._revisions.append(Revision(kind, subject, before, after, reason))  # type: ignore[arg-type]

    def tracks(self, seen: IntArray | None = None) -> Tracks:
        """All living clusters as they are now; ``seen`` (c,) flowers of each in this frame."""
        n = len(self.clusters)
        anchors = self._anchors()
        positions, velocities, covs = anchors.copy(), np.zeros((n, 3)), np.zeros((n, 6, 6))
        for j, k in enumerate(self.clusters):
            if k.filter is not None:
                positions[j], velocities[j], covs[j] = k.filter.x[:3], k.filter.x[3:6], k.filter.P[:6, :6]
            else:
                covs[j] = self.motion.tremble_m**2 * np.eye(6)
        return Tracks(
            ids=np.array([k.id for k in self.clusters], dtype=np.int64),
            positions=positions,
            velocities=velocities,
            covs=covs,
            scales=np.array([k.scale for k in self.clusters]),
            states=tuple(k.state for k in self.clusters),
            motions=tuple(k.kind.value for k in self.clusters),
            reasons=tuple(k.why for k in self.clusters),
            n_flowers=np.bincount(self.flowers.slot, minlength=n),
            seen=np.zeros(n, dtype=np.int64) if seen is None else seen,
        )

    def _update(
        self,
        frame: Frame,
        warnings: tuple[str, ...],
        use: IntArray,
        labels: IntArray,
        reasons: IntArray,
        seen: _Seen,
        stamp: float,
    ) -> Update:
        del stamp
        q = len(frame.points)
        flower_ids, cluster_ids = np.full(q, -1, dtype=np.int64), np.full(q, -1, dtype=np.int64)
        all_reasons, nis = np.full(q, int(RejectReason.OUTLIER)), np.full(q, np.nan)
        flower_ids[use], cluster_ids[use] = self._known_now(labels)
        all_reasons[use] = reasons
        nis[use[seen.cols]] = seen.chi2
        return Update(
            stamp=frame.stamp,
            is_accepted=True,
            reason="",
            T_world_camera=self.T,
            pose_cov=self.pose_cov,
            flower_ids=flower_ids,
            cluster_ids=cluster_ids,
            reasons=all_reasons,
            nis=nis,
            tracks=self.tracks(self._seen_of(flower_ids)),
            revisions=tuple(self._revisions),
            warnings=warnings,
        )

    def _known_now(self, ids: IntArray) -> tuple[IntArray, IntArray]:
        """Flower and cluster ids (q,) of labels (q,), after all that was revised in this frame."""
        table = self.flowers
        into = dict(self.merged[-50:])
        ids = np.array([into.get(i, i) for i in ids.tolist()], dtype=np.int64)
        order = np.argsort(table.ids)
        if not len(order):
            return np.full(len(ids), -1, dtype=np.int64), np.full(len(ids), -1, dtype=np.int64)
        at = order[np.minimum(np.searchsorted(table.ids[order], ids), len(order) - 1)]
        alive = table.ids[at] == ids
        names = np.array([k.id for k in self.clusters], dtype=np.int64)
        return np.where(alive, ids, -1), np.where(alive, names[table.slot[at]], -1)

    def _seen_of(self, flower_ids: IntArray) -> IntArray:
        """How many flowers of each cluster (c,) are among these ids."""
        seen = np.isin(self.flowers.ids, flower_ids[flower_ids >= 0])
        return np.bincount(self.flowers.slot[seen], minlength=len(self.clusters))

    def joint_cov(self, rows: IntArray) -> Array:
        """Joint covariance (3 k, 3 k) of the places of confirmed flowers, with what the hand-eye transform adds."""
        _, _, cov = self.map.solve()
        order = np.argsort(self.map.ids)
        at = order[np.searchsorted(self.map.ids[order], self.flowers.ids[rows])]
        index = (6 + 3 * at[:, None] + np.arange(3)).ravel()
        joint = cov[np.ix_(index, index)]
        if self.map.is_frozen and self.X is not None:
            lever = self.flowers.lever[rows].reshape(-1, 6)
            joint = joint + lever @ self.cov_X @ lever.T
        return np.asarray(0.5 * (joint + joint.T) + 1e-14 * np.eye(len(joint)))

    def estimated_noise(self) -> dict[str, float]:
        """What is known of the errors; keys as in ``[noise]``."""
        return {}

    def _refusal(self, frame: Frame, reason: str) -> Update:
        q = len(frame.points)
        return Update(
            stamp=frame.stamp,
            is_accepted=False,
            reason=reason,
            T_world_camera=self.T,
            pose_cov=self.pose_cov,
            flower_ids=np.full(q, -1, dtype=np.int64),
            cluster_ids=np.full(q, -1, dtype=np.int64),
            reasons=np.full(q, int(RejectReason.OUTLIER)),
            nis=np.full(q, np.nan),
            tracks=self.tracks(),
            revisions=(),
            warnings=(f"frame refused: {reason}",),
        )
