"""What a track believes: the camera's pose, the mounting, and how far clusters and flowers stand from the map.

The state holds tangents of the camera pose (z), of ``T_map_world`` (w, where the given poses are absolute) and of the
hand-eye transform (x, where the poses are the flange's), of each cluster met so far two displacements: one that stays
(b: how wrong the map has it) and one that comes and goes (s: sway), and of each flower met so far how wrong the map has
its place in the cluster (f). A flower met in a frame depends on z and on its own b, s and f only, so products with the
Jacobian are gathered from rows of the covariance; the Jacobian itself is never written out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg.blas import dsyrk

from cluster_slam.geometry import Array, inverse, se3_exp, skew, transform
from cluster_slam.localisation.landmarks import LEAST_SIGMA_M, Landmarks
from cluster_slam.records import IntArray

_BLOCK = 64
_NONE = -1  # column of what was not met yet


@dataclass(slots=True, eq=False)
class State:
    """Means, and the covariance ``P`` (d, d) of all of them together."""

    marks: Landmarks
    T: Array  # (4, 4) T_map_camera
    W: Array | None  # (4, 4) T_map_world
    X: Array | None  # (4, 4) T_flange_camera
    P: Array
    d: Array = field(default_factory=lambda: np.zeros(0))  # (d,) displacements at their columns; zero before
    cluster_at: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # (c,) column of b; s follows
    flower_at: IntArray = field(default_factory=lambda: np.zeros(0, np.int64))  # (f,) column of f

    def __post_init__(self) -> None:
        self.d = np.zeros(len(self.P))
        self.cluster_at = np.full(self.marks.n_clusters, _NONE)
        self.flower_at = np.full(len(self.marks), _NONE)

    @property
    def pose_cov(self) -> Array:
        return self.P[:6, :6]

    def meet(self, clusters: IntArray, sway_m: float) -> None:
        """Columns for clusters (k,) that are new, with all of their flowers but those that the map has exact."""
        marks = self.marks
        new = clusters[self.cluster_at[clusters] == _NONE]
        if len(new) == 0:
            return
        flowers = np.flatnonzero(np.isin(marks.cluster, new))
        wrong = flowers[np.trace(marks.covs[flowers], axis1=1, axis2=2) > 3.0 * (2.0 * LEAST_SIGMA_M) ** 2]
        sway = np.broadcast_to(sway_m**2 * np.eye(3), (len(new), 3, 3))
        both = np.stack([marks.shared_covs[new], sway], axis=1).reshape(-1, 3, 3)
        columns = self._grow(np.concatenate([both, marks.covs[wrong]]))
        self.cluster_at[new] = columns[: 2 * len(new) : 2]
        self.flower_at[wrong] = columns[2 * len(new) :]

    def _grow(self, covs: Array) -> IntArray:
        """Displacements about zero with covariances (k, 3, 3), put behind the state; the column of each (k,)."""
        at, k = len(self.P), len(covs)
        grown = np.zeros((at + 3 * k, at + 3 * k))
        grown[:at, :at] = self.P
        columns = at + np.arange(3 * k).reshape(k, 3)
        grown[columns[:, :, None], columns[:, None, :]] = covs
        self.P, self.d = grown, np.concatenate([self.d, np.zeros(3 * k)])
        return np.asarray(columns[:, 0], dtype=np.int64)

    def displacements(self) -> Array:
        """Where each cluster (c, 3) stands from its place in the map, m, as far as is known."""
        out = np.zeros((self.marks.n_clusters, 3))
        met = np.flatnonzero(self.cluster_at != _NONE)
        at = self.cluster_at[met, None] + np.arange(3)
        out[met] = self.d[at] + self.d[at + 3]
        return out

    def places(self) -> Array:
        """Where all flowers (f, 3) are expected, map, m."""
        out = self.marks.positions + self.displacements()[self.marks.cluster]
        met = np.flatnonzero(self.flower_at != _NONE)
        out[met] += self.d[self.flower_at[met, None] + np.arange(3)]
        return out

    def predicted_covs(self, flowers: IntArray, places: Array, sway_m: float) -> tuple[Array, Array, Array]:
        """How far flowers (m,) may be from where the camera is expected to see them, at ``places`` (m, 3), map.

        Three covariances (m, 3, 3): of all together, of what a cluster has in common, and of the flower in its cluster.
        What pose and displacements have in common is taken out: in an old map both are far off, but not one from
        the other.
        """
        R = self.T[:3, :3]
        of, own_at = self.cluster_at[self.marks.cluster[flowers]], self.flower_at[flowers]
        met, own_met = of != _NONE, own_at != _NONE
        A = np.zeros((len(flowers), 3, 15))
        A[:, :, :3], A[:, :, 3:6] = -R @ skew(transform(inverse(self.T), places)), R
        A[met, :, 6:9] = A[met, :, 9:12] = -np.eye(3)
        columns = np.zeros((len(flowers), 15), np.int64)
        columns[:, :6] = np.arange(6)
        columns[met, 6:12] = of[met, None] + np.arange(6)
        columns[own_met, 12:] = own_at[own_met, None] + np.arange(3)
        P = self.P[columns[:, :, None], columns[:, None, :]]
        prior = self.marks.shared_covs[self.marks.cluster[flowers]] + sway_m**2 * np.eye(3)
        common = A @ P @ np.swapaxes(A, 1, 2) + np.where(met[:, None, None], 0.0, prior)
        own = np.where(own_met[:, None, None], P[:, 12:, 12:], self.marks.covs[flowers])
        A[own_met, :, 12:] = -np.eye(3)
        total = A @ P @ np.swapaxes(A, 1, 2) + np.where(met[:, None, None], 0.0, prior)
        total += np.where(own_met[:, None, None], 0.0, self.marks.covs[flowers])
        return total, common, own

    def sight(self, flowers: IntArray) -> Sight:
        """How flowers that were met are seen in the camera frame."""
        shown = self.marks.positions[flowers] + self.displacements()[self.marks.cluster[flowers]]
        own_at = self.flower_at[flowers]
        met = np.flatnonzero(own_at != _NONE)
        shown[met] += self.d[own_at[met, None] + np.arange(3)]
        h = transform(inverse(self.T), shown)
        J = np.concatenate([skew(h), np.broadcast_to(-np.eye(3), (len(h), 3, 3))], axis=-1)
        at = self.cluster_at[self.marks.cluster[flowers], None] + np.arange(3)
        return Sight(h, J, self.T[:3, :3].T, at, own_at[met, None] + np.arange(3), met)

    def lessen(self, white: Array) -> None:
        """Take white' white, white (k, d), off the covariance."""
        both: Array = dsyrk(-1.0, white.T, beta=1.0, c=self.P.T, lower=1, overwrite_c=1).T  # its upper triangle
        for i in range(0, len(both), _BLOCK):  # the lower one, without a second pass over all
            j = min(i + _BLOCK, len(both))
            both[i:j, i:j] = np.triu(both[i:j, i:j]) + np.triu(both[i:j, i:j], 1).T
            both[j:, i:j] = both[i:j, j:].T
        self.P = both

    def move(self, begin: tuple[Array, Array | None, Array | None, Array], moved: Array) -> None:
        """Put T, W, X and d to where they began and a change (d,) of the whole state from there."""
        T, W, X, d = begin
        self.T = T @ se3_exp(moved[:6])
        at = 6
        if W is not None:
            self.W = W @ se3_exp(moved[at : at + 6])
            at += 6
        if X is not None:
            self.X = X @ se3_exp(moved[at : at + 6])
            at += 6
        self.d = d + np.concatenate([np.zeros(at), moved[at:]])


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """The linearised view of m flowers: where each is in the camera, and how that depends on the state."""

    h: Array  # (m, 3) expected, camera, m
    J: Array  # (m, 3, 6) by the camera pose
    Rt: Array  # (3, 3) by displacements: map to camera
    at: IntArray  # (m, 3) columns of b; those of s are 3 further on
    own_at: IntArray  # (k, 3) columns of f ...
    met: IntArray  # (k,) ... of those flowers that have one

    def rows(self, P: Array) -> Array:
        """H P (3 m, d) for a symmetric P (d, d)."""
        shifted = P[self.at] + P[self.at + 3]
        shifted[self.met] += P[self.own_at]
        return np.asarray((self.J @ P[:6] + self.Rt @ shifted).reshape(-1, len(P)))

    def covs(self, HP: Array) -> Array:
        """H P H' (3 m, 3 m) from H P."""
        by_pose = HP[:, :6] @ self.J.reshape(-1, 6).T
        shifted = HP[:, self.at] + HP[:, self.at + 3]  # (3 m, m, 3)
        shifted[:, self.met] += HP[:, self.own_at]
        return np.asarray(by_pose + (shifted @ self.Rt.T).reshape(len(HP), -1))

    def shaken(self, HP: Array, S: Array, added: Array) -> tuple[Array, Array]:
        """H P and H P H' after the sway of each flower's cluster may be larger by variances ``added`` (m,)."""
        m, rows = len(self.h), HP.reshape(len(self.h), 3, -1)
        for axis in range(3):
            rows[np.arange(m), :, self.at[:, axis] + 3] += added[:, None] * self.Rt[:, axis]
        together = np.where(self.at[:, :1] == self.at[:, 0], added, 0.0)
        blocks = S.reshape(m, 3, m, 3)
        for axis in range(3):
            blocks[:, axis, :, axis] += together
        return HP, S

    def times(self, moved: Array) -> Array:
        """H v (3 m,) for a change v (d,) of the state."""
        shifted = moved[self.at] + moved[self.at + 3]
        shifted[self.met] += moved[self.own_at]
        return np.asarray((self.J @ moved[:6] + shifted @ self.Rt.T).ravel())
