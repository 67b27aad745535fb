"""The camera followed through a frozen map: a Kalman filter over pose, mounting and the clusters' displacements.

``cluster_slam.localisation.state`` says what is in the state. What the map is wrong by stays in it, so that it is
counted once, however many frames see it; sway is an Ornstein-Uhlenbeck process.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.blas import dtrsm

from cluster_slam.geometry import Array, adjoint, inverse, se3_log
from cluster_slam.localisation import sway
from cluster_slam.localisation.fit import LOG_2PI
from cluster_slam.localisation.landmarks import Landmarks
from cluster_slam.localisation.matching import associate
from cluster_slam.localisation.motion import Motion
from cluster_slam.localisation.scene import ErrorScale, Look, covs_at
from cluster_slam.localisation.state import Sight, State
from cluster_slam.records import IntArray

_DIFFUSE = np.repeat([0.3, 0.3], 3)  # rad, m: of T_map_world about a first guess, next to nothing
_CALM_DOWN_S = 1.5  # a shaken cluster is taken to swing for about so long
_FORGET_S = 3.0  # the sway of a cluster unseen for so long is forgotten


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

    state: State
    motion: Motion
    scale: ErrorScale
    sway_time_s: float
    frame: int
    origin: Array  # (4, 4) from the world of the given poses to the state's
    swing_m: Array = field(default_factory=lambda: np.zeros(0))  # (c,) how far each cluster was seen to swing of late
    seen_s: Array = field(default_factory=lambda: np.zeros(0))  # (c,)

    def __post_init__(self) -> None:
        n = self.state.marks.n_clusters
        self.swing_m, self.seen_s = np.zeros(n), np.full(n, -np.inf)

    @property
    def T(self) -> Array:
        """Where the camera is (4, 4), ``T_map_camera``."""
        return self.state.T

    @property
    def pose_cov(self) -> Array:
        return self.state.pose_cov

    def predict(self, frame: int) -> Array:
        """Move the state to another frame; the covariance (6, 6) that the given motion adds to the camera pose."""
        dt = abs(float(self.motion.stamps[frame] - self.motion.stamps[self.frame]))
        self._let_sway(dt, float(self.motion.stamps[frame]))
        F, added = self._pose_transition(frame)
        P = self.state.P
        top = F @ P[: F.shape[1]]
        own = top[:, : F.shape[1]] @ F.T
        P[:6], P[:, :6] = top, top.T
        P[:6, :6] = 0.5 * (own + own.T) + added
        self.frame = frame
        return added

    def _pose_transition(self, frame: int) -> tuple[Array, Array]:
        """Rows (6, n_poses) that the new camera tangent has of the old pose state, and what is added to its covariance.

        Moves ``V`` too. Absolute poses: V = F Exp(e) X. Odometry: V' = V X^-1 (F^-1 F') Exp(e) X.
        """
        state, motion, X = self.state, self.motion, self.state.X
        F = np.zeros((6, 12 if X is None else 18))
        lever = np.eye(6) if X is None else adjoint(inverse(X))
        if not motion.is_odometry:
            state.V = self.origin @ motion.camera_in_world(frame, X)
            if X is not None:
                F[:, 12:] = np.eye(6)
            cov = motion.cov * self.scale.pose_variance
        else:
            moved = motion.camera_step(self.frame, frame, X)
            state.V = state.V @ moved
            F[:, :6] = adjoint(inverse(moved))
            if X is not None:
                F[:, 12:] = np.eye(6) - F[:, :6]
            cov = motion.step_cov(self.frame, frame) * self.scale.pose_variance
        return F, lever @ cov @ lever.T

    def _let_sway(self, dt: float, now: float) -> None:
        self.swing_m *= float(np.exp(-dt / _CALM_DOWN_S))
        met = np.flatnonzero(self.state.cluster_at >= 0)
        if len(met) == 0:
            return
        swing, state = self.swing_m[met], self.state
        time = np.where(swing < 2.0 * self.scale.sway_m, 1.0, 0.3) * self.sway_time_s
        keep = np.repeat(np.exp(-dt / time), 3)
        s = (state.cluster_at[met, None] + 3 + np.arange(3)).ravel()
        state.P[s] *= keep[:, None]
        state.P[:, s] *= keep
        state.P[s, s] += (1.0 - keep**2) * np.repeat(self.scale.sway_m**2 + swing**2, 3)
        state.d[s] *= keep
        self.swing_m[now - self.seen_s > _FORGET_S] = 0.0

    def _followed_up(
        self, look: Look, rows: IntArray, flowers: IntArray, null_density: float
    ) -> tuple[IntArray, IntArray]:
        """All matches, with those that the first ones open: where a cluster swings shows in part of its flowers."""
        left = np.setdiff1d(np.arange(len(look)), rows)
        swings = self.swing_m > 2.0 * self.scale.sway_m
        open_ = np.setdiff1d(np.flatnonzero(swings[self.state.marks.cluster]), flowers)
        if len(left) == 0 or len(open_) == 0 or len(rows) == 0:
            return rows, flowers
        more, which = associate(self.state, look, self.scale.sway_m, null_density, left, open_)
        if len(more) == 0:
            return rows, flowers
        self.update(look, more, which)
        return np.concatenate([rows, more]), np.concatenate([flowers, which])

    def update(self, look: Look, rows: IntArray, flowers: IntArray, n_iterations: int = 1) -> tuple[float, float]:
        """Take the matched points in; log likelihood and chi-square of their innovations."""
        state = self.state
        clusters = np.unique(state.marks.cluster[flowers])
        state.meet(clusters, self.scale.sway_m)
        self.seen_s[clusters] = float(self.motion.stamps[self.frame])
        begin = state.means
        moved = np.zeros(len(state.P))
        log_likelihood = nis = 0.0
        for iteration in range(n_iterations):
            sight = state.sight(flowers)
            V = self._point_covs(look, rows, flowers, sight)
            innovation = (look.points[rows] - sight.h).ravel() + sight.times(moved)
            HP = sight.rows(state.P)
            S = _with_blocks(sight.covs(HP), V)
            if iteration == 0:
                added = self._shake(S, V, innovation, flowers)
                HP, S = sight.shaken(HP, S, added)
            L: Array = np.asarray(np.linalg.cholesky(S), dtype=np.float64)
            white = np.asarray(dtrsm(1.0, L.T, HP.T, side=1, overwrite_b=1).T)  # L^-1 H P
            surprise = solve_triangular(L, innovation, lower=True, check_finite=False)
            moved = surprise @ white
            if iteration == 0:
                nis = float(surprise @ surprise)
                log_likelihood = -0.5 * nis - float(np.log(np.diag(L)).sum()) - 0.5 * len(innovation) * LOG_2PI
            state.move(begin, moved)
        state.lessen(white)
        at = state.cluster_at[clusters, None] + 3 + np.arange(3)
        swing = np.linalg.norm(state.d[at], axis=1) - 2.0 * self.scale.sway_m
        self.swing_m[clusters] = np.maximum(self.swing_m[clusters], swing)
        return log_likelihood, nis

    def _point_covs(self, look: Look, rows: IntArray, flowers: IntArray, sight: Sight) -> Array:
        """Covariances (m, 3, 3) of the points in the camera frame, with what their flowers err by outside the state."""
        covs = covs_at(look, rows, sight.h[:, 2], self.scale).copy()
        exact = np.setdiff1d(np.arange(len(flowers)), sight.met)
        covs[exact] += sight.Rt @ self.state.marks.covs[flowers[exact]] @ sight.Rt.T
        return covs

    def _shake(self, S: Array, V: Array, innovation: Array, flowers: IntArray) -> Array:
        """Clusters whose points are off together swing: P grows in place by what is returned (m,), an axis, m^2."""
        clusters, group = np.unique(self.state.marks.cluster[flowers], return_inverse=True)
        m, n = len(flowers), len(clusters)
        information = np.linalg.solve(V, np.broadcast_to(np.eye(3), V.shape))
        total = np.zeros((n, 3, 3))
        np.add.at(total, group, information)
        mean = np.zeros((n, 3, m, 3))  # displacement of each cluster as its own points have it
        mean[group, :, np.arange(m)] = np.linalg.solve(total[group], information)
        flat = mean.reshape(3 * n, 3 * m)
        covs = np.einsum("cik,cjk->cij", (flat @ S).reshape(n, 3, -1), flat.reshape(n, 3, -1))
        p, _ = sway.shares((flat @ innovation).reshape(n, 3), covs, self.scale)
        usual = np.trace(covs, axis1=1, axis2=2)[:, None] / 3.0
        added = 1.0 / (p / (usual + sway.variances(self.scale))).sum(axis=1) - usual[:, 0]
        shaken = p[:, 0] < 0.5
        c = clusters[shaken]
        self.swing_m[c] = np.maximum(self.swing_m[c], np.sqrt(np.maximum(added[shaken], 0.0)))
        s = self.state.cluster_at[clusters, None] + 3 + np.arange(3)
        self.state.P[s, s] += added[:, None]
        return np.asarray(added[group])

    def step(self, frame: int, look: Look, null_density: float) -> Step:
        """Take the next frame in."""
        added = self.predict(frame)
        predicted, before = self.T, self.pose_cov
        V, cov = self.state.V, self.state.P[:6, :6].copy()
        rows, flowers = associate(self.state, look, self.scale.sway_m, null_density)
        log_likelihood, nis = self.update(look, rows, flowers) if len(rows) else (0.0, 0.0)
        rows, flowers = self._followed_up(look, rows, flowers, null_density)
        surprise = _pose_surprise(added, cov, self.state.P[:6, :6], se3_log(inverse(V) @ self.state.V))
        return Step(frame, self.T, self.pose_cov, rows, flowers, predicted, before, log_likelihood, nis, *surprise)


def _with_blocks(S: Array, V: Array) -> Array:
    """S (3 m, 3 m) with blocks V (m, 3, 3) added on its diagonal."""
    m = len(V)
    S = S.reshape(m, 3, m, 3)
    S[np.arange(m), :, np.arange(m)] += V
    return S.reshape(3 * m, 3 * m)


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
    P = np.zeros((12, 12) if X is None else (18, 18))
    P[6:12, 6:12] = np.diag(_DIFFUSE**2)
    if X is not None:
        P[12:, 12:] = motion.cov_hand_eye
    state = State(marks, np.eye(4), T_map_camera, X, P)
    track = Track(state, motion, scale, sway_time_s, frame, inverse(motion.camera_in_world(frame, X)))
    if not motion.is_odometry:
        track.predict(frame)
    return track
