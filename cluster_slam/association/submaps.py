"""Submaps between gaps, and how one may lie with respect to another.

Where nothing is seen for a while, odometry alone leaves several possibilities, and the first points after the gap
cannot tell which is right. So what is seen between two gaps is mapped for itself; such a map is matched as a whole:
every pair of its landmarks with every pair of the other map that lies as far apart, and every landmark with
every other, is a hypothesis about the motion in the gap. How many landmarks come to lie on others, and how
unusual the motion would be, ranks them (compare Neira and Tardos, "Data association in stochastic mapping using
the joint compatibility test", 2001; here with many points behind each landmark).
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from cluster_slam.association.compatibility import Matches, Side
from cluster_slam.association.drift_smoother import Steps
from cluster_slam.association.frames import Frames
from cluster_slam.geometry import Array, adjoint, inverse, se3_exp, skew, transform
from cluster_slam.records import BoolArray, IntArray

_MATCH = 16.0  # chi-square up to which two landmarks may be one
_N_ITERATIONS = 6
_APART = 0.1  # sigmas of odometry by which motions differ
_MOST_DISTANCES = 2_000  # of a map that are compared with those of another
_MOST_PAIRS = 20_000  # of hypotheses
_BLOCK = 1_000_000  # distances that are held in memory at a time


@dataclass(frozen=True, slots=True, eq=False)
class Part:
    """Frames ``first`` to ``end`` (without it) with their poses, labels and places in a frame of their own."""

    first: int
    end: int
    T: Array  # (k, 4, 4)
    label: IntArray  # (q,)
    places: Array  # (l, 3)
    var: Array  # (l,) m^2, how well each place is known
    frame: IntArray  # (q,) of each point, counted from the first
    cost: float = 0.0  # twice the negative log-likelihood

    @property
    def weight(self) -> int:
        """How many points are landmarks'."""
        return int((self.label >= 0).sum())


def window(frames: Frames, first: int, end: int) -> Frames:
    """The frames ``first`` to ``end`` (without it) as a session."""
    a, b = int(frames.starts[first]), int(frames.starts[end])
    return Frames(
        order=frames.order[a:b],
        starts=frames.starts[first : end + 1] - a,
        frame=frames.frame[a:b] - first,
        points=frames.points[a:b],
        covs=frames.covs[a:b],
        stamps=frames.stamps[first:end],
    )


def spans_between_gaps(steps: Steps, n_frames: int, gap_steps: float) -> list[tuple[int, int]]:
    """Frames (first, end) from gap to gap."""
    cuts = [0, *(np.flatnonzero(steps.length > gap_steps) + 1).tolist(), n_frames]
    return [(int(a), int(b)) for a, b in pairwise(cuts)]


def joined(a: Part, b: Part, z: Array, steps: Steps) -> Part:
    """Part b, the next after a or the last before it, laid at the motion z (d,) beside odometry; nothing matched."""
    home = _predicted(a, b, steps) @ se3_exp(z @ steps.basis.T) @ inverse(_border(a, b))
    T, places = home @ b.T, transform(home, b.places)
    label = np.where(b.label >= 0, b.label + len(a.places), -1)
    first, second = ((a.T, a.label), (T, label)) if b.first >= a.end else ((T, label), (a.T, a.label))
    return Part(
        min(a.first, b.first),
        max(a.end, b.end),
        np.concatenate([first[0], second[0]]),
        np.concatenate([first[1], second[1]]),
        np.concatenate([a.places, places]),
        np.concatenate([a.var, b.var]),
        np.concatenate([a.frame, b.frame + len(a.T)] if b.first >= a.end else [b.frame, a.frame + len(b.T)]),
    )


def identified(both: Part, a: Part, pairs: IntArray) -> Part:
    """Two parts joined (``a`` the first of them) with landmarks (k, 2) of a and of the other taken for the same."""
    number = np.arange(len(both.places))
    number[len(a.places) + pairs[:, 1]] = pairs[:, 0]
    return replace(both, label=np.where(both.label >= 0, number[both.label], -1))


