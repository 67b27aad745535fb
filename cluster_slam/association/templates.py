"""Clusters followed as templates through sway: each is a rigid set of flowers with one displacement of its own.

The state of cluster j is its displacement from rest and its velocity, (d, v), a noisy spring. In every frame all
flowers in view and all points are assigned one to one, the frame's pose error is found and taken away, and each
cluster's state is updated with all its matched flowers at once. A cluster that loses its flowers is searched for.

A cluster that was not seen for some time is forgotten, so what is known of a frame comes from the moments just before
(or, followed backwards, just after). The session is therefore cut into stretches that are followed at the same time, in
both directions, each with a run-up that is thrown away.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.frames import Frames, chi2_and_log_det, field_of_view, information, point_jacobian
from cluster_slam.association.lanes import Lanes, assign, near_pairs, ranges, sums
from cluster_slam.association.lost import Lost
from cluster_slam.association.pose_correction import solve_pose_corrections
from cluster_slam.association.searching import find_lost
from cluster_slam.association.springs import REST_SIGMA_M, Springs
from cluster_slam.config import TemplateConfig
from cluster_slam.geometry import Array, rotate_cov, se3_exp, transform
from cluster_slam.records import BoolArray, IntArray

_RUN_UP = 1.5  # times what an unseen cluster is remembered: of a stretch's run-up


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """``landmark`` (m,) of each sorted observation or -1, and for each frame and cluster the score (n, c)."""

    landmark: IntArray
    score: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Look:
    """What the active lanes see at one step, flat: p points and f flowers in view, both sorted by lane."""

    lane: IntArray  # (a,) the active ones
    frame: IntArray  # (a,)
    row: IntArray  # (p,) of the observations
    point_lane: IntArray  # (p,) 0..a-1
    flower: IntArray  # (f,) of the landmarks
    flower_lane: IntArray  # (f,) 0..a-1
    owner: IntArray  # (f,) cluster of each flower, over all lanes


class Follower:
    """Follows clusters with known rest places through a session, forwards and backwards."""

    def __init__(
        self,
        frames: Frames,
        T: Array,
        cov_pose: Array,
        places: Array,
        cluster: IntArray,
        clutter_density: float,
        config: TemplateConfig,
    ) -> None:
        """Camera poses T (n, 4, 4) with (6, 6) each, rest places (l, 3) and the cluster 0..c-1 (l,) of each.

        ``clutter_density``: false detections a frame and m^3.
        """
        self.frames, self.T, self.config = frames, T, config
        self.log_clutter = float(np.log(clutter_density))
        self.places, self.cluster = places, cluster
        self.n_clusters = int(cluster.max(initial=-1)) + 1
        self.stand_alone = self.n_clusters == len(places)
        self.information_pose: Array = np.asarray(np.linalg.inv(cov_pose + 1e-18 * np.eye(6)), dtype=np.float64)
        self.low, self.high = field_of_view(frames)
        R = T[frames.frame, :3, :3]
        self.world_cov = rotate_cov(R, frames.covs)
        J = point_jacobian(R, frames.points)
        self.cov_of_pose = J @ cov_pose @ np.swapaxes(J, -1, -2)
        # what stands alone does not swing back to its place: how far off it was seen last is remembered for as long
        # as it is seen
        run_up_s = np.inf if self.stand_alone else _RUN_UP * config.forget_s
        self.lanes = Lanes.of(frames.stamps, run_up_s, both_ways=True)
        self.springs = Springs(len(self.lanes.first), self.n_clusters, config)

    def run(self) -> tuple[Followed, Followed]:
        """Forwards and backwards."""
        m, n = len(self.frames), self.frames.n_frames
        self.landmark = np.full((2, m), -1, dtype=np.int64)
        self.score = np.zeros((2, n, self.n_clusters))
        stamps, lanes = self.frames.stamps, self.lanes
        for k in range(int(lanes.length.max(initial=0)) if len(self.places) else 0):
            frame = lanes.at(k)
            self.springs.predict(np.abs(stamps[frame] - stamps[lanes.at(k - 1)]))
            self._step(k, self._look(np.flatnonzero(k < lanes.length), frame))
        return Followed(self.landmark[0], self.score[0]), Followed(self.landmark[1], self.score[1])

    def _look(self, lane: IntArray, frame: IntArray) -> _Look:
        frame = frame[lane]
        starts = self.frames.starts
        count = starts[frame + 1] - starts[frame]
        view_lane, flower = np.nonzero(self._in_view(lane, frame))
        return _Look(
            lane=lane,
            frame=frame,
            row=ranges(starts[frame], count),
            point_lane=np.repeat(np.arange(len(lane)), count),
            flower=flower,
            flower_lane=view_lane,
            owner=lane[view_lane] * self.n_clusters + self.cluster[flower],
        )

    def _in_view(self, lane: IntArray, frame: IntArray) -> BoolArray:
        moved = self.springs.x.reshape(-1, self.n_clusters, 6)[lane][:, self.cluster, :3]
        p = (self.places + moved - self.T[frame, None, :3, 3]) @ self.T[frame, :3, :3]
        z = np.maximum(p[..., 2], 1e-6)
        x, y, depth = p[..., 0] / z, p[..., 1] / z, p[..., 2]
        slack = np.array([0.02, 0.02, 0.1 * self.high[2]])
        low, high = self.low - slack, self.high + slack
        visible: BoolArray = (x > low[0]) & (x < high[0]) & (y > low[1]) & (y < high[1])
        visible &= (depth > low[2]) & (depth < high[2])
        return visible

    def _step(self, k: int, look: _Look) -> None:
        """One frame of every lane."""
        cfg, s, n = self.config, self.springs, len(look.lane)
        c, S, cov_of_pose = self.frames.points[look.row], self.world_cov[look.row], self.cov_of_pose[look.row]
        w = transform(self.T[look.frame][look.point_lane], c)
        predicted = self.places[look.flower] + s.x[look.owner, :3]
        P = s.P[look.owner][:, :3, :3] + cfg.landmark_sigma_m**2 * np.eye(3)
        reach_var = cfg.gate_chi2 * np.trace(P, axis1=1, axis2=2)
        var = cfg.gate_chi2 * np.trace(S + cov_of_pose, axis1=1, axis2=2)
        near = near_pairs(predicted, reach_var, look.flower_lane, w, var, look.point_lane, n)
        rows, cols, _ = self._assign(near, predicted, P, w, S + cov_of_pose, look)
        z = solve_pose_corrections(
            self.T[look.frame, :3, :3],
            look.point_lane[cols],
            c[cols],
            predicted[rows] - w[cols],
            P[rows] + S[cols],
            self.information_pose,
        )
        w = transform((self.T[look.frame] @ se3_exp(z))[look.point_lane], c)
        rows, cols, chi2 = self._assign(near, predicted, P, w, S, look)
        sure = self._is_likely(look.flower[rows], look.owner[rows], w[cols], S[cols], P[rows], chi2)
        rows, cols = self._search(look, rows[sure], cols[sure], chi2[sure], w, S)
        score = self._absorb(look.flower[rows], look.owner[rows], w[cols], S[cols])
        self._keep(k, look, rows, cols, score)

    def _assign(
        self, near: tuple[IntArray, IntArray], predicted: Array, P: Array, w: Array, S: Array, look: _Look
    ) -> tuple[IntArray, IntArray, Array]:
        rows, cols = near
        return assign(rows, cols, w[cols] - predicted[rows], P[rows] + S[cols], self.config.gate_chi2, look.flower_lane)

    def _is_likely(self, flower: IntArray, owner: IntArray, w: Array, S: Array, P: Array, chi2: Array) -> BoolArray:
        """Which matches (q,) are likelier than a false detection: a single flower that was lost proves little.

        Where it stands at rest it is believed. Off its rest, the prediction of a spring that was not seen for some time
        is so wide that any false detection fits it.
        """
        s, cfg = self.springs, self.config
        if self.stand_alone:  # no cluster of two: then wandering detections are errors of a detector, not sway
            return np.ones(len(owner), dtype=bool)
        offset = w - self.places[flower]
        rest, _ = chi2_and_log_det(offset, S + REST_SIGMA_M**2 * np.eye(3))
        _, log_det = chi2_and_log_det(offset, S + P)
        log_prior = np.where(s.unseen_s[owner] < cfg.lost_s, 0.0, np.log(cfg.sway_share))
        ratio = log_prior - 0.5 * (chi2 + log_det + 3.0 * np.log(2.0 * np.pi)) - self.log_clutter
        alone = np.bincount(owner)[owner] < 2
        reached = (offset * offset).sum(-1) < cfg.reach_unseen_m**2
        likely: BoolArray = (~alone | (rest < cfg.gate_chi2) | (ratio > 0.0)) & reached
        return likely

    def _search(
        self, look: _Look, rows: IntArray, cols: IntArray, chi2: Array, w: Array, S: Array
    ) -> tuple[IntArray, IntArray]:
        """Search for the clusters that lost most of their flowers, among the points that no healthy one holds."""
        s, n = self.springs, len(self.springs.x)
        expected = np.bincount(look.owner, minlength=n)
        matched = np.bincount(look.owner[rows], minlength=n)
        mean_chi2 = np.bincount(look.owner[rows], chi2, n) / np.maximum(matched, 1)
        troubled = (expected >= 2) & ((matched < 0.55 * expected) | (mean_chi2 > 7.0))
        which = np.flatnonzero(troubled)
        if len(which) == 0:
            return rows, cols
        free = np.ones(len(w), dtype=bool)
        free[cols[~troubled[look.owner[rows]]]] = False
        lost = Lost(
            lane=np.searchsorted(look.lane, which // self.n_clusters),
            predicted=s.x[which, :3],
            cov=s.P[which, :3, :3],
            is_unseen=s.unseen_s[which] >= self.config.lost_s,
        )
        mine = np.flatnonzero(troubled[look.owner])
        mine = mine[np.argsort(look.owner[mine], kind="stable")]
        number = np.searchsorted(which, look.owner[mine])
        found = find_lost(lost, self.places[look.flower[mine]], number, free, w, S, look.point_lane, self.config)
        is_found = np.isfinite(found.score)
        s.jump(which[is_found], found.d[is_found], found.cov[is_found])
        troubled[which] = is_found  # from here on: those that moved
        taken = np.zeros(len(w), dtype=bool)
        taken[found.point] = True
        stays = ~troubled[look.owner[rows]] & ~taken[cols]
        return np.concatenate([rows[stays], mine[found.flower]]), np.concatenate([cols[stays], found.point])

    def _absorb(self, flower: IntArray, owner: IntArray, w: Array, S: Array) -> Array:
        """Update the springs with all matched flowers (q,) at once; the score of each cluster."""
        s, cfg, n = self.springs, self.config, len(self.springs.x)
        W = information(S + cfg.landmark_sigma_m**2 * np.eye(3))
        offset = w - self.places[flower]
        seen, column = np.unique(owner, return_inverse=True)
        cov = information(sums(W, column, len(seen)))
        moment = sums((W @ offset[..., None])[..., 0], column, len(seen))
        s.update(seen, (cov @ moment[..., None])[..., 0], cov)
        s.unseen_s[seen] = 0.0
        s.reset(s.unseen_s > cfg.forget_s)
        residual = offset - s.x[owner, :3]
        chi2 = ((W @ residual[..., None])[..., 0] * residual).sum(-1)
        score: Array = np.bincount(owner, np.maximum(cfg.match_gain - 0.5 * chi2, 0.0), n).astype(np.float64)
        return score

    def _keep(self, k: int, look: _Look, rows: IntArray, cols: IntArray, score: Array) -> None:
        """Take down what was found in the lanes whose run-up is over."""
        direction = (self.lanes.way[look.lane] < 0).astype(np.int64)
        counts = k >= self.lanes.run_up[look.lane]
        self.score[direction[counts], look.frame[counts]] = score.reshape(-1, self.n_clusters)[look.lane[counts]]
        lane = look.point_lane[cols]
        kept = counts[lane]
        self.landmark[direction[lane[kept]], look.row[cols[kept]]] = look.flower[rows[kept]]


def combine_directions(forward: Followed, backward: Followed, frames: Frames, cluster: IntArray) -> IntArray:
    """Landmark of each observation: for each frame and cluster, of the direction with the larger score."""
    n_clusters = forward.score.shape[1]
    if n_clusters == 0:
        return np.full(len(frames), -1, dtype=np.int64)
    use_backward = backward.score > forward.score + 1e-9
    out = np.full(len(frames), -1, dtype=np.int64)
    strength = np.full(len(frames), -np.inf)
    for followed, use in ((forward, ~use_backward), (backward, use_backward)):
        owner = np.append(cluster, n_clusters)[followed.landmark]
        chosen = (owner < n_clusters) & use[frames.frame, np.minimum(owner, n_clusters - 1)]
        gain = followed.score[frames.frame, np.minimum(owner, n_clusters - 1)]
        better = chosen & (gain > strength)
        out[better] = followed.landmark[better]
        strength[better] = gain[better]
    return out
