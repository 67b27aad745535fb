"""The camera followed through a frozen map: a Kalman filter over pose, mounting and the clusters' displacements.

The state holds tangents of the camera pose (z), of ``T_map_world`` (w, where the given poses are absolute) and of the
hand-eye transform (x, where the poses are the flange's), of each cluster met so far two displacements: one that stays
(b: how wrong the map has it) and one that comes and goes (s: sway, an Ornstein-Uhlenbeck process), and of each flower
met so far how wrong the map has its place in the cluster (f). So what the map is wrong by is counted once, however many
frames see it.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from cluster_slam.geometry import Array, adjoint, inverse, se3_exp, se3_log, skew, transform
from cluster_slam.localisation import sway
from cluster_slam.localisation.fit import GATE_CHI2, LOG_2PI
from cluster_slam.localisation.landmarks import LEAST_SIGMA_M, Landmarks
from cluster_slam.localisation.motion import Motion
from cluster_slam.localisation.scene import ErrorScale, Look, covs_at
from cluster_slam.localisation.shifts import settled
from cluster_slam.records import IntArray
from tracking.assignment import assign
from tracking.gating import mahalanobis_sq

_DIFFUSE = np.repeat([0.3, 0.3], 3)  # rad, m: of T_map_world about a first guess, next to nothing
_CALM_DOWN_S = 1.5  # a shaken cluster is taken to swing for about so long
_FORGET_S = 3.0  # the sway of a cluster unseen for so long is forgotten


@dataclass(slots=True, eq=False)
class _Cluster:
    at: int  # column of b in the state; s follows
    swing_m: float = 0.0  # how far it was seen to swing of late
    seen_s: float = 0.0


@dataclass(frozen=True, slots=True, eq=False)
class Step:
    """What one frame did."""

    frame: int
    T_map_camera: Array  # (4, 4) after the frame
    cov: Array  # (6, 6)
    rows: IntArray  # (m,) points that are flowers of the map
    flowers: IntArray  # (m,) which (indices of the landmarks)
    predicted_T: Array  # (4, 4) before the frame was looked at ...
    predicted_cov: Array  # (6, 6) ... and its covariance
    log_likelihood: float  # of the matched points, given all frames before
    nis: float  # of all matched points together
    pose_error_sq: float  # of the given pose or step, as estimated, squared in units of its stated covariance ...
    pose_error_sq_expected: float  # ... and what that should be on average, were the statement true


@dataclass(slots=True, eq=False)
class Track:
    """One filter. ``start`` makes it, ``step`` takes a frame."""

    marks: Landmarks
    motion: Motion
    scale: ErrorScale
    sway_time_s: float
    T: Array  # (4, 4) T_map_camera
    W: Array | None  # (4, 4) T_map_world
    X: Array | None  # (4, 4) T_flange_camera
    P: Array  # (d, d)
    frame: int
    clusters: dict[int, _Cluster] = field(default_factory=dict)
    flowers: dict[int, int] = field(default_factory=dict)  # column of each flower's f in the state
    d: Array = field(default_factory=lambda: np.zeros(0))  # displacements, in the order of the state after the poses

    @property
    def n_poses(self) -> int:
        """Entries of the state before the displacements."""
        return 6 + (6 if self.W is not None else 0) + (6 if self.X is not None else 0)

    @property
    def pose_cov(self) -> Array:
        return self.P[:6, :6]

    def predict(self, frame: int) -> Array:
        """Move the state to another frame; the covariance (6, 6) that the given motion adds to the camera pose."""
        dt = abs(float(self.motion.stamps[frame] - self.motion.stamps[self.frame]))
        self._let_sway(dt, float(self.motion.stamps[frame]))
        F, added = self._pose_transition(frame)
        n = len(self.P)
        top = F @ self.P[: F.shape[1]]
        self.P[:6] = top
        self.P[:, :6] = np.vstack([top[:, : F.shape[1]] @ F.T, top[:, 6:].T]) if n > 6 else top @ F.T
        self.P[:6, :6] = 0.5 * (self.P[:6, :6] + self.P[:6, :6].T) + added
        self.frame = frame
        return added

    def _pose_transition(self, frame: int) -> tuple[Array, Array]:
        """Rows (6, n_poses) that the new camera tangent has of the old pose state, and what is added to its covariance.

        Moves ``T`` too. Absolute poses: T = W F Exp(e) X. Odometry: T' = T X^-1 (F^-1 F') Exp(e) X.
        """
        F = np.zeros((6, self.n_poses))
        motion, X = self.motion, self.X
        lever = np.eye(6) if X is None else adjoint(inverse(X))
        at_x = 6 if self.W is None else 12
        if self.W is not None:
            seen = motion.camera_in_world(frame, X)
            self.T = self.W @ seen
            F[:, 6:12] = adjoint(inverse(seen))
            if X is not None:
                F[:, at_x : at_x + 6] = np.eye(6)
            cov = motion.cov * self.scale.pose_variance
        else:
            moved = motion.camera_step(self.frame, frame, X)
            self.T = self.T @ moved
            F[:, :6] = adjoint(inverse(moved))
            if X is not None:
                F[:, at_x : at_x + 6] = np.eye(6) - F[:, :6]
            cov = motion.step_cov(self.frame, frame) * self.scale.pose_variance
        return F, lever @ cov @ lever.T

    def _let_sway(self, dt: float, now: float) -> None:
        gone = []
        for cluster, c in self.clusters.items():
            c.swing_m *= float(np.exp(-dt / _CALM_DOWN_S))
            s = slice(c.at + 3, c.at + 6)
            if now - c.seen_s > _FORGET_S and c.swing_m > 0:
                gone.append(cluster)
            time = self.sway_time_s if c.swing_m < 2.0 * self.scale.sway_m else 0.3 * self.sway_time_s
            keep = float(np.exp(-dt / time))
            self.P[s] *= keep
            self.P[:, s] *= keep
            self.d[c.at + 3 - self.n_poses : c.at + 6 - self.n_poses] *= keep
            self.P[s, s] += (1.0 - keep**2) * (self.scale.sway_m**2 + c.swing_m**2) * np.eye(3)
        for cluster in gone:
            self.clusters[cluster].swing_m = 0.0

    def _meet(self, cluster: int) -> _Cluster:
        """The cluster's place in the state, made where it is new."""
        if cluster not in self.clusters:
            sway_cov = self.scale.sway_m**2 * np.eye(3)
            self.clusters[cluster] = _Cluster(self._grow(np.stack([self.marks.shared_covs[cluster], sway_cov])))
        return self.clusters[cluster]

    def _meet_flowers(self, flowers: IntArray) -> None:
        """Places in the state for the flowers that are new; those that the map states exact need none."""
        wrong = np.trace(self.marks.covs[flowers], axis1=1, axis2=2) > 3.0 * (2.0 * LEAST_SIGMA_M) ** 2
        new = [f for f in flowers[wrong].tolist() if f not in self.flowers]
        if new:
            at = self._grow(self.marks.covs[new])
            self.flowers |= {f: at + 3 * k for k, f in enumerate(new)}

    def _grow(self, covs: Array) -> int:
        """Displacements (k, 3) about zero with covariances (k, 3, 3), put behind the state; the column of the first."""
        at, k = len(self.P), len(covs)
        grown = np.zeros((at + 3 * k, at + 3 * k))
        grown[:at, :at] = self.P
        columns = at + np.arange(3 * k).reshape(k, 3)
        grown[columns[:, :, None], columns[:, None, :]] = covs
        self.P, self.d = grown, np.concatenate([self.d, np.zeros(3 * k)])
        return at

    def displacement(self, cluster: int) -> Array:
        """Where the cluster stands from its place in the map (3,), m, as far as is known."""
        if cluster not in self.clusters:
            return np.zeros(3)
        at = self.clusters[cluster].at - self.n_poses
        return self.d[at : at + 3] + self.d[at + 3 : at + 6]

    def associate(
        self, look: Look, null_density: float, points: IntArray | None = None, flowers: IntArray | None = None
    ) -> tuple[IntArray, IntArray]:
        """Points and flowers matched one to one, as predicted; among the given points and flowers, None: all."""
        points = np.arange(len(look)) if points is None else points
        flowers = np.arange(len(self.marks)) if flowers is None else flowers
        seen = transform(self.T, look.points[points])
        R = self.T[:3, :3]
        J = np.concatenate([-R @ skew(look.points[points]), np.broadcast_to(R, (len(points), 3, 3))], axis=-1)
        own_cov = R @ look.covs[points] @ R.T
        pose_covs = J @ self.pose_cov @ np.swapaxes(J, 1, 2)
        point_cov = own_cov + pose_covs
        places, covs, shared = self._places()
        places, covs = places[flowers], covs[flowers]
        of, drifted = self.marks.cluster[flowers], self.marks.drifted(self.scale.sway_m)
        free = np.ones(len(flowers), bool)
        if drifted.any():
            own = self._own_covs(flowers)
            places, settled_covs, free = settled(
                seen, own_cov, pose_covs, places, own, of, shared, drifted, null_density
            )
            covs = np.where(drifted[of, None, None], settled_covs, covs)
        largest = np.trace(point_cov, axis1=1, axis2=2).max() + np.trace(covs, axis1=1, axis2=2)
        off = seen[:, None] - places
        i, j = np.nonzero(((off**2).sum(-1) < GATE_CHI2 * largest) & free)
        if len(i) == 0:
            return i, j
        S = np.where(drifted[of[j], None, None], own_cov[i], point_cov[i]) + covs[j]
        d2 = mahalanobis_sq(off[i, j], S)
        cost = np.full((len(points), len(places)), np.inf)
        log_det = np.linalg.slogdet(S)[1]
        cost[i, j] = np.where(d2 < GATE_CHI2, 0.5 * (d2 + log_det + 3.0 * LOG_2PI), np.inf)
        near = np.flatnonzero(np.isfinite(cost).any(0))
        rows, columns = assign(cost[:, near], -float(np.log(null_density)))
        return points[rows], flowers[near[columns]]

    def _followed_up(
        self, look: Look, rows: IntArray, flowers: IntArray, null_density: float
    ) -> tuple[IntArray, IntArray]:
        """All matches, with those that the first ones open: where a cluster swings shows in part of its flowers."""
        left = np.setdiff1d(np.arange(len(look)), rows)
        swings = [c for c, state in self.clusters.items() if state.swing_m > 2.0 * self.scale.sway_m]
        open_ = np.setdiff1d(np.flatnonzero(np.isin(self.marks.cluster, swings)), flowers)
        if len(left) == 0 or len(open_) == 0 or len(rows) == 0:
            return rows, flowers
        more, which = self.associate(look, null_density, left, open_)
        if len(more) == 0:
            return rows, flowers
        self.update(look, more, which)
        return np.concatenate([rows, more]), np.concatenate([flowers, which])

    def _own_covs(self, flowers: IntArray) -> Array:
        """Covariances (m, 3, 3) of flowers about their clusters, as known by now."""
        covs = self.marks.covs[flowers]
        for k, f in enumerate(flowers.tolist()):
            if f in self.flowers:
                at = slice(self.flowers[f], self.flowers[f] + 3)
                covs[k] = self.P[at, at]
        return covs

    def _places(self) -> tuple[Array, Array, Array]:
        """Predicted places (f, 3) of all flowers, their covariances (f, 3, 3), and what clusters share (c, 3, 3)."""
        shift = np.zeros((self.marks.n_clusters, 3))
        shared = self.marks.shared_covs + self.scale.sway_m**2 * np.eye(3)
        for cluster, c in self.clusters.items():
            b, s = slice(c.at, c.at + 3), slice(c.at + 3, c.at + 6)
            shift[cluster] = self.displacement(cluster)
            shared[cluster] = self.P[b, b] + self.P[s, s] + self.P[b, s] + self.P[s, b]
        places = self.marks.positions + shift[self.marks.cluster]
        covs = self.marks.covs + shared[self.marks.cluster]
        if self.flowers:
            met = np.array(list(self.flowers))
            columns = self._columns(met)
            places[met] += self.d[columns[:, 2] - self.n_poses]
            covs[met] = self.P[columns[:, :, None, :, None], columns[:, None, :, None, :]].sum(axis=(1, 2))
        return places, covs, shared

    def _columns(self, flowers: IntArray) -> IntArray:
        """Columns (m, 3, 3) of the state in which b, s and f of flowers with an f stand."""
        of = [self.clusters[c].at for c in self.marks.cluster[flowers].tolist()]
        at = np.array([[b, b + 3, self.flowers[f]] for b, f in zip(of, flowers.tolist(), strict=True)])
        return np.asarray(at[:, :, None] + np.arange(3), dtype=np.int64)

    def update(self, look: Look, rows: IntArray, flowers: IntArray, n_iterations: int = 1) -> tuple[float, float]:
        """Take the matched points in; log likelihood and chi-square of their innovations."""
        for cluster in np.unique(self.marks.cluster[flowers]).tolist():
            self._meet(cluster).seen_s = float(self.motion.stamps[self.frame])
        self._meet_flowers(flowers)
        T0, W0, X0, d0, P0 = self.T, self.W, self.X, self.d, self.P
        moved = np.zeros(len(self.P))
        log_likelihood = nis = 0.0
        for iteration in range(n_iterations):
            H, r, V = self._linearised(look, rows, flowers)
            innovation = r + H @ moved
            seen = np.flatnonzero(H.any(axis=0))  # most of what was met so far is not in this frame
            H = H[:, seen]
            PH = P0[:, seen] @ H.T
            S = H @ PH[seen] + V
            if iteration == 0:
                V_points = np.stack([V[k : k + 3, k : k + 3] for k in range(0, len(V), 3)])
                self._shake(S, V_points, innovation, flowers, P0)
                PH = P0[:, seen] @ H.T
                S = H @ PH[seen] + V
            L = np.linalg.cholesky(S)
            white = np.linalg.solve(L, np.column_stack([innovation, PH.T]))
            moved = white[:, 1:].T @ white[:, 0]
            if iteration == 0:
                nis = float(white[:, 0] @ white[:, 0])
                log_likelihood = -0.5 * nis - float(np.log(np.diag(L)).sum()) - 0.5 * len(r) * LOG_2PI
            self._move(T0, W0, X0, d0, moved)
        self.P = P0 - white[:, 1:].T @ white[:, 1:]
        self.P = 0.5 * (self.P + self.P.T)
        for cluster in np.unique(self.marks.cluster[flowers]).tolist():
            c = self.clusters[cluster]
            at = c.at + 3 - self.n_poses
            c.swing_m = max(c.swing_m, float(np.linalg.norm(self.d[at : at + 3])) - 2.0 * self.scale.sway_m, 0.0)
        return log_likelihood, nis

    def _shake(self, S: Array, V: Array, innovation: Array, flowers: IntArray, P: Array) -> None:
        """Clusters whose points are off together swing: their sway may be as large as that (P grows in place)."""
        of = self.marks.cluster[flowers]
        clusters = np.unique(of)
        means, covs = np.zeros((len(clusters), 3)), np.zeros((len(clusters), 3, 3))
        for k, cluster in enumerate(clusters.tolist()):
            rows = np.flatnonzero(of == cluster)
            here = (3 * rows[:, None] + np.arange(3)).ravel()
            information = np.linalg.solve(V[rows], np.broadcast_to(np.eye(3), (len(rows), 3, 3)))
            mean = np.linalg.solve(information.sum(0), np.hstack(list(information)))
            means[k], covs[k] = mean @ innovation[here], mean @ S[np.ix_(here, here)] @ mean.T
        p, _ = sway.shares(means, covs, self.scale)
        usual = np.trace(covs, axis1=1, axis2=2)[:, None] / 3.0
        added = 1.0 / (p / (usual + sway.variances(self.scale))).sum(axis=1) - usual[:, 0]
        for k, cluster in enumerate(clusters.tolist()):
            c = self.clusters[cluster]
            if p[k, 0] < 0.5:
                c.swing_m = max(c.swing_m, float(np.sqrt(added[k])))
            P[range(c.at + 3, c.at + 6), range(c.at + 3, c.at + 6)] += added[k]

    def _linearised(self, look: Look, rows: IntArray, flowers: IntArray) -> tuple[Array, Array, Array]:
        """Jacobian (3 m, d), residuals (3 m,) and covariance (3 m, 3 m) of the matched points in the camera frame."""
        m, Rt = len(rows), self.T[:3, :3].T
        of = self.marks.cluster[flowers]
        at = np.array([self.clusters[c].at for c in of.tolist()])
        places = self.marks.positions[flowers] + np.array([self.displacement(c) for c in of.tolist()])
        own = np.array([self.flowers.get(f, -1) for f in flowers.tolist()])
        met = own >= 0
        places[met] += self.d[own[met, None] + np.arange(3) - self.n_poses]
        h = transform(inverse(self.T), places)
        H = np.zeros((m, 3, len(self.P)))
        H[:, :, :6] = np.concatenate([skew(h), np.broadcast_to(-np.eye(3), (m, 3, 3))], axis=-1)
        k, axis = np.arange(m)[:, None, None], np.arange(3)[:, None]
        H[k, axis, at[:, None, None] + np.arange(3)] = Rt
        H[k, axis, at[:, None, None] + 3 + np.arange(3)] = Rt
        H[k[met], axis, own[met, None, None] + np.arange(3)] = Rt
        V = np.zeros((m, 3, m, 3))
        covs = covs_at(look, rows, h[:, 2], self.scale).copy()
        covs[~met] += Rt @ self.marks.covs[flowers[~met]] @ Rt.T
        V[np.arange(m), :, np.arange(m)] = covs
        return H.reshape(3 * m, -1), (look.points[rows] - h).ravel(), V.reshape(3 * m, 3 * m)

    def _move(self, T: Array, W: Array | None, X: Array | None, d: Array, moved: Array) -> None:
        self.T = T @ se3_exp(moved[:6])
        at = 6
        if W is not None:
            self.W = W @ se3_exp(moved[at : at + 6])
            at += 6
        if X is not None:
            self.X = X @ se3_exp(moved[at : at + 6])
            at += 6
        self.d = d + moved[at:]

    def step(self, frame: int, look: Look, null_density: float) -> Step:
        """Take the next frame in."""
        added = self.predict(frame)
        predicted, before = self.T, self.pose_cov.copy()
        rows, flowers = self.associate(look, null_density) if len(look) else (np.zeros(0, np.int64),) * 2
        log_likelihood, nis = self.update(look, rows, flowers) if len(rows) else (0.0, 0.0)
        rows, flowers = self._followed_up(look, rows, flowers, null_density)
        after = self.pose_cov.copy()
        surprise = _pose_surprise(added, before, after, se3_log(inverse(predicted) @ self.T))
        return Step(frame, self.T, after, rows, flowers, predicted, before, log_likelihood, nis, *surprise)


