"""What a track believes: the camera's pose, where its world lies in the map, the mounting, clusters and flowers.

Everything that a frame sees is kept in the frame of the session's world: the camera (z, the tangent of
``T_world_camera``) and for each cluster met so far its place (b) and how far it is from that just now (s: sway).
Of each flower met so far there is how wrong the map has its place in the cluster (f). ``T_map_world`` (w) turns the
flowers about their clusters and otherwise comes in only when a cluster is met: the map says where its place is, as well
as the map knows. So no frame can tell how the map as a whole is off. Were all kept as displacements from the map frames
would seem to: the linearised view of a map that is centimetres off is another one in each of them (Huang, Mourikis and
Roumeliotis, "Observability-based rules for designing consistent EKF SLAM estimators", 2010).

A flower depends on z, w and on its own b, s and f only, so products with the Jacobian are gathered from rows of the
covariance; the Jacobian itself is never written out.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg.blas import dsyrk

from cluster_slam.geometry import Array, adjoint, inverse, se3_exp, skew, transform
from cluster_slam.localisation.landmarks import LEAST_SIGMA_M, Landmarks
from cluster_slam.records import IntArray

_BLOCK = 64
_NONE = -1  # column of what was not met yet
_W = slice(6, 12)  # columns of w; z stands before, x behind
_AXES = np.arange(3)

Means = tuple[Array, Array, Array | None, Array]


@dataclass(slots=True, eq=False)
class State:
    """Means, and the covariance ``P`` (d, d) of all of them together. The world's origin is where the track began."""

    marks: Landmarks
    V: Array  # (4, 4) T_world_camera
    W: Array  # (4, 4) T_map_world
    X: Array | None  # (4, 4) T_flange_camera
    P: Array
    d: Array = field(init=False)  # (d,) of b, s and f at their columns; zero before
    cluster_at: IntArray = field(init=False)  # (c,) column of b; s follows
    flower_at: IntArray = field(init=False)  # (f,) column of f

    def __post_init__(self) -> None:
        self.d = np.zeros(len(self.P))
        self.cluster_at = np.full(self.marks.n_clusters, _NONE)
        self.flower_at = np.full(len(self.marks), _NONE)

    @property
    def T(self) -> Array:
        """``T_map_camera`` (4, 4)."""
        return self.W @ self.V

    @property
    def pose_cov(self) -> Array:
        """Covariance (6, 6) of ``T``, tangent on the right."""
        J = np.concatenate([np.eye(6), adjoint(inverse(self.V))], axis=1)
        cov: Array = J @ self.P[:12, :12] @ J.T
        return 0.5 * (cov + cov.T)

    @property
    def means(self) -> Means:
        return self.V, self.W, self.X, self.d

    def meet(self, clusters: IntArray, sway_m: float) -> None:
        """Columns for clusters (k,) that are new, with all of their flowers but those that the map has exact."""
        marks = self.marks
        new = clusters[self.cluster_at[clusters] == _NONE]
        if len(new) == 0:
            return
        flowers = np.flatnonzero(np.isin(marks.cluster, new))
        wrong = flowers[np.trace(marks.covs[flowers], axis1=1, axis2=2) > 3.0 * (2.0 * LEAST_SIGMA_M) ** 2]
        n, k = len(self.P), len(new)
        where = transform(inverse(self.W), marks.centres[new])
        R = self.W[:3, :3]
        self._grow(3 * (2 * k + len(wrong)))
        b = n + 6 * np.arange(k)[:, None] + _AXES
        f = n + 6 * k + 3 * np.arange(len(wrong))[:, None] + _AXES
        self._place(b, where, R.T @ marks.shared_covs[new] @ R)
        self.P[b + 3, b + 3] = sway_m**2
        self.P[f[:, :, None], f[:, None]] = marks.covs[wrong]
        self.cluster_at[new], self.flower_at[wrong] = b[:, 0], f[:, 0]

    def _grow(self, n: int) -> None:
        grown = np.zeros((len(self.P) + n, len(self.P) + n))
        grown[: len(self.P), : len(self.P)] = self.P
        self.P, self.d = grown, np.concatenate([self.d, np.zeros(n)])

    def _place(self, b: IntArray, where: Array, own_covs: Array) -> None:
        """Clusters (k,) come to stand where the map has them as seen through W: b = W^-1 (place + its error)."""
        G = _by_world(where).reshape(-1, 6)
        n, at = int(b[0, 0]), b.ravel()
        known = G @ self.P[_W, :n]
        self.P[at, :n], self.P[:n, at] = known, known.T
        self.P[at[:, None], at] = known[:, _W] @ G.T
        self.P[b[:, :, None], b[:, None]] += own_covs
        self.d[b] = where

    def offsets(self, flowers: IntArray) -> Array:
        """Flowers (m, 3) from their clusters' places, along the world's axes, m."""
        out = self.marks.positions[flowers] - self.marks.centres[self.marks.cluster[flowers]]
        met = np.flatnonzero(self.flower_at[flowers] != _NONE)
        out[met] += self.d[self.flower_at[flowers[met], None] + _AXES]
        return np.asarray(out @ self.W[:3, :3])

    def places(self, flowers: IntArray) -> Array:
        """Where flowers (m, 3) are expected, world, m."""
        at = self.cluster_at[self.marks.cluster[flowers], None] + _AXES
        met = at[:, :1] != _NONE
        centres = transform(inverse(self.W), self.marks.centres)[self.marks.cluster[flowers]]
        return np.where(met, self.d[at] + self.d[at + 3], centres) + self.offsets(flowers)

    def predicted_covs(self, flowers: IntArray, places: Array, sway_m: float) -> tuple[Array, Array, Array]:
        """How far flowers (m,) may be from where the camera is expected to see them, at ``places`` (m, 3), world.

        Three covariances (m, 3, 3): of all together, of what a cluster has in common, and of the flower in its cluster.
        """
        R, Rw, marks = self.V[:3, :3], self.W[:3, :3], self.marks
        of, own_at = self.cluster_at[marks.cluster[flowers]], self.flower_at[flowers]
        met, own_met = of != _NONE, own_at != _NONE
        A = np.zeros((len(flowers), 3, 21))
        A[:, :, :3], A[:, :, 3:6] = -R @ skew(transform(inverse(self.V), places)), R
        A[:, :, _W] = -_by_world(places)
        A[met, :, 6:9], A[met, :, 9:12] = -skew(self.offsets(flowers[met])), 0.0
        A[met, :, 12:15] = A[met, :, 15:18] = -np.eye(3)
        columns = np.zeros((len(flowers), 21), np.int64)
        columns[:, :12] = np.arange(12)
        columns[met, 12:18] = of[met, None] + np.arange(6)
        columns[own_met, 18:] = own_at[own_met, None] + _AXES
        P = self.P[columns[:, :, None], columns[:, None, :]]
        prior = Rw.T @ marks.shared_covs[marks.cluster[flowers]] @ Rw + sway_m**2 * np.eye(3)
        outside = np.where(met[:, None, None], 0.0, prior)
        AP = A @ P
        common = AP @ np.swapaxes(A, 1, 2) + outside
        own = Rw.T @ np.where(own_met[:, None, None], P[:, 18:, 18:], marks.covs[flowers]) @ Rw
        both = np.where(own_met[:, None, None], -AP[:, :, 18:] @ Rw, 0.0)
        return common + own + both + np.swapaxes(both, 1, 2), common, own

    def most_off(self, sway_m: float) -> float:
        """A bound on the variance (trace, m^2) of how far a flower may be from where it is expected, camera aside."""
        marks = self.marks
        at = self.cluster_at[self.cluster_at != _NONE, None] + np.arange(6)
        met = 2.0 * float(self.P[at, at].sum(1).max()) if len(at) else 0.0
        G = _by_world(transform(inverse(self.W), marks.centres[self.cluster_at == _NONE]))
        by_world = float(((G @ self.P[_W, _W]) * G).sum((1, 2)).max()) if len(G) else 0.0
        unmet = by_world + float(np.trace(marks.shared_covs, axis1=1, axis2=2).max()) + 3.0 * sway_m**2
        return max(met, unmet) + float(np.trace(marks.covs, axis1=1, axis2=2).max())

    def sight(self, flowers: IntArray) -> Sight:
        """How flowers that were met are seen in the camera frame."""
        offsets, own_at = self.offsets(flowers), self.flower_at[flowers]
        met = np.flatnonzero(own_at != _NONE)
        at = self.cluster_at[self.marks.cluster[flowers], None] + _AXES
        h = transform(inverse(self.V), self.d[at] + self.d[at + 3] + offsets)
        Rt = self.V[:3, :3].T
        J = np.concatenate([skew(h), np.broadcast_to(-np.eye(3), (len(h), 3, 3)), Rt @ skew(offsets)], axis=-1)
        return Sight(h, J, Rt, Rt @ self.W[:3, :3].T, at, own_at[met, None] + _AXES, met)

    def lessen(self, white: Array) -> None:
        """Take white' white, white (k, d), off the covariance."""
        both: Array = dsyrk(-1.0, white.T, beta=1.0, c=self.P.T, lower=1, overwrite_c=1).T  # its upper triangle
        for i in range(0, len(both), _BLOCK):  # the lower one, without a second pass over all
            j = min(i + _BLOCK, len(both))
            both[i:j, i:j] = np.triu(both[i:j, i:j]) + np.triu(both[i:j, i:j], 1).T
            both[j:, i:j] = both[i:j, j:].T
        self.P = both

    def move(self, begin: Means, moved: Array) -> None:
        """Put the means to where they began and a change (d,) of the whole state from there."""
        V, W, X, d = begin
        self.V, self.W = V @ se3_exp(moved[:6]), W @ se3_exp(moved[_W])
        n = 12
        if X is not None:
            self.X = X @ se3_exp(moved[12:18])
            n = 18
        self.d = d + np.concatenate([np.zeros(n), moved[n:]])