def sides(a: Part, b: Part, covs: tuple[Array, Array], steps: Steps) -> tuple[Side, Side]:
    """Landmarks of both parts seen from the pose of b next to a: as odometry predicts it from a, and as b has it.

    ``covs``: joint covariances (3 l, 3 l) of the places of each part, its pose next to the other standing still.
    """
    out = []
    for part, cov, seen_from in ((a, covs[0], _predicted(a, b, steps)), (b, covs[1], _border(a, b))):
        home = inverse(seen_from)
        R = np.kron(np.eye(len(part.places)), home[:3, :3])
        out.append(Side(transform(home, part.places), R @ (cov + np.diag(np.repeat(part.var, 3))) @ R.T))
    return out[0], out[1]


def motions(a: Side, b: Side, prior: Array, basis: Array, n_best: int) -> list[Matches]:
    """The likeliest motions in the gap between two sides, with the landmarks they come from; odometry is the first."""
    nothing = Matches(np.empty((0, 2), dtype=np.int64), np.zeros(basis.shape[1]), 0.0)
    if len(a.places) == 0 or len(b.places) == 0:
        return [nothing]
    i, j = _hypotheses(a, b)
    var_a, var_b = a.var, b.var
    z = _solve(a.places, b.places, var_a, var_b, i, j, prior, basis)
    score = _score(z, a.places, b.places, var_a, var_b, prior, basis)
    chosen: list[int] = []
    scale = np.sqrt(np.diagonal(prior))
    for k in np.argsort(-score, kind="stable").tolist():
        if len(chosen) >= n_best:
            break
        if (np.abs((z[k] - z[chosen]) / scale).max(axis=1) > _APART).all():
            chosen.append(k)
    pairs = np.stack([i, j], axis=-1)
    return [nothing, *(Matches(np.unique(pairs[k], axis=0), z[k], float(score[k])) for k in chosen)]


def _border(a: Part, b: Part) -> Array:
    """The pose (4, 4) of part b next to part a, in its own frame."""
    return np.asarray(b.T[0] if b.first >= a.end else b.T[-1])


def _predicted(a: Part, b: Part, steps: Steps) -> Array:
    """The same pose by odometry from part a, in the frame of a."""
    if b.first >= a.end:
        return np.asarray(a.T[-1] @ steps.motion[a.end - 1])
    return np.asarray(a.T[0] @ inverse(steps.motion[b.end - 1]))


def gap_drift(a: Part, b: Part, steps: Steps, range_sq: float) -> float:
    """By how much (m^2) odometry leaves open where the points of part b lie beside those of part a, before it."""
    cov = np.diagonal(steps.basis @ _gap_cov(a, b, steps) @ steps.basis.T)
    return float(cov[3:].sum() + cov[:3].sum() * range_sq)


def _gap_cov(a: Part, b: Part, steps: Steps) -> Array:
    """Covariance (d, d) of the border pose of b by odometry from the last pose of a that a landmark holds."""
    B = steps.basis
    after = b.first >= a.end
    held = a.frame[a.label >= 0]
    if after:
        start, end = a.first + int(held.max(initial=0)), b.first
    else:
        start, end = b.end - 1, a.first + int(held.min(initial=len(a.T) - 1))
    cov, total = np.zeros((6, 6)), np.eye(4)
    for k in range(start, end):
        A = adjoint(inverse(steps.motion[k]))
        cov = A @ cov @ A.T + B @ steps.cov[k] @ B.T
        total = total @ steps.motion[k]
    if not after:
        A = adjoint(total)
        cov = A @ cov @ A.T
    out: Array = B.T @ cov @ B
    return out


def gap_cov(a: Part, b: Part, steps: Steps) -> Array:
    """Covariance (d, d) of the pose of b next to a, by odometry from the pose of a next to b."""
    B = steps.basis
    if b.first >= a.end:
        return np.asarray(steps.cov[a.end - 1])
    A = adjoint(steps.motion[b.end - 1])
    return np.asarray(B.T @ A @ B @ steps.cov[b.end - 1] @ B.T @ A.T @ B)


