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
            chunk = self._chunk(first, last)
            begun = np.flatnonzero((begin >= first) & (begin < last))
            alive = np.concatenate([carried.stretches, begun])
            ended = end[alive] < last
            places = np.union1d(carried.places, self.links.landmark[chunk.observations])
            unknowns = Unknowns(alive[ended], alive[~ended], places, self.k + 1)
            H = self._information(chunk, unknowns, begun)
            carried.add_to(H, unknowns)
            front, carried, left = eliminate(H, unknowns)
            fronts.append(front)
            where = np.concatenate([(3 * places[:, None] + np.arange(3)).ravel(), np.arange(n, len(S))])
            S[np.ix_(where, where)] += left
        return S, fronts

    def _chunk(self, first: int, last: int) -> _Chunk:
        """Frames first..last-1 with all that belongs to them."""
        links = self.links
        p0, p1 = np.searchsorted(links.pair_frame, [first, last])
        q0, q1 = np.searchsorted(links.frame, [first, last])
        return _Chunk(slice(first, min(last, links.n_frames)), slice(int(p0), int(p1)), slice(int(q0), int(q1)))

    def _information(self, chunk: _Chunk, unknowns: Unknowns, begun: IntArray) -> Array:
        """Of stretches, places, hand-eye and vector, from one chunk of frames, poses and displacements eliminated."""
        links, at = self.links, self.at
        q, p, f = chunk.observations, chunk.pairs, chunk.frames
        with_b = p.start + np.flatnonzero(links.stretch[p] >= 0)
        j, b = unknowns.of_places(links.landmark[q]), unknowns.of_stretches(links.stretch[with_b])
        new = unknowns.of_stretches(begun)
        n, size = f.stop - f.start, unknowns.n_blocks
        cell = np.concatenate([(links.frame[q] - f.start) * size + j, (links.pair_frame[with_b] - f.start) * size + b])
        rows = sums(np.concatenate([self.z_by_place[q], self.z_by_b[with_b]]), cell, n * size)
        rows = rows.reshape(n, size, 6, 3).transpose(0, 2, 1, 3).reshape(6 * n, 3 * size)
        rows = np.hstack([rows, self.z_by_x[f].reshape(6 * n, self.k), self.z_vector[f].reshape(6 * n, 1)])
        H = -rows.T @ rows
        # Displacements tie the flowers of one frame and cluster together, and their stretch with them.
        one, other = pairs_in_lanes(links.pair[q] - p.start, links.pair[q] - p.start, p.stop - p.start)
        row, seen = j[one], self.d_by_place[q]
        info = at.d_information[with_b, None, None]
        of_pair = unknowns.of_stretches(links.stretch[links.pair[q]])
        tied = np.flatnonzero(links.stretch[links.pair[q]] >= 0)
        across = at.d_information[links.pair[q][tied], None, None] * seen[tied]
        blocks = [
            (j, j, self.M[q]),
            (row, j[other], -self.M[q][one] @ seen[other]),
            (of_pair[tied], j[tied], across),
            (j[tied], of_pair[tied], np.swapaxes(across, 1, 2)),
            (b, b, info * np.eye(3) - info**2 * self.d_cov[with_b]),
            (new, new, at.b_information[begun, None, None] * np.eye(3)),
        ]
        table = sums(
            np.concatenate([block for _, _, block in blocks]),
            np.concatenate([row * size + column for row, column, _ in blocks]),
            size * size,
        )
        H[: 3 * size, : 3 * size] += table.reshape(size, size, 3, 3).transpose(0, 2, 1, 3).reshape(3 * size, 3 * size)
        vector = sums(
            np.concatenate(
                [
                    _times(np.swapaxes(at.A_l[q], 1, 2), at.r[q]) - _times(self.M[q], self.d_mean[links.pair[q]]),
                    at.d_information[with_b, None] * (at.d[with_b] + self.d_mean[with_b]),
                    -at.b_information[begun, None] * at.b[begun],
                ]
            ),
            np.concatenate([j, b, new]),
            size,
        ).ravel()
        H[: 3 * size, -1] += vector
        H[-1, : 3 * size] += vector
        return H


@dataclass(frozen=True, slots=True)
class _Chunk:
    frames: slice
    pairs: slice
    observations: slice


def _times(A: Array, v: Array) -> Array:
    """Products (..., r) of matrices (..., r, c) with vectors (..., c)."""
    product: Array = (A @ v[..., None])[..., 0]
    return product
