"""One Gauss-Newton step where each pose is known for itself: all but places and hand-eye eliminated in closed form.

Given the places, displacements depend on nothing but their frame's pose (and on the mean of their stretch), poses on
nothing else. So blocks of 3 x 3 and 6 x 6 are eliminated for all frames at once, then the means of the stretches as
time goes on, a chunk of frames after the other; places and hand-eye transform are left. It is what GTSAM does with the
whole graph (`cluster_slam.graph.whole`), without its bookkeeping: the same numbers, several times faster.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import cho_factor, cho_solve

from cluster_slam.association.frames import information
from cluster_slam.association.lanes import pairs_in_lanes, sums
from cluster_slam.geometry import Array
from cluster_slam.graph.fronts import Carried, Front, Unknowns, eliminate
from cluster_slam.graph.linearised import Increments, Linearised, Links
from cluster_slam.records import IntArray

_CHUNK = 1000  # observations that are worked on at once, about ...
_MOST_FRAMES = 120  # ... and from so many frames at most


def solve_step(links: Links, at: Linearised) -> Increments:
    """The Gauss-Newton step. Raises `numpy.linalg.LinAlgError` where the problem is singular."""
    return _Elimination(links, at).increments()


def remaining(links: Links, at: Linearised) -> Array:
    """Information (3 l + k, 3 l + k) of places and hand-eye transform, all else eliminated."""
    S = _Elimination(links, at).remaining()[0]
    return S[:-1, :-1]


class _Elimination:
    """Displacements, then poses, then stretches, then the rest; and back."""

    def __init__(self, links: Links, at: Linearised) -> None:
        self.links, self.at = links, at
        self.k = at.x_information.shape[0]
        self._displacements()
        self._poses()

    def increments(self) -> Increments:
        links, at, n = self.links, self.at, 3 * self.links.n_places
        S, fronts = self.remaining()
        found = cho_solve(cho_factor(S[:-1, :-1]), S[:-1, -1]) if len(S) > 1 else np.empty(0)
        places, x = found[:n].reshape(-1, 3), found[n:]
        b = np.zeros((links.n_stretches, 3))
        for front in reversed(fronts):
            known = np.concatenate([b[front.later].ravel(), places[front.places].ravel(), x])
            b[front.ended] = front.solved(known)
        moved = np.zeros((len(links.stretch), 3))
        within = links.stretch >= 0
        moved[within] = b[links.stretch[within]]
        z = self.z_vector - _times(self.z_by_x, x)
        z -= sums(_times(self.z_by_place, places[links.landmark]), links.frame, links.n_frames)
        z -= sums(_times(self.z_by_b, moved), links.pair_frame, links.n_frames)
        z = _times(np.swapaxes(self.z_root, 1, 2), z)
        d = self.d_mean - _times(self.d_by_pose, z[links.pair_frame])
        d -= sums(_times(self.d_by_place, places[links.landmark]), links.pair, len(d))
        d += at.d_information[:, None] * _times(self.d_cov, moved)
        return Increments(z, d, b, places, x)

    def remaining(self) -> tuple[Array, list[Front]]:
        """Information of places and hand-eye, their vector last, and the stretches on the way to it."""
        S, fronts = self._stretches()
        n = 3 * self.links.n_places
        S[:n, :n] += self.at.place_information * np.eye(n)
        if self.at.tied is not None and self.at.tied_vector is not None:
            S[:n, :n] += self.at.tied
            S[:n, -1] += self.at.tied_vector
        S[n:-1, n:-1] += self.at.x_information
        S[n:-1, -1] += self.at.x_vector
        return S, fronts

    def _displacements(self) -> None:
        """Each given all else: covariance, mean, and what it loses by what it is connected with."""
        links, at, n = self.links, self.at, len(self.links.pair_frame)
        transposed = np.swapaxes(at.A_l, 1, 2)
        self.M = transposed @ at.A_l
        self.z_by_d = transposed @ at.A_z
        vector = sums(_times(transposed, at.r), links.pair, n) - at.d_information[:, None] * at.d
        self.pose_with_d = sums(self.z_by_d, links.pair, n)
        self.d_cov = information(sums(self.M, links.pair, n) + at.d_information[:, None, None] * np.eye(3))
        self.d_mean = _times(self.d_cov, vector)
        self.d_by_pose = self.d_cov @ self.pose_with_d
        self.d_by_place = self.d_cov[links.pair] @ self.M

    def _poses(self) -> None:
        """Each given places, stretches and hand-eye: rows of the square root of the information."""
        links, at, n = self.links, self.at, self.links.n_frames
        seen_from = np.swapaxes(at.A_z, 1, 2)
        with_d = np.swapaxes(self.pose_with_d, 1, 2)
        total = at.z_information + sums(seen_from @ at.A_z, links.frame, n)
        total -= sums(with_d @ self.d_by_pose, links.pair_frame, n)
        vector = at.z_vector + sums(_times(seen_from, at.r), links.frame, n)
        vector -= sums(_times(with_d, self.d_mean), links.pair_frame, n)
        root = np.linalg.inv(np.linalg.cholesky(total))
        with_place = np.swapaxes(self.z_by_d, 1, 2) - with_d[links.pair] @ self.d_by_place
        with_b = at.d_information[:, None, None] * np.swapaxes(self.d_by_pose, 1, 2)
        self.z_root = root
        self.z_vector = _times(root, vector)
        self.z_by_place = root[links.frame] @ with_place
        self.z_by_b = root[links.pair_frame] @ with_b
        self.z_by_x = root @ at.zx_information

    def _stretches(self) -> tuple[Array, list[Front]]:
        """What is left: information (3 l + k + 1, 3 l + k + 1) of places and hand-eye, vector last; and the fronts."""
        links, n = self.links, 3 * self.links.n_places
        S = np.zeros((n + self.k + 1, n + self.k + 1))
        begin, end = np.full(links.n_stretches, links.n_frames), np.full(links.n_stretches, -1)
        within = np.flatnonzero(links.stretch >= 0)
        np.minimum.at(begin, links.stretch[within], links.pair_frame[within])
        np.maximum.at(end, links.stretch[within], links.pair_frame[within])
        fronts: list[Front] = []
        carried = Carried.nothing(self.k + 1)
        step = int(np.clip(_CHUNK * links.n_frames // max(len(links.frame), 1), 1, _MOST_FRAMES))
        for first in range(0, links.n_frames, step):
            last = first + step
            begun = np.flatnonzero((begin >= first) & (begin < last))
            alive = np.concatenate([carried.stretches, begun])
            ended = end[alive] < last
            q = slice(*np.searchsorted(links.frame, [first, last]).tolist())
            places = np.union1d(carried.places, links.landmark[q])
            unknowns = Unknowns(alive[ended], alive[~ended], places, self.k + 1)
            H = self._information(_Chunk.of(links, first, last, begun, unknowns))
            carried.add_to(H, unknowns)
            front, carried, left = eliminate(H, unknowns)
            fronts.append(front)
            where = np.concatenate([(3 * places[:, None] + np.arange(3)).ravel(), np.arange(n, len(S))])
            S[np.ix_(where, where)] += left
        return S, fronts

    def _information(self, chunk: _Chunk) -> Array:
        """Of stretches, places, hand-eye and vector, from one chunk of frames, poses and displacements eliminated."""
        rows, n = self._rows(chunk), 3 * chunk.n_blocks
        H = -rows.T @ rows
        H[:n, :n] += self._blocks(chunk)
        vector = self._vector(chunk)
        H[:n, -1] += vector
        H[-1, :n] += vector
        return H

    def _rows(self, chunk: _Chunk) -> Array:
        """Of the poses: the square root of what they take away."""
        links, q, p, f = self.links, chunk.observations, chunk.pairs, chunk.frames
        n, size = f.stop - f.start, chunk.n_blocks
        row = np.concatenate([links.frame[q], links.pair_frame[p]]) - f.start
        column = np.concatenate([chunk.place, chunk.stretch])
        table = sums(np.concatenate([self.z_by_place[q], self.z_by_b[p]]), row * size + column, n * size)
        table = table.reshape(n, size, 6, 3).transpose(0, 2, 1, 3).reshape(6 * n, 3 * size)
        return np.hstack([table, self.z_by_x[f].reshape(6 * n, self.k), self.z_vector[f].reshape(6 * n, 1)])

    def _blocks(self, chunk: _Chunk) -> Array:
        """Of stretches and places: displacements tie the flowers of a frame and cluster together, and their stretch."""
        links, at, q, p, size = self.links, self.at, chunk.observations, chunk.pairs, chunk.n_blocks
        pair = links.pair[q]
        one, other = pairs_in_lanes(pair - pair[:1], pair - pair[:1], int(np.ptp(pair)) + 1 if len(pair) else 0)
        tied = np.flatnonzero(links.stretch[pair] >= 0)
        b, j = chunk.stretch[np.searchsorted(p, pair[tied])], chunk.place[tied]
        across = at.d_information[pair[tied], None, None] * self.d_by_place[q][tied]
        weight = at.d_information[p, None, None]
        blocks = [
            (chunk.place, chunk.place, self.M[q]),
            (chunk.place[one], chunk.place[other], -self.M[q][one] @ self.d_by_place[q][other]),
            (b, j, across),
            (j, b, np.swapaxes(across, 1, 2)),
            (chunk.stretch, chunk.stretch, weight * np.eye(3) - weight**2 * self.d_cov[p]),
            (chunk.new, chunk.new, at.b_information[chunk.begun, None, None] * np.eye(3)),
        ]
        cell = np.concatenate([row * size + column for row, column, _ in blocks])
        table = sums(np.concatenate([block for _, _, block in blocks]), cell, size * size)
        return table.reshape(size, size, 3, 3).transpose(0, 2, 1, 3).reshape(3 * size, 3 * size)

    def _vector(self, chunk: _Chunk) -> Array:
        at, q, p, begun = self.at, chunk.observations, chunk.pairs, chunk.begun
        of_places = _times(np.swapaxes(at.A_l[q], 1, 2), at.r[q])
        of_places -= _times(self.M[q], self.d_mean[self.links.pair[q]])
        of_stretches = at.d_information[p, None] * (at.d[p] + self.d_mean[p])
        values = np.concatenate([of_places, of_stretches, -at.b_information[begun, None] * at.b[begun]])
        return sums(values, np.concatenate([chunk.place, chunk.stretch, chunk.new]), chunk.n_blocks).ravel()


@dataclass(frozen=True, slots=True, eq=False)
class _Chunk:
    """Some frames with what belongs to them, and in which block of three columns of their front that is."""

    frames: slice
    observations: slice
    pairs: IntArray  # (p,) those that are in a stretch
    begun: IntArray  # (s,) stretches that begin here
    n_blocks: int
    place: IntArray  # block of each observation's place
    stretch: IntArray  # (p,) block of each pair's stretch
    new: IntArray  # (s,) block of each that begins

    @classmethod
    def of(cls, links: Links, first: int, last: int, begun: IntArray, unknowns: Unknowns) -> _Chunk:
        """Frames first..last-1."""
        p0, p1 = np.searchsorted(links.pair_frame, [first, last])
        q = slice(*np.searchsorted(links.frame, [first, last]).tolist())
        pairs = p0 + np.flatnonzero(links.stretch[p0:p1] >= 0)
        return cls(
            frames=slice(first, min(last, links.n_frames)),
            observations=q,
            pairs=pairs,
            begun=begun,
            n_blocks=unknowns.n_blocks,
            place=unknowns.of_places(links.landmark[q]),
            stretch=unknowns.of_stretches(links.stretch[pairs]),
            new=unknowns.of_stretches(begun),
        )


def _times(A: Array, v: Array) -> Array:
    """Products (..., r) of matrices (..., r, c) with vectors (..., c)."""
    product: Array = (A @ v[..., None])[..., 0]
    return product
