"""The map of rest positions, smoothed as it grows: constant in time and memory however long it goes on.

Unknown are the places of the flowers and, as long as it is not frozen, the tangent x of the hand-eye transform. A
frame's own unknowns, its pose and how far each cluster stands from rest, concern no other frame and are eliminated at
once, in closed form; what is left is a Gaussian factor on the flowers that the frame saw and on x. All is linear in the
places, so factors of frames beyond the window of undo are summed without loss.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import solve_triangular
from scipy.linalg.lapack import dpotrf, dpotri

from cluster_slam.errors import EstimationError
from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

_ROOM = 64  # flowers, at first; it doubles
_SURE = 1e12  # information of what is known


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
    N = np.zeros((q, 3, n_nuisance))  # by dz and d
    N[:, :, :6] = m.J
    k = np.arange(q)
    for a in range(3):
        N[k, a, 6 + 3 * s + a] = -1.0
    WN = (m.W @ N).reshape(3 * q, n_nuisance)
    flat = N.reshape(3 * q, n_nuisance)
    Wy = (m.W @ m.points[..., None]).reshape(3 * q)
    WJ = (m.W @ m.J_x).reshape(3 * q, 6)
    J_x = m.J_x.reshape(3 * q, 6)
    D = flat.T @ WN
    D[:6, :6] += m.prior
    var = np.zeros(len(clusters))
    var[s] = m.sway_var
    at = np.arange(6, n_nuisance)
    D[at, at] += np.repeat(1.0 / var, 3)
    e = -(flat.T @ Wy)
    e[:6] -= m.prior @ m.z
    C = np.concatenate([J_x.T @ WN, -WN])  # of x and L with the frame's own
    half = solve_triangular(np.linalg.cholesky(D), np.column_stack([C.T, e]), lower=True, check_finite=False)
    H = -(half[:, :-1].T @ half[:, :-1])
    g = -(half[:, :-1].T @ half[:, -1])
    H[:6, :6] += J_x.T @ WJ
    H[:6, 6:] -= WJ.T
    H[6:, :6] -= WJ
    rows = 6 + 3 * k[:, None, None] + np.arange(3)[:, None]
    cols = 6 + 3 * k[:, None, None] + np.arange(3)
    H[rows, cols] += m.W
    g[:6] -= J_x.T @ Wy
    g[6:] += Wy
    return FrameFactor(m.stamp, m.ids, H, g)


class IncrementalMap:
    """Places of flowers by id, and the hand-eye tangent, from a stream of frames."""

    def __init__(self, hand_eye_information: Array | None, window_s: float) -> None:
        """``hand_eye_information`` (6, 6) of the tangent's prior, mean zero; None: it is known, or there is none."""
        self.ids: IntArray = np.zeros(0, dtype=np.int64)
        self.window_s = window_s
        self.is_frozen = hand_eye_information is None
        self._H, self._g = np.zeros((6 + 3 * _ROOM, 6 + 3 * _ROOM)), np.zeros(6 + 3 * _ROOM)
        self._H[:6, :6] = _SURE * np.eye(6) if hand_eye_information is None else hand_eye_information
        self.hand_eye: Array = np.zeros(6)  # the frozen tangent
        self._row: dict[int, int] = {}
        self.recent: deque[tuple[FrameMatches, FrameFactor]] = deque()

    def __len__(self) -> int:
        return len(self.ids)

    def __getstate__(self) -> dict[str, Any]:
        """Written down without what follows from the rest: factors of frames, and room to grow."""
        H, g = self.information
        return dict(self.__dict__, _H=H.copy(), _g=g.copy(), recent=[m for m, _ in self.recent])

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state, recent=deque((m, eliminate(m)) for m in state["recent"]))

    @property
    def information(self) -> tuple[Array, Array]:
        """Information (6 + 3 l, 6 + 3 l) and vector (6 + 3 l,) of hand-eye tangent and places, as ``ids``."""
        n = 6 + 3 * len(self.ids)
        return self._H[:n, :n], self._g[:n]

    def rows(self, ids: IntArray) -> IntArray:
        """Row of each flower (k,) in ``ids``."""
        return np.array([self._row[i] for i in ids.tolist()], dtype=np.int64)

    def _index(self, ids: IntArray) -> IntArray:
        return np.concatenate([np.arange(6), (6 + 3 * self.rows(ids)[:, None] + np.arange(3)).ravel()])

    def include(self, flower_id: int, point: Array, cov: Array, J_x: Array) -> None:
        """A new unknown, seen at ``point`` (3,), covariance (3, 3), by observations that are not in the map.

        ``point`` is at the hand-eye transform of linearisation, and moves with its tangent by ``J_x`` (3, 6).
        """
        n = 6 + 3 * len(self.ids)
        if n + 3 > len(self._g):
            H, g = np.zeros((2 * n, 2 * n)), np.zeros(2 * n)
            H[:n, :n], g[:n] = self._H[:n, :n], self._g[:n]
            self._H, self._g = H, g
        self._H[n : n + 3], self._H[:, n : n + 3], self._g[n : n + 3] = 0.0, 0.0, 0.0
        W = np.linalg.inv(cov)
        A = np.concatenate([-J_x, np.eye(3)], axis=1)
        index = np.r_[np.arange(6), np.arange(n, n + 3)]
        self._H[np.ix_(index, index)] += A.T @ W @ A
        self._g[index] += A.T @ W @ point
        self._row[flower_id] = len(self.ids)
        self.ids = np.append(self.ids, flower_id)

    def remove(self, flower_id: int) -> None:
        """Take a flower out: what the window's frames said of it is undone, what is older is averaged out."""
        for m, _ in list(self.recent):
            if (m.ids == flower_id).any():
                self.replace(m, m.only(m.ids != flower_id))
        H, g = self.information
        row = self._row[flower_id]
        b = np.zeros(len(g), dtype=bool)
        b[6 + 3 * row : 9 + 3 * row] = True
        a = ~b
        gain = np.linalg.solve(H[np.ix_(b, b)], H[np.ix_(b, a)]).T
        self._take(H[np.ix_(a, a)] - gain @ H[np.ix_(b, a)], g[a] - gain @ g[b], np.delete(self.ids, row))

    def merge(self, goes: int, stays: int) -> None:
        """Two flowers are one: all that was said of the one was said of the other."""
        r, s = self._row[goes], self._row[stays]
        H, g = (x.copy() for x in self.information)
        of, to = slice(6 + 3 * r, 9 + 3 * r), slice(6 + 3 * s, 9 + 3 * s)
        H[to] += H[of]
        H[:, to] += H[:, of]
        g[to] += g[of]
        a = np.ones(len(g), dtype=bool)
        a[of] = False
        self._take(H[np.ix_(a, a)], g[a], np.delete(self.ids, r))
        self.recent = deque((m, f) for m, f in self.recent if goes not in m.ids)

    def _take(self, H: Array, g: Array, ids: IntArray) -> None:
        n = len(g)
        self._H[:n, :n], self._g[:n], self.ids = H, g, ids
        self._row = {i: k for k, i in enumerate(ids.tolist())}

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
        self._H[index[:, None], index] += sign * factor.H
        self._g[index] += sign * factor.g

    def freeze(self, x: Array) -> None:
        """From now on the hand-eye tangent is x (6,)."""
        self._H[:6, :6] += _SURE * np.eye(6)
        self._g[:6] += _SURE * x
        self.is_frozen, self.hand_eye = True, x

    def solve(self) -> tuple[Array, Array, Array]:
        """Hand-eye tangent (6,), places (l, 3), joint covariance (6 + 3 l, 6 + 3 l)."""
        H, g = self.information
        cov = _inverse(H)
        x = cov @ g
        return x[:6], x[6:].reshape(-1, 3), cov

    def solve_near(self, ids: IntArray, known: Array) -> tuple[Array, Array]:
        """Places (k, 3) and covariances (k, 3, 3) of these flowers, all others held at ``known`` (l, 3).

        One block of a Gauss-Seidel iteration: it costs what is in view, however large the map is.
        """
        H, g = self.information
        rows = self.rows(ids)
        index = (6 + 3 * rows[:, None] + np.arange(3)).ravel()
        rest = np.concatenate([self.hand_eye, known.ravel()])
        rest[index] = 0.0
        near = H[index]
        cov = _inverse(near[:, index])
        x = cov @ (g[index] - near @ rest)
        k = len(ids)
        blocks = cov.reshape(k, 3, k, 3)
        return x.reshape(k, 3), blocks[np.arange(k), :, np.arange(k)]


def _inverse(H: Array) -> Array:
    """Covariance of an information matrix, by Cholesky, each unknown in its own unit."""
    scale = 1.0 / np.sqrt(np.diag(H))
    factor, _ = dpotrf(H * scale[:, None] * scale, lower=1, overwrite_a=1)
    upper, failed = dpotri(factor, lower=1, overwrite_c=1)
    if failed:
        raise EstimationError("the map's information matrix is not positive definite")
    cov = np.tril(upper) + np.tril(upper, -1).T
    return np.asarray(cov * scale[:, None] * scale)
