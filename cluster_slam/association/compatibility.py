"""Which landmarks of two maps are the same, judged jointly: maps bend where odometry was all that held them.

A map that was itself joined over a gap is bent there, by far more than its landmarks are uncertain among their
neighbours. So landmarks are compared one after the other, the surest first, and each match straightens both maps
before the next is judged (compare Neira and Tardos, "Data association in stochastic mapping using the joint
compatibility test", 2001). A match counts by its likelihood against a landmark that is new.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, se3_exp, skew
from cluster_slam.records import IntArray

_GATE = 16.0  # chi-square of a match, three degrees of freedom
_FLOOR = 1e-8  # m^2: two landmarks that are one may still differ
_LOG_2PI_3 = 3.0 * float(np.log(2.0 * np.pi))


@dataclass(frozen=True, slots=True, eq=False)
class Side:
    """Landmarks (l, 3) of a map seen from the pose beside the gap, and their joint covariance (3 l, 3 l)."""

    places: Array
    cov: Array

    @property
    def var(self) -> Array:
        """How well each is known (l,), m^2: in the two directions in which it is known worst."""
        blocks = _blocks(self.cov)
        values: Array = np.linalg.eigvalsh(blocks[np.arange(len(blocks)), np.arange(len(blocks))])[:, 1:].mean(axis=1)
        return values

    def distances(self) -> tuple[Array, Array]:
        """Distances (l, l) between the landmarks, and their variances."""
        between = self.places[:, None] - self.places
        length = np.linalg.norm(between, axis=-1)
        u = between / np.maximum(length, 1e-9)[..., None]
        blocks = _blocks(self.cov)
        own = blocks[np.arange(len(blocks)), np.arange(len(blocks))]
        cov = own[:, None] + own[None] - blocks - np.swapaxes(blocks, -1, -2)
        return length, np.einsum("ijx,ijxy,ijy->ij", u, cov, u)


def _blocks(cov: Array) -> Array:
    """A joint covariance (3 l, 3 l) as (l, l, 3, 3)."""
    n = len(cov) // 3
    return cov.reshape(n, 3, n, 3).transpose(0, 2, 1, 3)


@dataclass(frozen=True, slots=True, eq=False)
class Matches:
    """Landmarks (k, 2) of both sides that are the same, the motion z (d,) in the gap, and what speaks for it."""

    pairs: IntArray
    z: Array
    score: float  # twice the log-likelihood ratio to all landmarks being new


def match_jointly(
    a: Side,
    b: Side,
    start: Matches,
    prior: Array,
    basis: Array,
    log_volume: float,
    but_not: tuple[int, int] | None = None,
) -> Matches:
    """Match the landmarks of two sides, ``start`` being given; ``prior`` (d, d) of the motion beside odometry.

    ``log_volume``: log of the space (m^3) in which a new landmark may be found. ``but_not``: a pair that is not one.
    """
    joint = _Joint(a, b, start.z, prior, basis)
    free = np.ones((len(a.places), len(b.places)), dtype=bool)
    if but_not is not None:
        free[but_not] = False
    given, pairs, score = start.pairs.tolist(), [], 0.0
    while free.any():
        chi2, log_det = joint.innovations()
        gain = 2.0 * log_volume - _LOG_2PI_3 - chi2 - log_det
        if given:
            i, j = given.pop(0)
        else:
            gain[np.logical_not(free) | (chi2 > _GATE)] = -np.inf
            i, j = divmod(int(gain.argmax()), len(b.places))
            if gain[i, j] <= 0.0:
                break
        score += float(gain[i, j])
        pairs.append((i, j))
        joint.update(i, j)
        free[i], free[:, j] = False, False
    return Matches(np.array(pairs, dtype=np.int64).reshape(-1, 2), joint.z, score)


def decided_otherwise(
    a: Side, b: Side, found: list[Matches], prior: Array, basis: Array, log_volume: float
) -> list[Matches]:
    """Matches beside those found: each decision after the first two is taken back once, and the rest made anew.

    What is surest at a time may be wrong, and then all that follows is.
    """
    out = []
    for match in found:
        for k in range(2, len(match.pairs)):
            start, pair = Matches(match.pairs[:k], match.z, 0.0), (int(match.pairs[k, 0]), int(match.pairs[k, 1]))
            out.append(match_jointly(a, b, start, prior, basis, log_volume, pair))
    return out


class _Joint:
    """Gaussian of the landmarks of both sides, in the frame of the first, and of the motion in the gap."""

    def __init__(self, a: Side, b: Side, z: Array, prior: Array, basis: Array) -> None:
        n, m, d = len(a.places), len(b.places), len(z)
        E = se3_exp(basis @ z)
        eye = np.broadcast_to(np.eye(3), (m, 3, 3))
        J = (E[:3, :3] @ (np.concatenate([-skew(b.places), eye], axis=-1) @ basis)).reshape(3 * m, d)
        R = np.kron(np.eye(m), E[:3, :3])
        cov = np.zeros((3 * (n + m) + d,) * 2)
        A, B, Z = slice(0, 3 * n), slice(3 * n, 3 * (n + m)), slice(3 * (n + m), None)
        cov[A, A], cov[Z, Z] = a.cov, prior
        cov[B, B] = R @ b.cov @ R.T + J @ prior @ J.T
        cov[B, Z] = J @ prior
        cov[Z, B] = cov[B, Z].T
        moved = (b.places @ E[:3, :3].T + E[:3, 3]).ravel() - J @ z
        self.n, self.m, self.at = n, m, z
        self.mean, self.cov = np.concatenate([a.places.ravel(), moved, -z]), cov

    @property
    def z(self) -> Array:
        """The motion in the gap."""
        return np.asarray(self.at + self.mean[3 * (self.n + self.m) :])

    def innovations(self) -> tuple[Array, Array]:
        """Chi-square (n, m) of every pair being one, and the log-determinant of its covariance."""
        k, n = 3 * (self.n + self.m), self.n
        points, blocks = self.mean[:k].reshape(-1, 3), _blocks(self.cov[:k, :k])
        error = points[:n, None] - points[None, n:]
        own = blocks[np.arange(n + self.m), np.arange(n + self.m)]
        across = blocks[:n, n:]
        S = own[:n, None] + own[None, n:] - across - np.swapaxes(across, -1, -2) + _FLOOR * np.eye(3)
        half = np.linalg.cholesky(S)
        white = np.linalg.solve(half, error[..., None])[..., 0]
        return (white**2).sum(-1), 2.0 * np.log(np.einsum("nmii->nmi", half)).sum(-1)

    def update(self, i: int, j: int) -> None:
        """Landmark i of the first is landmark j of the second."""
        p, q = slice(3 * i, 3 * i + 3), slice(3 * (self.n + j), 3 * (self.n + j) + 3)
        PH = self.cov[:, p] - self.cov[:, q]
        S = PH[p] - PH[q] + _FLOOR * np.eye(3)
        gain = np.linalg.solve(S, PH.T).T
        self.mean = self.mean - gain @ (self.mean[p] - self.mean[q])
        self.cov = self.cov - gain @ PH.T
        self.cov = 0.5 * (self.cov + self.cov.T)
