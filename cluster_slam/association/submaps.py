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

from cluster_slam.association.drift_smoother import Steps
from cluster_slam.association.frames import Frames
from cluster_slam.geometry import Array, adjoint, inverse, se3_exp, skew, transform
from cluster_slam.records import IntArray

_MATCH = 16.0  # chi-square up to which two landmarks may be one
_N_ITERATIONS = 6


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


def matched(part: Part, n_known: int) -> Part:
    """The same with the landmarks from ``n_known`` on taken for the first ones where they lie on them, one to one."""
    from scipy.optimize import linear_sum_assignment

    known, new = part.places[:n_known], part.places[n_known:]
    if len(known) == 0 or len(new) == 0:
        return part
    distance_sq = ((new[:, None] - known[None]) ** 2).sum(axis=-1)
    chi2 = distance_sq / (part.var[n_known:, None] + part.var[None, :n_known])
    alone = np.full((len(new), len(new)), _MATCH)
    rows, columns = linear_sum_assignment(np.concatenate([np.minimum(chi2, 4.0 * _MATCH), alone], axis=1))
    number = np.arange(len(part.places))
    hit = columns < n_known
    number[n_known + rows[hit]] = columns[hit]
    return replace(part, label=np.where(part.label >= 0, number[part.label], -1))


def motions(a: Part, b: Part, steps: Steps, n_best: int) -> Array:
    """The likeliest motions (k, d) in the gap between two parts, beside what odometry says; none is the first."""
    P, N = _predicted(a, b, steps), _border(a, b)
    target, source = transform(inverse(P), a.places), transform(inverse(N), b.places)
    prior = _gap_cov(a, b, steps)
    d = steps.basis.shape[1]
    i, j = _hypotheses(target, source, a.var, b.var)
    z = np.concatenate([np.zeros((1, d)), _solve(target, source, a.var, b.var, i, j, prior, steps.basis)])
    score = _score(z, target, source, a.var, b.var, prior, steps.basis)
    chosen = [0]
    scale = np.sqrt(np.diagonal(prior))
    for k in np.argsort(-score, kind="stable").tolist():
        if len(chosen) > n_best:
            break
        if all(np.abs((z[k] - z[c]) / scale).max() > 0.1 for c in chosen):
            chosen.append(k)
    return np.asarray(z[chosen])


def _border(a: Part, b: Part) -> Array:
    """The pose (4, 4) of part b next to part a, in its own frame."""
    return np.asarray(b.T[0] if b.first >= a.end else b.T[-1])


def _predicted(a: Part, b: Part, steps: Steps) -> Array:
    """The same pose by odometry from part a, in the frame of a."""
    if b.first >= a.end:
        return np.asarray(a.T[-1] @ steps.motion[a.end - 1])
    return np.asarray(a.T[0] @ inverse(steps.motion[b.end - 1]))


def _gap_cov(a: Part, b: Part, steps: Steps) -> Array:
    """Covariance (d, d) of the border pose of b by odometry from the last pose of a that a landmark holds."""
    B = steps.basis
    held = a.first + np.flatnonzero(np.bincount(a.frame[a.label >= 0], minlength=len(a.T)) > 0)
    after = b.first >= a.end
    start, end = (int(held[-1]), b.first) if after else (b.end - 1, int(held[0]))
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


def _hypotheses(target: Array, source: Array, var_a: Array, var_b: Array) -> tuple[IntArray, IntArray]:
    """Landmarks (h, 2) of a and of b that may be the same: pairs as far apart as each other, and single ones twice."""
    n, m = len(target), len(source)
    Da = np.linalg.norm(target[:, None] - target, axis=-1)
    Db = np.linalg.norm(source[:, None] - source, axis=-1)
    i1, i2 = np.nonzero(np.logical_not(np.eye(n, dtype=bool)))
    j1, j2 = np.nonzero(np.tri(m, k=-1, dtype=bool))
    var = (var_a[i1] + var_a[i2])[:, None] + (var_b[j1] + var_b[j2])[None]
    fits = (Da[i1, i2][:, None] - Db[j1, j2][None]) ** 2 < _MATCH * var
    h, g = np.nonzero(fits)
    one_i, one_j = np.divmod(np.arange(n * m), max(m, 1))
    i = np.concatenate([np.column_stack([i1[h], i2[h]]), np.column_stack([one_i, one_i])])
    j = np.concatenate([np.column_stack([j1[g], j2[g]]), np.column_stack([one_j, one_j])])
    return i, j


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
    moved = transform(se3_exp(z @ basis.T)[:, None], np.broadcast_to(source, (len(z), *source.shape)))
    chi2 = ((target[None, :, None] - moved[:, None]) ** 2).sum(axis=-1) / (var_a[:, None] + var_b[None])
    explained = np.maximum(0.0, _MATCH - chi2.min(axis=1)).sum(axis=1)
    unusual = np.einsum("hi,hi->h", z, np.linalg.solve(prior, z.T).T)
    return np.asarray(explained - (2.0 + len(prior)) * np.log1p(unusual / 2.0))
