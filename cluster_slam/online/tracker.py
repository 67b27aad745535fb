"""The live tracker, to be read like the method section of a paper: one frame in, one update out.

A step takes a frame in, predicts the clusters, matches flowers and points, finds the pose, follows each cluster, keeps
the map, looks after the life of flowers, and, now and then, solves the map and groups the flowers again.
"""

from __future__ import annotations

import numpy as np

from cluster_slam.config import OnlineConfig
from cluster_slam.geometry import Array, adjoint, inverse, rotate_cov, se3_exp, se3_log, transform
from cluster_slam.online.associate import Seen, View, associate
from cluster_slam.online.follow import follow, remember
from cluster_slam.online.intake import Intake
from cluster_slam.online.life import forget, live
from cluster_slam.online.odometry import diagonal, step_cov
from cluster_slam.online.records import Tracks, Update
from cluster_slam.online.tracks import tracks_of
from cluster_slam.online.upkeep import carry_on, merge_doubles, regroup, solve_all, solve_near, tell_lost
from cluster_slam.online.watch import AstrayWatch, MountWatch, NoiseWatch
from cluster_slam.online.world import World
from cluster_slam.records import Calibration, Frame, IntArray, PoseError, RejectReason, StatedNoise
from tracking.ukf import prepare

_LEAST_M = 1e-5  # no point is known better: numbers must stay numbers
_KNOWN = 5  # observations of a flower whose innovations say something of the noise
_FIXED = 4  # flowers that fix a pose
_ALL_S = 5.0  # the whole map is solved this often, once the hand-eye transform is frozen


