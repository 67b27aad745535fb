"""The map of rest positions, smoothed as it grows: constant in time and memory however long it goes on.

Unknown are the places of the flowers and, as long as it is not frozen, the tangent x of the hand-eye transform. A
frame's own unknowns, its pose and how far each cluster stands from rest, concern no other frame and are eliminated at
once, in closed form; what is left is a Gaussian factor on the flowers that the frame saw and on x. All is linear in the
places, so factors of frames beyond the window of undo are summed without loss.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray


@dataclass(frozen=True, slots=True, eq=False)
class FrameFactor:
    """What one frame says of hand-eye tangent and flowers: information (6 + 3 k, 6 + 3 k) and vector (6 + 3 k,)."""

    stamp: float
    ids: IntArray  # (k,) flowers
    H: Array
    g: Array


@dataclass(frozen=True, slots=True, eq=False)
class FrameMatches:
    """The matched points of one frame, kept as long as they can be undone.

    ``points`` (q, 3) world, at the pose and hand-eye transform of linearisation; ``J`` (q, 3, 6) by the pose, ``J_x``
    (q, 3, 6) by the hand-eye tangent; ``W`` (q, 3, 3) information; ``cluster`` (q,) with ``sway_var`` (q,) m^2 of each
    one's displacement; ``z`` (6,) the pose's tangent with which the points were placed, prior information (6, 6).
    """

    stamp: float
    ids: IntArray
    points: Array
    J: Array
    J_x: Array
    W: Array
    cluster: IntArray
    sway_var: Array
    z: Array
    prior: Array

    def only(self, keep: BoolArray) -> FrameMatches:
        """The same with some of the matches (q,) only."""
        fields = ("ids", "points", "J", "J_x", "W", "cluster", "sway_var")
        return replace(self, **{name: getattr(self, name)[keep] for name in fields})


def eliminate(m: FrameMatches) -> FrameFactor:
    """The factor of a frame, its pose and displacements eliminated (Schur complement).

    An observation is y = L + d - J dz - J_x x + noise, with dz ~ N(-z, prior^-1) and d ~ N(0, sway_var I).
    """
    q = len(m.ids)
    clusters, s = np.unique(m.cluster, return_inverse=True)
    n_nuisance = 6 + 3 * len(clusters)
    by_nuisance = np.zeros((q, 3, n_nuisance))  # dz and d
    by_nuisance[:, :, :6] = m.J
    by_kept = np.zeros((q, 3, 6 + 3 * q))  # x and L
    by_kept[:, :, :6] = m.J_x
    k = np.arange(q)
    for a in range(3):
        by_nuisance[k, a, 6 + 3 * s + a] = -1.0
        by_kept[k, a, 6 + 3 * k + a] = -1.0
    WN = (m.W @ by_nuisance).reshape(3 * q, n_nuisance)
    WT = (m.W @ by_kept).reshape(3 * q, -1)
    Wy = (m.W @ m.points[..., None]).reshape(3 * q)
    N, T = by_nuisance.reshape(3 * q, -1), by_kept.reshape(3 * q, -1)
    D = N.T @ WN
    D[:6, :6] += m.prior
    var = np.zeros(len(clusters))
    var[s] = m.sway_var
    D[np.arange(6, n_nuisance), np.arange(6, n_nuisance)] += np.repeat(1.0 / var, 3)
    e = -(N.T @ Wy)
    e[:6] -= m.prior @ m.z
    C = T.T @ WN
    gain = np.linalg.solve(D, C.T).T
    H = T.T @ WT - gain @ C.T
    g = -(T.T @ Wy) - gain @ e
    return FrameFactor(m.stamp, m.ids, 0.5 * (H + H.T), g)


class IncrementalMap:
    """Places of flowers by id, and the hand-eye tangent, from a stream of frames."""

    def __init__(self, hand_eye_information: Array | None, window_s: float) -> None:
        """``hand_eye_information`` (6, 6) of the tangent's prior, mean zero; None: it is known, or there is none."""
        self.ids: IntArray = np.zeros(0, dtype=np.int64)
        self.window_s = window_s
        self.H = np.zeros((6, 6))
        self.g = np.zeros(6)
        self.is_frozen = hand_eye_information is None
        self.H += 1e12 * np.eye(6) if hand_eye_information is None else hand_eye_information
        self.recent: deque[tuple[FrameMatches, FrameFactor]] = deque()

    def __len__(self) -> int:
        return len(self.ids)

    def _rows(self, ids: IntArray) -> IntArray:
        order = np.argsort(self.ids)
        return order[np.searchsorted(self.ids[order], ids)]

    def _index(self, ids: IntArray) -> IntArray:
        rows = self._rows(ids)
        return np.concatenate([np.arange(6), (6 + 3 * rows[:, None] + np.arange(3)).ravel()])

    def include(self, flower_id: int, point: Array, cov: Array, J_x: Array) -> None:
        """A new unknown, seen at ``point`` (3,), covariance (3, 3), by observations that are not in the map.

        ``point`` is at the hand-eye transform of linearisation, and moves with its tangent by ``J_x`` (3, 6).
        """
        n = len(self.g)
        H, g = np.zeros((n + 3, n + 3)), np.zeros(n + 3)
        H[:n, :n], g[:n] = self.H, self.g
        W = np.linalg.inv(cov)
        A = np.concatenate([-J_x, np.eye(3)], axis=1)
        index = np.r_[np.arange(6), np.arange(n, n + 3)]
        H[np.ix_(index, index)] += A.T @ W @ A
        g[index] += A.T @ W @ point
        self.H, self.g = H, g
        self.ids = np.append(self.ids, flower_id)

    def remove(self, flower_id: int) -> None:
        """Take a flower out of the map with all that was said of it (it was none)."""
        row = int(self._rows(np.array([flower_id]))[0])
        keep = np.ones(len(self.g), dtype=bool)
        keep[6 + 3 * row : 9 + 3 * row] = False
        for m, _ in list(self.recent):
            if (m.ids == flower_id).any():
                self.replace(m, m.only(m.ids != flower_id))
        # what older frames said of it: condition the rest on nothing, that is, marginalise it out
        a, b = keep, ~keep
        gain = np.linalg.solve(self.H[np.ix_(b, b)], self.H[np.ix_(b, a)]).T
        self.H = self.H[np.ix_(a, a)] - gain @ self.H[np.ix_(b, a)]
        self.g = self.g[a] - gain @ self.g[b]
        self.ids = np.delete(self.ids, row)

    def merge(self, goes: int, stays: int) -> None:
        """Two flowers are one: all that was said of the one was said of the other."""
        r, s = self._rows(np.array([goes, stays])).tolist()
        n = len(self.g)
        P = np.eye(n)
        P[6 + 3 * r : 9 + 3 * r, 6 + 3 * s : 9 + 3 * s] = np.eye(3)
        keep = np.ones(n, dtype=bool)
        keep[6 + 3 * r : 9 + 3 * r] = False
        P = P[:, keep]
        self.H, self.g = P.T @ self.H @ P, P.T @ self.g
        self.ids = np.delete(self.ids, r)
        self.recent = deque((m, f) for m, f in self.recent if goes not in m.ids)

    def add(self, m: FrameMatches) -> None:
        """Take in the matches of a frame."""
        if len(m.ids) == 0:
            return
        factor = eliminate(m)
        self._sum(factor, 1.0)
        self.recent.append((m, factor))
        while self.recent and self.recent[0][0].stamp < m.stamp - self.window_s:
            self.recent.popleft()

    def replace(self, old: FrameMatches, new: FrameMatches) -> None:
        """Undo a frame of the window, and say something else instead."""
        for i, (m, factor) in enumerate(self.recent):
            if m is old:
                self._sum(factor, -1.0)
                if len(new.ids):
                    again = eliminate(new)
                    self._sum(again, 1.0)
                    self.recent[i] = new, again
                else:
                    del self.recent[i]
                return

    def _sum(self, factor: FrameFactor, sign: float) -> None:
        index = self._index(factor.ids)
        self.H[np.ix_(index, index)] += sign * factor.H
        self.g[index] += sign * factor.g

    def freeze(self, x: Array) -> None:
        """From now on the hand-eye tangent is x (6,)."""
        self.H[:6, :6] += 1e12 * np.eye(6)
        self.g[:6] += 1e12 * x
        self.is_frozen = True

    def solve(self) -> tuple[Array, Array, Array]:
        """Hand-eye tangent (6,), places (l, 3), joint covariance (6 + 3 l, 6 + 3 l)."""
        scale = 1.0 / np.sqrt(np.diag(self.H))
        L = np.linalg.cholesky(self.H * scale[:, None] * scale)
        half = np.linalg.solve(L, np.diag(scale))
        cov = half.T @ half
        x = cov @ self.g
        return x[:6], x[6:].reshape(-1, 3), cov
