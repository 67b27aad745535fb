"""Short pieces of one flower's history, found with no model of the plant: step one of the association.

Each piece is a Kalman filter of a point that all but stands still. In every frame the points are assigned one to one,
the common error of the frame's pose is found from the pieces (robustly) and taken away, and the points are assigned
again. A flower that sways leaves its gate and its piece ends: that is meant, pieces are pure rather than long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.frames import Frames, information, point_jacobian
from cluster_slam.association.lanes import Lanes, assign, near_pairs, ranges
from cluster_slam.association.pose_correction import solve_pose_corrections
from cluster_slam.config import TrackletConfig
from cluster_slam.geometry import Array, adjoint, inverse, rotate_cov, se3_exp, transform
from cluster_slam.records import BoolArray, IntArray

_RUN_UP = 3.0  # times the longest gap in a piece: of a stretch's run-up


@dataclass(frozen=True, slots=True, eq=False)
class Tracklets:
    """``labels`` (m,) piece of each sorted observation, ``n`` pieces, ``innovation_chi2`` (m,), NaN where first."""

    labels: IntArray
    n: int
    innovation_chi2: Array


def relative_pose_cov(
    T: Array, stamps: Array, cov_white: Array, cov_hand_eye: Array | None, cov_step: Array | None, window_s: float
) -> Array:
    """Covariances (n, 6, 6) of each camera pose relative to those of the last ``window_s``.

    ``cov_white`` (6, 6) is what each pose errs for itself, in the camera frame. A wrong hand-eye transform, error xi,
    turns into (I - Ad(D^-1)) xi when the camera has moved by D since the start of the window; ``cov_step``
    (n - 1, 6, 6) of odometry adds up.
    """
    n = len(T)
    out = np.tile(cov_white, (n, 1, 1))
    start = np.searchsorted(stamps, stamps - window_s)
    start = np.minimum(start, np.maximum(np.arange(n) - 1, 0))
    if cov_hand_eye is not None:
        A = np.eye(6) - adjoint(inverse(inverse(T[start]) @ T))
        out += A @ cov_hand_eye @ np.swapaxes(A, -1, -2)
    if cov_step is not None:
        total = np.concatenate([np.zeros((1, 6, 6)), np.cumsum(cov_step, axis=0)])
        out += total - total[start]
    return out


class _Pieces:
    """The living pieces of all lanes, sorted by lane."""

    def __init__(self) -> None:
        self.position = np.empty((0, 3))
        self.cov = np.empty((0, 3, 3))
        self.label = np.empty(0, dtype=np.int64)
        self.lane = np.empty(0, dtype=np.int64)
        self.age = np.empty(0, dtype=np.int64)
        self.last_frame = np.empty(0, dtype=np.int64)

    def keep(self, which: BoolArray | IntArray) -> None:
        """Only these, in this order."""
        self.position, self.cov, self.label = self.position[which], self.cov[which], self.label[which]
        self.lane, self.age, self.last_frame = self.lane[which], self.age[which], self.last_frame[which]

    def add(self, position: Array, cov: Array, label: IntArray, lane: IntArray, frame: IntArray) -> None:
        """New ones, one observation each."""
        self.position = np.concatenate([self.position, position])
        self.cov = np.concatenate([self.cov, cov])
        self.label = np.concatenate([self.label, label])
        self.lane = np.concatenate([self.lane, lane])
        self.age = np.concatenate([self.age, np.ones(len(label), dtype=np.int64)])
        self.last_frame = np.concatenate([self.last_frame, frame])
        self.keep(np.argsort(self.lane, kind="stable"))

    def update(self, rows: IntArray, points: Array, cov: Array, frame: IntArray) -> None:
        """Observed once more, in ``frame`` (q,)."""
        P = self.cov[rows]
        gain = P @ information(P + cov)
        self.position[rows] += (gain @ (points - self.position[rows])[..., None])[..., 0]
        P = P - gain @ P
        self.cov[rows] = 0.5 * (P + np.swapaxes(P, -1, -2))
        self.age[rows] += 1
        self.last_frame[rows] = frame


def build_tracklets(frames: Frames, T: Array, cov_pose: Array, config: TrackletConfig) -> Tracklets:
    """Cut the session into pieces.

    Parameters
    ----------
    frames : Frames
    T : (n, 4, 4) camera poses as they are known.
    cov_pose : (n, 6, 6) how wrong each may be relative to the frames shortly before, camera frame.
    config : TrackletConfig
    """
    return _Builder(frames, T, cov_pose, config).run()


class _Builder:
    """Builds the pieces of many stretches at once, each with a run-up in which the stretch before is joined."""

    def __init__(self, frames: Frames, T: Array, cov_pose: Array, config: TrackletConfig) -> None:
        self.frames, self.T, self.cov_pose, self.config = frames, T, cov_pose, config
        self.prior_information: Array = np.asarray(np.linalg.inv(cov_pose + 1e-18 * np.eye(6)), dtype=np.float64)
        dt = float(np.median(np.diff(frames.stamps))) if frames.n_frames > 1 else 1.0
        gap_s = max(config.max_gap_s, config.max_gap_frames * dt)
        self.lanes = Lanes.of(frames.stamps, _RUN_UP * gap_s, both_ways=False)
        self.pieces = _Pieces()
        self.n_pieces = 0
        self.labels = np.full(len(frames), -1, dtype=np.int64)
        self.innovation = np.full(len(frames), np.nan)
        self.joints: list[tuple[IntArray, IntArray]] = []  # rows of run-ups with their labels there

    def run(self) -> Tracklets:
        """All steps, and the joints."""
        for k in range(int(self.lanes.length.max(initial=0)) if len(self.frames) else 0):
            self._step(k)
        labels, n = self._joined()
        return Tracklets(labels, n, self.innovation)

    def _step(self, k: int) -> None:
        """One frame of every lane."""
        lane = np.flatnonzero(k < self.lanes.length)
        frame = self.lanes.at(k)[lane]
        starts = self.frames.starts
        count = starts[frame + 1] - starts[frame]
        row, at = ranges(starts[frame], count), np.repeat(np.arange(len(lane)), count)
        self._forget(k)
        S = rotate_cov(self.T[frame[at], :3, :3], self.frames.covs[row])
        w, rows, cols, chi2 = self._matched(lane, frame, row, at, S)
        label = np.full(len(row), -1)
        label[cols] = self.pieces.label[rows]
        self.pieces.update(rows, w[cols], S[cols], frame[at[cols]])
        fresh = np.flatnonzero(label < 0)
        label[fresh] = self.n_pieces + np.arange(len(fresh))
        self.n_pieces += len(fresh)
        self.pieces.add(w[fresh], S[fresh], label[fresh], lane[at[fresh]], frame[at[fresh]])
        counts = (k >= self.lanes.run_up[lane])[at]
        self.labels[row[counts]] = label[counts]
        self.innovation[row[cols][counts[cols]]] = chi2[counts[cols]]
        self.joints.append((row[~counts], label[~counts]))

    def _matched(
        self, lane: IntArray, frame: IntArray, row: IntArray, at: IntArray, S: Array
    ) -> tuple[Array, IntArray, IntArray, Array]:
        """Points (p, 3) of the lanes' frames with their poses corrected, and matches of pieces with them."""
        pieces, cfg = self.pieces, self.config
        c, R = self.frames.points[row], self.T[frame, :3, :3]
        w = transform(self.T[frame][at], c)
        J = point_jacobian(R[at], c)
        S_pose = S + J @ self.cov_pose[frame][at] @ np.swapaxes(J, -1, -2)
        of = np.searchsorted(lane, pieces.lane)
        var, var_pose = (cfg.gate_chi2 * np.trace(cov, axis1=1, axis2=2) for cov in (pieces.cov, S_pose))
        near = near_pairs(pieces.position, var, of, w, var_pose, at, len(lane))
        rows, cols, _ = self._assign(near, w, S_pose, of)
        old = pieces.age[rows] >= cfg.min_age
        r, q = rows[old], cols[old]
        residual, cov = pieces.position[r] - w[q], pieces.cov[r] + S[q]
        z = solve_pose_corrections(R, at[q], c[q], residual, cov, self.prior_information[frame])
        w = transform((self.T[frame] @ se3_exp(z))[at], c)
        return w, *self._assign(near, w, S, of)

    def _forget(self, k: int) -> None:
        """Leave out the pieces that were not seen for too long, and let the others walk."""
        pieces, stamps, cfg = self.pieces, self.frames.stamps, self.config
        now, before = self.lanes.at(k), self.lanes.at(k - 1)
        frame = now[pieces.lane]
        alive = frame - pieces.last_frame <= cfg.max_gap_frames
        alive |= stamps[frame] - stamps[pieces.last_frame] <= cfg.max_gap_s
        pieces.keep(alive & (k < self.lanes.length)[pieces.lane])
        dt = (stamps[now] - stamps[before])[pieces.lane]
        pieces.cov += (cfg.walk_m_per_sqrt_s**2 * dt)[:, None, None] * np.eye(3)

    def _assign(
        self, near: tuple[IntArray, IntArray], w: Array, S: Array, of: IntArray
    ) -> tuple[IntArray, IntArray, Array]:
        rows, cols = near
        pieces = self.pieces
        return assign(
            rows, cols, w[cols] - pieces.position[rows], pieces.cov[rows] + S[cols], self.config.gate_chi2, of
        )

    def _joined(self) -> tuple[IntArray, int]:
        """Labels (m,) with each piece that began in a run-up joined to the piece that held its last point there."""
        none = np.empty(0, dtype=np.int64)
        row = np.concatenate([none, *(rows for rows, _ in self.joints)])
        label = np.concatenate([none, *(labels for _, labels in self.joints)])
        last = np.argsort(-row, kind="stable")
        _, first = np.unique(label[last], return_index=True)
        row, label = row[last[first]], label[last[first]]
        before = self.labels[row]
        # Of two that want to go on the same piece, the one that was seen last.
        order = np.argsort(-row, kind="stable")
        _, first = np.unique(before[order], return_index=True)
        parent = np.arange(self.n_pieces)
        parent[label[order[first]]] = before[order[first]]
        while (parent[parent] != parent).any():
            parent = parent[parent]
        used, labels = np.unique(parent[self.labels], return_inverse=True)
        return labels, len(used)