def _by_world(places: Array) -> Array:
    """Derivative (k, 3, 6) of W^-1 p by the tangent of W, for places (k, 3) = W^-1 p."""
    return np.concatenate([skew(places), np.broadcast_to(-np.eye(3), (len(places), 3, 3))], axis=-1)


@dataclass(frozen=True, slots=True, eq=False)
class Sight:
    """The linearised view of m flowers: where each is in the camera, and how that depends on the state."""

    h: Array  # (m, 3) expected, camera, m
    J: Array  # (m, 3, 9) by the camera and the orientation of the world, the first nine columns
    Rt: Array  # (3, 3) by b and s: world to camera
    Rt_own: Array  # (3, 3) by f: map to camera
    at: IntArray  # (m, 3) columns of b; those of s are 3 further on
    own_at: IntArray  # (k, 3) columns of f ...
    met: IntArray  # (k,) ... of those flowers that have one

    def rows(self, P: Array) -> Array:
        """H P (3 m, d) for a symmetric P (d, d)."""
        out = self.J @ P[:9] + self.Rt @ (P[self.at] + P[self.at + 3])
        out[self.met] += self.Rt_own @ P[self.own_at]
        return np.asarray(out.reshape(-1, len(P)))

    def covs(self, HP: Array) -> Array:
        """H P H' (3 m, 3 m) from H P."""
        out = (HP[:, self.at] + HP[:, self.at + 3]) @ self.Rt.T  # (3 m, m, 3)
        out[:, self.met] += HP[:, self.own_at] @ self.Rt_own.T
        return np.asarray(HP[:, :9] @ self.J.reshape(-1, 9).T + out.reshape(len(HP), -1))

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
        out = self.J @ moved[:9] + (moved[self.at] + moved[self.at + 3]) @ self.Rt.T
        out[self.met] += moved[self.own_at] @ self.Rt_own.T
        return np.asarray(out.ravel())