class OnlineTracker:
    """Follows clusters of flowers and the camera, frame by frame.

    Parameters
    ----------
    noise : what the source states about its errors.
    T_flange_camera : (4, 4) as measured, where poses are the flange's; None where they are the camera's.
    calibration : a better one, with its covariance; it is then frozen from the start.
    pose_error : "absolute" or "odometry".
    config : the options.
    seed : of what is random (K-means only).
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
        prepare()
        self.config = config or OnlineConfig()
        self.noise = noise or StatedNoise()
        self.pose_error = pose_error
        self.X0 = T_flange_camera if calibration is None else calibration.T_flange_camera
        self.X = self.X0
        n, self.cov_X, information = self.noise, np.zeros((6, 6)), None
        if calibration is not None:
            self.cov_X = calibration.cov
        elif self.X0 is not None:
            sigma = np.maximum(np.repeat([n.hand_eye_rotation, n.hand_eye_translation], 3), 1e-7)
            self.cov_X, information = np.diag(sigma**2), np.diag(1.0 / sigma**2)
        self.world = World(self.config, information, seed)
        self.cov_given = self._in_camera(diagonal(n.pose_rotation, n.pose_translation))
        self.intake = Intake()
        self.noise_watch, self.mount_watch = NoiseWatch(), MountWatch(self.cov_given)
        self.astray_watch = AstrayWatch()
        self.first_stamp = self.last_stamp = self.last_solve = self.last_all = self.last_group = -np.inf
        self.T = np.eye(4) if self.X0 is None else self.X0
        self.pose_cov = np.eye(6)
        self.last_given: Array | None = None
        self.last_step_cov = np.zeros((6, 6))
        self.n_frames = 0

    def step(self, frame: Frame) -> Update:
        """Take in one frame and say what is known now."""
        self.world.revisions = []
        taken = self.intake.take(frame)
        if isinstance(taken, str):
            return self._refusal(frame, taken)
        dt = self._note_time(taken.stamp)
        use = np.flatnonzero(taken.usable)
        view = self._view(frame, use, taken.stamp, dt)
        self.world.widen_view(view.c)
        seen, view = associate(self.world, view, np.zeros((6, 6)) if self.world.map.is_frozen else self.cov_X)
        T = view.T @ se3_exp(seen.pose.z)
        w = transform(T, view.c)
        follow(self.world, seen, w, view.S, taken.stamp)
        remember(self.world, seen, view)
        labels, reasons = live(self.world, seen, view, T, w)
        self.T, self.pose_cov, self.last_given = T, seen.pose.cov, frame.pose
        self.n_frames += 1
        warnings = (*taken.warnings, *self._watch(seen, taken.stamp))
        self._tidy(taken.stamp)
        return self._update(frame, warnings, use, labels, reasons, seen)

    def _watch(self, seen: Seen, stamp: float) -> tuple[str, ...]:
        """Learn from the residuals how large errors are, and whether the camera has moved on its mount."""
        self.noise_watch.see(seen.chi2[self.world.flowers.n[seen.rows] >= _KNOWN])
        if self.pose_error == "odometry":
            first = self.world.flowers.first[seen.rows]
            self.astray_watch.see(stamp, first, self.last_step_cov, self.world.view_depth())
        is_frozen = self.X0 is not None and self.world.map.is_frozen and self.pose_error == "absolute"
        if not (is_frozen and len(seen.rows) >= _FIXED):
            return ()
        warning = self.mount_watch.see(stamp, seen.pose.z)
        return (warning,) if warning else ()

    def _note_time(self, stamp: float) -> float:
        """Seconds since the last frame."""
        dt = 0.0 if self.n_frames == 0 else stamp - self.last_stamp
        if self.n_frames == 0:
            self.first_stamp = stamp
        elif self.n_frames == 1:
            self.world.usual_dt = dt
        elif dt < 3.0 * self.world.usual_dt:
            self.world.usual_dt += 0.05 * (dt - self.world.usual_dt)
        self.last_stamp = stamp
        return dt

    def _view(self, frame: Frame, use: IntArray, stamp: float, dt: float) -> View:
        """The frame's usable points, with the camera's pose as it is known before they speak."""
        T, cov = self._predicted_pose(frame, dt)
        stated = 0.5 * (frame.covs[use] + np.swapaxes(frame.covs[use], 1, 2))
        self.world.depth_sums.add(frame.points[use], stated)
        S = rotate_cov(T[:3, :3], self.noise_watch.factor * stated) + _LEAST_M**2 * np.eye(3)
        return View(T, cov, frame.points[use], S, stamp, self.n_frames)

    def _predicted_pose(self, frame: Frame, dt: float) -> tuple[Array, Array]:
        X = np.eye(4) if self.X is None else self.X
        if self.pose_error == "absolute":
            return frame.pose @ X, self.cov_given
        if self.last_given is None:
            return frame.pose @ X, 1e-14 * np.eye(6)
        step = inverse(self.last_given) @ frame.pose
        D = inverse(X) @ step @ X
        back = adjoint(inverse(D))
        gap = max(dt / max(self.world.usual_dt, 1e-9), 1.0)
        self.last_step_cov = self._in_camera(step_cov(self.noise, se3_log(step), gap))
        return self.T @ D, back @ self.pose_cov @ back.T + self.last_step_cov

    def _in_camera(self, cov: Array) -> Array:
        """A covariance (6, 6) of the given poses, moved into the camera's frame."""
        if self.X0 is None:
            return cov
        A = adjoint(inverse(self.X0))
        return np.asarray(A @ cov @ A.T)

    def _tidy(self, stamp: float) -> None:
        """Forget what was none, solve the map, group again, say who is lost."""
        world, config = self.world, self.config
        forget(world)
        patience = config.keyframe_s if world.grouping.is_stale else config.regroup_s
        if len(world.map) and stamp - self.last_solve >= config.keyframe_s:
            self._solve(stamp)
            merge_doubles(world)
            if world.usual_dt < 0.5 * config.keyframe_s:  # frames come quickly: none shall be late
                tell_lost(world, stamp)
                return
        if world.grouping.round is not None:
            carry_on(world, stamp)
        elif stamp - self.last_group >= patience:
            regroup(world, stamp, self.last_group)
            self.last_group = stamp
        tell_lost(world, stamp)

    def _solve(self, stamp: float) -> None:
        """The map: all of it, or what was seen lately."""
        if not self.world.map.is_frozen:
            self._calibrate(stamp)
        elif stamp - self.last_all >= _ALL_S:
            solve_all(self.world)
            self.last_all = stamp
        else:
            solve_near(self.world, stamp, self.last_solve)
        self.last_solve = stamp

    def _calibrate(self, stamp: float) -> None:
        """The hand-eye transform is one more unknown of the map, until it has been estimated for long enough."""
        self.cov_X = solve_all(self.world)
        if self.X0 is not None:
            self.X = self.X0 @ se3_exp(self.world.x)
        turn, shift = (float(np.sqrt(np.trace(self.cov_X[k : k + 3, k : k + 3]))) for k in (0, 3))
        is_known = turn < self.config.calibrated_rad and shift < self.config.calibrated_m
        spent = stamp - self.first_stamp
        if spent > self.config.calibrate_s and (is_known or spent > self.config.calibrate_most_s):
            self.world.map.freeze(self.world.x)
            self.world.say("calibrated", "hand_eye", 0, 0, "estimated from the flowers, frozen from now on")

    # --- what is said

    def tracks(self, flower_ids: IntArray | None = None) -> Tracks:
        """All living clusters as they are now; ``flower_ids`` are those seen in this frame."""
        return tracks_of(self.world, self.last_stamp, flower_ids)

    def _update(
        self,
        frame: Frame,
        warnings: tuple[str, ...],
        use: IntArray,
        labels: IntArray,
        reasons: IntArray,
        seen: Seen,
    ) -> Update:
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
            tracks=self.tracks(flower_ids),
            revisions=tuple(self.world.revisions),
            warnings=warnings,
        )

    def _known_now(self, ids: IntArray) -> tuple[IntArray, IntArray]:
        """Flower and cluster ids (q,) of labels (q,), after all that was revised in this frame."""
        table = self.world.flowers
        into = {r.before: r.after for r in self.world.revisions if r.kind == "merged" and r.subject == "flower"}
        ids = np.array([into.get(i, i) for i in ids.tolist()], dtype=np.int64)
        if not len(table):
            return np.full(len(ids), -1), np.full(len(ids), -1)
        order = np.argsort(table.ids)
        at = order[np.minimum(np.searchsorted(table.ids[order], ids), len(order) - 1)]
        alive = table.ids[at] == ids
        return np.where(alive, ids, -1), np.where(alive, self.world.names()[table.slot[at]], -1)

    def joint_cov(self, rows: IntArray) -> Array:
        """Joint covariance (3 k, 3 k) of the places of confirmed flowers.

        With what the hand-eye transform adds, and what all flowers of a cluster have in common that was hardly seen at
        rest.
        """
        _, _, cov = self.world.map.solve()
        at = self.world.map.rows(self.world.flowers.ids[rows])
        index = (6 + 3 * at[:, None] + np.arange(3)).ravel()
        joint = cov[np.ix_(index, index)]
        if self.world.map.is_frozen and self.X is not None:
            lever = self.world.flowers.lever[rows].reshape(-1, 6)
            joint = joint + lever @ self.cov_X @ lever.T
        slot = self.world.flowers.slot[rows]
        doubt = np.array([cluster.doubt for cluster in self.world.clusters])[slot]
        common = np.where(slot[:, None] == slot, doubt[:, None] * doubt, 0.0)
        joint = joint + np.kron(common, np.eye(3))
        return np.asarray(0.5 * (joint + joint.T) + 1e-14 * np.eye(len(joint)))

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