def _hypotheses(a: Side, b: Side) -> tuple[IntArray, IntArray]:
    """Landmarks (h, 2) of a and of b that may be the same: pairs as far apart as each other, and single ones twice."""
    n, m = len(a.places), len(b.places)
    (Da, var_a), (Db, var_b) = a.distances(), b.distances()
    i1, i2 = _surest(var_a, np.logical_not(np.eye(n, dtype=bool)))
    j1, j2 = _surest(var_b, np.tri(m, k=-1, dtype=bool))
    var = var_a[i1, i2][:, None] + var_b[j1, j2]
    fits = (Da[i1, i2][:, None] - Db[j1, j2]) ** 2 < _MATCH * var
    h, g = np.nonzero(fits)
    if len(h) > _MOST_PAIRS:
        surest = np.argsort(var[h, g], kind="stable")[:_MOST_PAIRS]
        h, g = h[surest], g[surest]
    one_i, one_j = np.divmod(np.arange(n * m), max(m, 1))
    i = np.concatenate([np.column_stack([i1[h], i2[h]]), np.column_stack([one_i, one_i])])
    j = np.concatenate([np.column_stack([j1[g], j2[g]]), np.column_stack([one_j, one_j])])
    return i, j


def _surest(var: Array, allowed: BoolArray) -> tuple[IntArray, IntArray]:
    """Pairs of landmarks whose distance is known best, in order of their numbers, not too many of them."""
    i, j = np.nonzero(allowed)
    kept = np.sort(np.argsort(var[i, j], kind="stable")[:_MOST_DISTANCES])
    return i[kept], j[kept]


def _solve(
    target: Array, source: Array, var_a: Array, var_b: Array, i: IntArray, j: IntArray, prior: Array, basis: Array
) -> Array:
    """Motions z (h, d) that bring source landmarks j (h, 2) to targets i (h, 2), Gauss-Newton with the gap's prior."""
    d = basis.shape[1]
    z = np.zeros((len(i), d))
    weight = 1.0 / (var_a[i] + var_b[j])
    precision = np.linalg.solve(prior, np.eye(d))
    for _ in range(_N_ITERATIONS):
        E = se3_exp(z @ basis.T)
        s = source[j]
        error = target[i] - transform(E[:, None], s)
        # d (E Exp(B y) s) / dy = R_E [-skew(s), I] B
        J = np.concatenate([-skew(s), np.broadcast_to(np.eye(3), (*s.shape[:-1], 3, 3))], axis=-1)
        J = E[:, None, :3, :3] @ (J @ basis)
        H = np.einsum("hk,hkxi,hkxj->hij", weight, J, J) + precision
        g = np.einsum("hk,hkxi,hkx->hi", weight, J, error) - z @ precision
        step = np.linalg.solve(H, g[..., None])[..., 0]
        z = z + np.clip(step, -0.5 * np.maximum(1.0, np.abs(z)), 0.5 * np.maximum(1.0, np.abs(z)))
    return z


def _score(z: Array, target: Array, source: Array, var_a: Array, var_b: Array, prior: Array, basis: Array) -> Array:
    """How much (h,) landmarks that come to lie on others explain, less how unusual the motion is."""
    if len(target) == 0 or len(source) == 0:
        return np.zeros(len(z))
    explained = np.empty(len(z))
    for rows in np.array_split(np.arange(len(z)), len(z) * len(target) * len(source) // _BLOCK + 1):
        moved = transform(se3_exp(z[rows] @ basis.T)[:, None], np.broadcast_to(source, (len(rows), *source.shape)))
        distance_sq = ((target[None, :, None] - moved[:, None]) ** 2).sum(axis=-1)
        chi2 = distance_sq / (var_a[:, None] + var_b[None])
        explained[rows] = np.maximum(0.0, _MATCH - chi2.min(axis=1)).sum(axis=1)
    unusual = np.einsum("hi,hi->h", z, np.linalg.solve(prior, z.T).T)
    return np.asarray(explained - (2.0 + len(prior)) * np.log1p(unusual / 2.0))
