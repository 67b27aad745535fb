"""Clusters followed as templates through sway: each is a rigid set of flowers with one displacement of its own.

The state of cluster j is its displacement from rest and its velocity, (d, v), a noisy spring. In every frame all
flowers in view and all points are assigned one to one, the frame's pose error is found and taken away, and each
cluster's state is updated with all its matched flowers at once. A cluster that loses its flowers (a shake begins with a
jump in velocity that no filter predicts) is searched for: each pair of one of its flowers and one free point is a
hypothesis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.frames import Frames, chi2_and_log_det, field_of_view, information, point_jacobian
from cluster_slam.association.tracklets import match, solve_pose_correction
from cluster_slam.config import TemplateConfig
from cluster_slam.geometry import Array, inverse, rotate_cov, se3_exp, transform
from cluster_slam.records import BoolArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class Followed:
    """``landmark`` (m,) of each sorted observation or -1, ``chi2`` (m,), and for each frame and cluster the score."""

    landmark: IntArray
    chi2: Array
    score: Array  # (n, c)
    correction: Array  # (n, 6) pose corrections


REST_SIGMA_M = 0.001  # how far a cluster at rest may be from it


class _Springs:
    """Displacement and velocity of all clusters, (c, 6) with (c, 6, 6)."""

    def __init__(self, n: int, config: TemplateConfig) -> None:
        self.config = config
        self.x = np.zeros((n, 6))
        self.P = np.zeros((n, 6, 6))
        self.unseen_s = np.zeros(n)
        self.reset(np.ones(n, dtype=bool))

    def reset(self, which: BoolArray) -> None:
        c = self.config
        self.x[which] = 0.0
        sigma = np.repeat([REST_SIGMA_M, REST_SIGMA_M * 2 * np.pi * c.sway_hz], 3)
        self.P[which] = np.diag(sigma**2)

    def predict(self, dt: float) -> None:
        c = self.config
        self.unseen_s += dt
        omega = 2 * np.pi * c.sway_hz
        cos, sin = np.cos(omega * dt), np.sin(omega * dt)
        F = np.kron(np.array([[cos, sin / omega], [-omega * sin, cos]]), np.eye(3))
        amplitude = np.sqrt((self.x[:, :3] ** 2).sum(1) + (self.x[:, 3:] ** 2).sum(1) / omega**2)
        accel_var = (c.rest_accel + c.sway_spread * omega**2 * amplitude) ** 2
        Q = np.kron(np.array([[dt**4 / 4, dt**3 / 2], [dt**3 / 2, dt**2]]), np.eye(3))
        self.x = self.x @ F.T
        self.P = F @ self.P @ F.T + accel_var[:, None, None] * Q
        cap = np.maximum(amplitude, c.jump_sigma_m)[:, None] * np.repeat([1.0, omega], 3)
        shrink = np.minimum(1.0, cap / np.sqrt(np.einsum("cii->ci", self.P)))
        self.P *= shrink[:, :, None] * shrink[:, None, :]

    def update(self, rows: IntArray, mean: Array, cov: Array) -> None:
        """Measured displacements (q, 3) with (q, 3, 3) of clusters ``rows``."""
        P = self.P[rows]
        gain = P[:, :, :3] @ information(P[:, :3, :3] + cov)
        self.x[rows] += (gain @ (mean - self.x[rows, :3])[..., None])[..., 0]
        P = P - gain @ P[:, :3, :]
        self.P[rows] = 0.5 * (P + np.swapaxes(P, -1, -2))

    def jump(self, row: int, d: Array, cov: Array) -> None:
        c = self.config
        self.x[row, :3], self.x[row, 3:] = d, 0.0
        self.P[row] = 0.0
        self.P[row, :3, :3] = cov
        self.P[row, 3:, 3:] = c.jump_speed**2 * np.eye(3)


class Follower:
    """Follows clusters with known rest places through a session (one direction)."""

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
        """Camera poses T (n, 4, 4) with (n, 6, 6), rest places (l, 3) and the cluster 0..c-1 (l,) of each.

        ``clutter_density``: false detections a frame and m^3.
        """
        self.frames, self.T, self.config = frames, T, config
        self.log_clutter = float(np.log(clutter_density))
        self.places, self.cluster = places, cluster
        self.n_clusters = int(cluster.max(initial=-1)) + 1
        self.stand_alone = self.n_clusters == len(places)
        self.cov_pose = cov_pose
        self.information_pose = np.linalg.inv(cov_pose + 1e-18 * np.eye(6))
        self.low, self.high = field_of_view(frames)
        self.world_cov = rotate_cov(T[frames.frame, :3, :3], frames.covs)
        self.springs = _Springs(self.n_clusters, config)

    def run(self) -> Followed:
        m, n = len(self.frames), self.frames.n_frames
        self.landmark = np.full(m, -1, dtype=np.int64)
        self.chi2 = np.full(m, np.nan)
        self.score = np.zeros((n, self.n_clusters))
        self.correction = np.zeros((n, 6))
        stamps = self.frames.stamps
        for i in range(n):
            if i:
                self.springs.predict(stamps[i] - stamps[i - 1])
            self._step(i)
        return Followed(self.landmark, self.chi2, self.score, self.correction)

    def _step(self, i: int) -> None:
        cfg, s = self.config, self.springs
        here = self.frames.of(i)
        c, S = self.frames.points[here], self.world_cov[here]
        w = transform(self.T[i], c)
        view = self._in_view(i)
        flowers = np.flatnonzero(view)
        owner = self.cluster[flowers]
        predicted = self.places[flowers] + s.x[owner, :3]
        P = s.P[owner][:, :3, :3] + cfg.landmark_sigma_m**2 * np.eye(3)
        J = point_jacobian(self.T[i, :3, :3], c)
        rows, cols, _ = match(predicted, P, w, S + J @ self.cov_pose[i] @ np.swapaxes(J, -1, -2), cfg.gate_chi2)
        if len(rows):
            z = solve_pose_correction(
                self.T[i, :3, :3], c[cols], predicted[rows] - w[cols], P[rows] + S[cols], self.information_pose[i]
            )
            self.correction[i] = z
            w = transform(self.T[i] @ se3_exp(z), c)
        rows, cols, chi2 = match(predicted, P, w, S, cfg.gate_chi2)
        sure = self._is_likely(flowers[rows], w[cols], S[cols], P[rows], chi2)
        rows, cols, chi2 = self._search(i, flowers, rows[sure], cols[sure], chi2[sure], w, S)
        self._absorb(i, flowers[rows], cols, w, S)
        self.landmark[here.start + cols] = flowers[rows]
        self.chi2[here.start + cols] = chi2

    def _is_likely(self, flowers: IntArray, w: Array, S: Array, P: Array, chi2: Array) -> BoolArray:
        """Which matches (q,) are likelier than a false detection: a single flower that was lost proves little.

        Where it stands at rest it is believed. Off its rest, the prediction of a spring that was not seen for some time
        is so wide that any false detection fits it.
        """
        s, cfg = self.springs, self.config
        if self.stand_alone:  # no cluster of two: then wandering detections are errors of a detector, not sway
            return np.ones(len(flowers), dtype=bool)
        owner = self.cluster[flowers]
        offset = w - self.places[flowers]
        rest, _ = chi2_and_log_det(offset, S + REST_SIGMA_M**2 * np.eye(3))
        _, log_det = chi2_and_log_det(offset, S + P)
        log_prior = np.where(s.unseen_s[owner] < cfg.lost_s, 0.0, np.log(cfg.sway_share))
        ratio = log_prior - 0.5 * (chi2 + log_det + 3.0 * np.log(2.0 * np.pi)) - self.log_clutter
        alone = np.bincount(owner, minlength=self.n_clusters)[owner] < 2
        reached = (offset * offset).sum(-1) < cfg.reach_unseen_m**2
        likely: BoolArray = (~alone | (rest < cfg.gate_chi2) | (ratio > 0.0)) & reached
        return likely

    def _in_view(self, i: int) -> BoolArray:
        p = transform(inverse(self.T[i]), self.places + self.springs.x[self.cluster, :3])
        z = np.where(p[:, 2] > 1e-6, p[:, 2], 1e-6)
        rays = np.column_stack([p[:, 0] / z, p[:, 1] / z, p[:, 2]])
        slack = np.array([0.02, 0.02, 0.1 * self.high[2]])
        visible: BoolArray = ((rays > self.low - slack) & (rays < self.high + slack)).all(axis=1)
        return visible

    def _absorb(self, i: int, flowers: IntArray, cols: IntArray, w: Array, S: Array) -> None:
        """Update the springs with all matched flowers at once, and keep the score of each cluster."""
        s, cfg = self.springs, self.config
        owner = self.cluster[flowers]
        W = information(S[cols] + cfg.landmark_sigma_m**2 * np.eye(3))
        total = np.zeros((self.n_clusters, 3, 3))
        np.add.at(total, owner, W)
        moment = np.zeros((self.n_clusters, 3))
        np.add.at(moment, owner, (W @ (w[cols] - self.places[flowers])[..., None])[..., 0])
        seen = np.unique(owner)
        cov = information(total[seen])
        s.update(seen, (cov @ moment[seen][..., None])[..., 0], cov)
        s.unseen_s[seen] = 0.0
        lost = s.unseen_s > cfg.forget_s
        if lost.any():
            s.reset(lost)
        residual = w[cols] - self.places[flowers] - s.x[owner, :3]
        chi2 = np.einsum("qi,qij,qj->q", residual, W, residual)
        self.score[i] = np.bincount(owner, np.maximum(cfg.match_gain - 0.5 * chi2, 0.0), self.n_clusters)

    def _search(
        self, i: int, flowers: IntArray, rows: IntArray, cols: IntArray, chi2: Array, w: Array, S: Array
    ) -> tuple[IntArray, IntArray, Array]:
        """Search for the clusters that lost most of their flowers, among the points that no healthy one holds."""
        n = self.n_clusters
        owner = self.cluster[flowers]
        expected = np.bincount(owner, minlength=n)
        matched = np.bincount(owner[rows], minlength=n)
        mean_chi2 = np.bincount(owner[rows], chi2, n) / np.maximum(matched, 1)
        troubled = (expected >= 2) & ((matched < 0.55 * expected) | (mean_chi2 > 7.0))
        if not troubled.any():
            return rows, cols, chi2
        healthy = ~troubled[owner[rows]]
        free = np.ones(len(w), dtype=bool)
        free[cols[healthy]] = False
        if free.sum() < 2:
            return rows, cols, chi2
        found = {}
        waiting = {int(j): self._best_hypothesis(int(j), flowers, owner, w, S, free) for j in np.flatnonzero(troubled)}
        while waiting:
            j = max(waiting, key=lambda k: (waiting[k].score, -k))
            best = waiting.pop(j)
            if best.score < self.config.min_score or len(best.cols) < 2:
                break
            found[j] = best
            free[best.cols] = False
            for k in list(waiting):
                if not free[waiting[k].cols].all():
                    waiting[k] = self._best_hypothesis(k, flowers, owner, w, S, free)
        return self._with_found(found, owner, rows, cols, chi2, len(w))

    def _with_found(
        self, found: dict[int, _Hypothesis], owner: IntArray, rows: IntArray, cols: IntArray, chi2: Array, n_points: int
    ) -> tuple[IntArray, IntArray, Array]:
        if not found:
            return rows, cols, chi2
        moved = np.zeros(self.n_clusters, dtype=bool)
        moved[list(found)] = True
        taken = np.zeros(n_points, dtype=bool)
        taken[np.concatenate([h.cols for h in found.values()])] = True
        stays = ~moved[owner[rows]] & ~taken[cols]
        for j, h in found.items():
            if h.is_jump:
                self.springs.jump(j, h.d, h.cov)
        return (
            np.concatenate([rows[stays], *[h.rows for h in found.values()]]),
            np.concatenate([cols[stays], *[h.cols for h in found.values()]]),
            np.concatenate([chi2[stays], *[h.chi2 for h in found.values()]]),
        )

    def _best_hypothesis(
        self, j: int, flowers: IntArray, owner: IntArray, w: Array, S: Array, free: Array
    ) -> _Hypothesis:
        cfg, s = self.config, self.springs
        mine = np.flatnonzero(owner == j)
        L = self.places[flowers[mine]]
        reach = cfg.reach_m if s.unseen_s[j] < cfg.lost_s else cfg.reach_unseen_m
        pool = np.flatnonzero(free)
        step = w[pool][None] - L[:, None]
        near = (step * step).sum(-1) < reach * reach
        used = near.any(axis=0)
        if used.sum() < 2 or len(mine) < 2:
            return _NOTHING
        pool, step, near = pool[used], step[:, used], near[:, used]
        points, W = w[pool], information(S[pool] + cfg.landmark_sigma_m**2 * np.eye(3))
        d = np.concatenate([step[near], s.x[j : j + 1, :3], np.zeros((1, 3))])
        prior = _JumpPrior(s.x[j, :3], s.P[j, :3, :3], cfg.jump_sigma_m * (1.0 if s.unseen_s[j] < cfg.lost_s else 2.0))
        gain = _gains(d, L, points, 0.5 * W, cfg.match_gain)
        total = gain.max(axis=2).sum(axis=1) + prior(d)
        best = _NOTHING
        for h in np.argsort(-total, kind="stable")[:3]:
            if total[h] < max(cfg.min_score, best.score):
                break
            hypothesis = self._refine(j, d[h], L, points, W, mine, pool, prior)
            if hypothesis.score > best.score:
                best = hypothesis
        return best

    def _refine(
        self, j: int, d: Array, L: Array, points: Array, W: Array, mine: IntArray, pool: IntArray, prior: _JumpPrior
    ) -> _Hypothesis:
        """The displacement from all flowers that fit it, matched one to one, and its final score."""
        gain_at_zero = self.config.match_gain
        for scale in (0.5, 1.0):
            gain = _gains(d[None], L, points, scale * W, gain_at_zero)[0]
            rows, cols = _greedy(gain)
            if len(rows) < 2:
                return _NOTHING
            total = W[cols].sum(0)
            d = np.linalg.solve(total, (W[cols] @ (points[cols] - L[rows])[..., None])[..., 0].sum(0))
        residual = points[cols] - L[rows] - d
        chi2 = np.einsum("qi,qij,qj->q", residual, W[cols], residual)
        log_prior = float(prior(d[None])[0])
        score = np.maximum(gain_at_zero - 0.5 * chi2, 0.0).sum() - (len(L) - len(rows)) + log_prior
        is_jump = log_prior < -6.0 or self.springs.unseen_s[j] > 0
        return _Hypothesis(float(score), mine[rows], pool[cols], chi2, d, np.linalg.inv(total), is_jump)


class _JumpPrior:
    """Log-likelihood of displacements (h, 3): as the spring predicts, or after a jump."""

    def __init__(self, predicted: Array, P: Array, jump_sigma: float) -> None:
        self.predicted, self.jump_sigma = predicted, jump_sigma
        self.information = information(P + 1e-12 * np.eye(3))

    def __call__(self, d: Array) -> Array:
        step = d - self.predicted
        chi2 = ((step @ self.information) * step).sum(1)
        value: Array = np.maximum(-0.5 * chi2, -6.0 - 0.5 * (step * step).sum(1) / self.jump_sigma**2)
        return value


@dataclass(frozen=True, slots=True, eq=False)
class _Hypothesis:
    score: float
    rows: IntArray  # of the flowers in view
    cols: IntArray  # of the frame's points
    chi2: Array
    d: Array
    cov: Array
    is_jump: bool


_EMPTY = np.empty(0, dtype=np.int64)
_NOTHING = _Hypothesis(-np.inf, _EMPTY, _EMPTY, np.empty(0), np.zeros(3), np.eye(3), False)


def _gains(d: Array, L: Array, points: Array, W: Array, match_gain: float) -> Array:
    """Gains (h, f, p) of matching flowers L + d with points: match_gain - chi2 / 2, at least zero."""
    x, y, z = np.moveaxis(points[None, None] - (L[None, :] + d[:, None])[:, :, None], -1, 0)
    chi2 = x * (W[:, 0, 0] * x + 2.0 * (W[:, 0, 1] * y + W[:, 0, 2] * z))
    chi2 += y * (W[:, 1, 1] * y + 2.0 * W[:, 1, 2] * z) + W[:, 2, 2] * z * z
    gain: Array = np.maximum(match_gain - 0.5 * chi2, 0.0)
    return gain


def _greedy(gain: Array) -> tuple[IntArray, IntArray]:
    """One-to-one pairs, largest gain first: exact enough inside one cluster, whose flowers stand apart."""
    gain = gain.copy()
    rows, cols = [], []
    for _ in range(min(gain.shape)):
        best = int(gain.argmax())
        r, c = divmod(best, gain.shape[1])
        if gain[r, c] <= 0:
            break
        rows.append(r)
        cols.append(c)
        gain[r, :] = 0.0
        gain[:, c] = 0.0
    return np.array(rows, dtype=np.int64), np.array(cols, dtype=np.int64)


def combine_directions(forward: Followed, backward: Followed, frames: Frames, cluster: IntArray) -> IntArray:
    """Landmark of each observation: for each frame and cluster, of the direction with the larger score.

    ``backward`` must have been brought back to the order of ``frames``.
    """
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