def _pose_surprise(added: Array, before: Array, after: Array, moved: Array) -> tuple[float, float]:
    """The given pose's own error as the frame shows it: its square over its covariance, and what to expect of that.

    ``added`` (6, 6) is the error's covariance, part of ``before``, the predicted pose's; ``after`` is the posterior's.
    """
    gain = np.linalg.solve(before, added).T
    error = gain @ moved
    information = np.linalg.solve(added, np.eye(6))
    expected = np.trace(information @ gain @ (before - after) @ gain.T)
    return float(error @ information @ error), float(expected)


def start(
    marks: Landmarks,
    motion: Motion,
    frame: int,
    T_map_camera: Array,
    scale: ErrorScale,
    sway_time_s: float,
) -> Track:
    """A track that begins at a frame near a pose, about which next to nothing is believed yet."""
    X = motion.X0
    W = None if motion.is_odometry else T_map_camera @ inverse(motion.camera_in_world(frame, X))
    n = 6 + (0 if W is None else 6) + (0 if X is None else 6)
    P = np.zeros((n, n))
    about = np.diag(_DIFFUSE**2)
    if X is not None:
        P[n - 6 :, n - 6 :] = motion.cov_hand_eye
    if W is None:
        P[:6, :6] = about
    else:  # the pose of the first frame is what is vague; T_map_world follows from it
        P[6:12, 6:12] = adjoint(motion.camera_in_world(frame, X)) @ about @ adjoint(motion.camera_in_world(frame, X)).T
    track = Track(marks, motion, scale, sway_time_s, T_map_camera, W, X, P, frame)
    if W is not None:
        track.predict(frame)
    return track
