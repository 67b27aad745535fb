"""Short pieces of one flower's history, found with no model of the plant: step one of the association.

Each piece is a Kalman filter of a point that all but stands still. In every frame the points are assigned one to one,
the common error of the frame's pose is found from the pieces (robustly) and taken away, and the points are assigned
again. A flower that sways leaves its gate and its piece ends: that is meant, pieces are pure rather than long.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from cluster_slam.association.frames import Frames, chi2_and_log_det, information, point_jacobian
from cluster_slam.config import TrackletConfig
from cluster_slam.geometry import Array, adjoint, inverse, rotate_cov, se3_exp, transform
from cluster_slam.records import BoolArray, IntArray


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


def solve_pose_correction(
    R: Array, c: Array, residual: Array, cov: Array, information_prior: Array, n_iterations: int = 4
) -> Array:
    """Tangent z (6,) of one frame's pose such that ``residual`` (q, 3) = target - T c is explained, Cauchy-robust.

    ``cov`` (q, 3, 3) in the world; the prior is zero with information (6, 6).
    """
    J = point_jacobian(R, c)
    W = information(cov)
    JW = np.swapaxes(J, -1, -2) @ W
    z: Array = np.zeros(6)
    for _ in range(n_iterations):
        r = residual - J @ z
        weight = 1.0 / (1.0 + np.einsum("qi,qij,qj->q", r, W, r) / 3.0)
        H = np.tensordot(weight, JW @ J, axes=1) + information_prior
        g = np.tensordot(weight, (JW @ residual[..., None])[..., 0], axes=1)
        z = np.linalg.solve(H, g).astype(np.float64)
    return z


class _Pieces:
    """The living pieces, as arrays that grow by doubling."""

    def __init__(self) -> None:
        self.position = np.empty((0, 3))
        self.cov = np.empty((0, 3, 3))
        self.label = np.empty(0, dtype=np.int64)
        self.age = np.empty(0, dtype=np.int64)
        self.last_frame = np.empty(0, dtype=np.int64)

    def keep(self, alive: BoolArray) -> None:
        self.position, self.cov, self.label = self.position[alive], self.cov[alive], self.label[alive]
        self.age, self.last_frame = self.age[alive], self.last_frame[alive]

    def add(self, position: Array, cov: Array, label: IntArray, frame: int) -> None:
        self.position = np.concatenate([self.position, position])
        self.cov = np.concatenate([self.cov, cov])
        self.label = np.concatenate([self.label, label])
        self.age = np.concatenate([self.age, np.ones(len(label), dtype=np.int64)])
        self.last_frame = np.concatenate([self.last_frame, np.full(len(label), frame)])

    def update(self, rows: IntArray, points: Array, cov: Array, frame: int) -> None:
        gain = self.cov[rows] @ information(self.cov[rows] + cov)
        self.position[rows] += (gain @ (points - self.position[rows])[..., None])[..., 0]
        P = self.cov[rows] - gain @ self.cov[rows]
        self.cov[rows] = 0.5 * (P + np.swapaxes(P, -1, -2))
        self.age[rows] += 1
        self.last_frame[rows] = frame


def match(
    predicted: Array, predicted_cov: Array, points: Array, cov: Array, gate_chi2: float
) -> tuple[IntArray, IntArray, Array]:
    """One-to-one assignment (rows, columns, chi2) that gains most, where a pair inside the gate gains gate - chi2."""
    none = np.empty(0, dtype=np.int64)
    if len(predicted) == 0 or len(points) == 0:
        return none, none, np.empty(0)
    diff = points[None] - predicted[:, None]
    reach = np.sqrt(gate_chi2 * (np.trace(predicted_cov, axis1=1, axis2=2)[:, None] + np.trace(cov, axis1=1, axis2=2)))
    rows, cols = np.nonzero((diff * diff).sum(-1) < reach * reach)
    if len(rows) == 0:
        return none, none, np.empty(0)
    chi2, _ = chi2_and_log_det(diff[rows, cols], predicted_cov[rows] + cov[cols])
    inside = chi2 < gate_chi2
    rows, cols, chi2 = rows[inside], cols[inside], chi2[inside]
    used_rows, r = np.unique(rows, return_inverse=True)
    used_cols, c = np.unique(cols, return_inverse=True)
    gain = np.zeros((len(used_rows), len(used_cols)))
    gain[r, c] = gate_chi2 - chi2
    a, b = linear_sum_assignment(gain, maximize=True)
    real = gain[a, b] > 0
    a, b = a[real], b[real]
    return used_rows[a], used_cols[b], gate_chi2 - gain[a, b]


def build_tracklets(frames: Frames, T: Array, cov_pose: Array, config: TrackletConfig) -> Tracklets:
    """Cut the session into pieces.

    Parameters
    ----------
    frames : Frames
    T : (n, 4, 4) camera poses as they are known.
    cov_pose : (n, 6, 6) how wrong each may be relative to the frames shortly before, camera frame.
    config : TrackletConfig
    """
    labels = np.full(len(frames), -1, dtype=np.int64)
    innovation = np.full(len(frames), np.nan)
    pieces = _Pieces()
    n_pieces = 0
    world = transform(T[frames.frame], frames.points)
    world_cov = rotate_cov(T[frames.frame, :3, :3], frames.covs)
    prior_information = np.linalg.inv(cov_pose + 1e-18 * np.eye(6))
    stamps = frames.stamps
    for i in range(frames.n_frames):
        here = frames.of(i)
        dt = stamps[i] - stamps[i - 1] if i else 0.0
        alive = (i - pieces.last_frame <= config.max_gap_frames) | (
            stamps[i] - stamps[pieces.last_frame] <= config.max_gap_s
        )
        if not alive.all():
            pieces.keep(alive)
        pieces.cov += config.walk_m_per_sqrt_s**2 * dt * np.eye(3)
        c, w, S = frames.points[here], world[here], world_cov[here]
        J = point_jacobian(T[i, :3, :3], c)
        rows, cols, _ = match(
            pieces.position, pieces.cov, w, S + J @ cov_pose[i] @ np.swapaxes(J, -1, -2), config.gate_chi2
        )
        old = pieces.age[rows] >= config.min_age
        if old.any():
            r, k = rows[old], cols[old]
            z = solve_pose_correction(
                T[i, :3, :3], c[k], pieces.position[r] - w[k], pieces.cov[r] + S[k], prior_information[i]
            )
            w = transform(T[i] @ se3_exp(z), c)
        rows, cols, chi2 = match(pieces.position, pieces.cov, w, S, config.gate_chi2)
        pieces.update(rows, w[cols], S[cols], i)
        labels[here.start + cols] = pieces.label[rows]
        innovation[here.start + cols] = chi2
        fresh = np.setdiff1d(np.arange(len(c)), cols)
        new_labels = n_pieces + np.arange(len(fresh))
        labels[here.start + fresh] = new_labels
        pieces.add(w[fresh], S[fresh], new_labels, i)
        n_pieces += len(fresh)
    return Tracklets(labels, n_pieces, innovation)
