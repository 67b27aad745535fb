"""The mounting of the camera from points whose identities are known: closed form, refinement, and an honest covariance.

Points at rest must stand still in the world: the hand-eye transform, the offset between the clocks and the depth scale
under which they do are the answer. The points' places are eliminated in closed form (variable projection). Residuals of
one stretch of time err alike (sway, slow errors of arm and detector), so the covariance is a jackknife over stretches
(Quenouille 1949; Bell and McCaffrey 2002), never smaller than the one that independent errors would have.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from cluster_slam.association.frames import point_jacobian
from cluster_slam.errors import EstimationError
from cluster_slam.geometry import Array, inverse, se3_exp, se3_log, so3_log, transform
from cluster_slam.records import IntArray

_N_STRETCHES = (6, 10, 20)  # how long errors stay alike is not known: the largest covariance counts
_CAUCHY_SQ = 9.0  # residuals squared, in variances, that weigh half; 3 degrees of freedom
_MEDIAN_CHI2_3 = 2.366
_TIME_STEP_S = 2e-3  # of the numerical derivative by time


@dataclass(frozen=True, slots=True, eq=False)
class StillPoints:
    """Observations of points at rest. ``flange_at(offset_s)`` gives ``T_world_flange`` (q, 4, 4) of each of them."""

    flange_at: Callable[[float], Array]
    points: Array  # (q, 3) camera, m
    var: Array  # (q,) m^2 an axis
    label: IntArray  # (q,) which point
    stamps: Array  # (q,) s


@dataclass(frozen=True, slots=True, eq=False)
class Mounting:
    """The answer. The covariance is of [rx ry rz tx ty tz], then of what else was asked for."""

    X: Array  # (4, 4) T_flange_camera
    time_offset_s: float  # the picture of stamp t shows the arm at t + offset
    depth_scale: float  # true distance over measured
    cov: Array  # (6, 6), (7, 7) or (8, 8)
    scatter_m: float  # median distance of the observations from their points' medians in the world


def park_martin(flange: Array, camera: Array) -> Array:
    """``T_flange_camera`` (4, 4) from motions A (n, 4, 4) of the flange and B (n, 4, 4) of the camera: A X = X B.

    Park and Martin, "Robot sensor calibration: solving AX = XB on the Euclidean group" (IEEE T-RA 1994).

    Raises
    ------
    EstimationError
        The motions turn about fewer than two axes, or not at all.
    """
    a, b = so3_log(flange[:, :3, :3]), so3_log(camera[:, :3, :3])
    M = b.T @ a
    size = np.linalg.svd(M, compute_uv=False)
    if size[1] < 1e-4 * max(len(a), 1) * 0.01 or size[1] < 1e-3 * size[0]:
        raise EstimationError(
            "the arm turned about fewer than two axes: turn it about a second one, 20 degrees or more"
        )
    U, _, Vt = np.linalg.svd(M)
    R = Vt.T @ np.diag([1.0, 1.0, np.linalg.det(Vt.T @ U.T)]) @ U.T
    left = (flange[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = (camera[:, :3, 3] @ R.T - flange[:, :3, 3]).reshape(-1)
    T = np.eye(4)
    T[:3, :3] = R
    T[:3, 3] = np.linalg.lstsq(left, right, rcond=None)[0]
    return T


def motion_pairs(poses: Array, n_max: int = 400, least_turn_rad: float = 0.05) -> IntArray:
    """Pairs (p, 2) of frames between which poses (n, 4, 4) turn enough to say something, evenly taken."""
    n = len(poses)
    gaps = np.unique(np.geomspace(1, max(n - 1, 1), 12).round().astype(np.int64))
    pairs = np.concatenate(
        [np.column_stack([np.arange(n - g), np.arange(g, n)]) for g in gaps if g < n] or [np.zeros((0, 2), np.int64)]
    )
    turn = np.linalg.norm(so3_log((inverse(poses[pairs[:, 0]]) @ poses[pairs[:, 1]])[:, :3, :3]), axis=1)
    good: IntArray = pairs[(turn > least_turn_rad) & (turn < 3.0)]
    if len(good) > n_max:
        good = good[np.linspace(0, len(good) - 1, n_max).astype(np.int64)]
    return good


def refine_mounting(
    seen: StillPoints,
    X0: Array,
    prior_cov: Array,
    *,
    time_sigma_s: float | None = None,
    scale_sigma: float | None = None,
    start: Array | None = None,
    n_iterations: int = 40,
) -> Mounting:
    """Gauss-Newton with Cauchy weights from ``start`` (or the prior ``X0``).

    The clocks' offset and the depth scale are found only where they have a sigma.
    """
    extra = [s for s in (time_sigma_s, scale_sigma) if s is not None]
    prior = np.zeros((6 + len(extra), 6 + len(extra)))
    prior[:6, :6] = np.linalg.solve(prior_cov, np.eye(6))
    prior[range(6, len(prior)), range(6, len(prior))] = [s**-2 for s in extra]
    X, offset, scale = (X0 if start is None else start), 0.0, 1.0
    for _ in range(n_iterations):
        J, r, weight = _linearised(seen, X, offset, scale, time_sigma_s is not None, scale_sigma is not None)
        error = np.concatenate([se3_log(inverse(X0) @ X), _extras(offset, scale, time_sigma_s, scale_sigma)])
        H = np.einsum("q,qia,qib->ab", weight, J, J, optimize=True) + prior
        step = np.linalg.solve(H, -np.einsum("q,qia,qi->a", weight, J, r, optimize=True) - prior @ error)
        X = X @ se3_exp(step[:6])
        if time_sigma_s is not None:
            offset += float(step[6])
        if scale_sigma is not None:
            scale += float(step[-1])
        if np.linalg.norm(step) < 1e-8:
            break
    J, r, weight = _linearised(seen, X, offset, scale, time_sigma_s is not None, scale_sigma is not None)
    return Mounting(X, offset, scale, _covariance(J, r, weight, seen, prior), scatter_of(seen, X, offset, scale))


def _extras(offset: float, scale: float, time_sigma_s: float | None, scale_sigma: float | None) -> Array:
    known = [(offset, time_sigma_s), (scale - 1.0, scale_sigma)]
    return np.array([value for value, sigma in known if sigma is not None])


def _linearised(
    seen: StillPoints, X: Array, offset: float, scale: float, with_time: bool, with_scale: bool
) -> tuple[Array, Array, Array]:
    """Jacobians (q, 3, p) and residuals (q, 3), the points' places eliminated, and weights (q,)."""
    F = seen.flange_at(offset)
    in_flange = transform(X, scale * seen.points)
    w = transform(F, in_flange)
    R = F[:, :3, :3] @ X[:3, :3]
    columns = [point_jacobian(R, scale * seen.points)]
    if with_time:
        ahead, behind = seen.flange_at(offset + _TIME_STEP_S), seen.flange_at(offset - _TIME_STEP_S)
        speed = (transform(ahead, in_flange) - transform(behind, in_flange)) / (2.0 * _TIME_STEP_S)
        columns.append(speed[..., None])
    if with_scale:
        columns.append(R @ seen.points[..., None])
    J = np.concatenate(columns, axis=-1)
    weight = 1.0 / seen.var
    for _ in range(3):
        r = w - _means(w, weight, seen.label)
        square = (r**2).sum(1) / seen.var
        wide = max(float(np.median(square)) / _MEDIAN_CHI2_3, 1.0)
        weight = 1.0 / (seen.var * wide * (1.0 + square / (_CAUCHY_SQ * wide)))
    return J - _means(J, weight, seen.label), w - _means(w, weight, seen.label), weight


def _means(values: Array, weight: Array, label: IntArray) -> Array:
    """Weighted mean of the values (q, ...) over each label, given to each row."""
    n = int(label.max()) + 1
    total = np.bincount(label, weight, n)
    flat = values.reshape(len(values), -1)
    means = np.stack([np.bincount(label, weight * column, n) for column in flat.T], axis=-1)
    out: Array = (means / np.maximum(total, 1e-300)[:, None])[label].reshape(values.shape)
    return out


def _covariance(J: Array, r: Array, weight: Array, seen: StillPoints, prior: Array) -> Array:
    H = np.einsum("q,qia,qib->ab", weight, J, J, optimize=True) + prior
    naive: Array = np.linalg.solve(H, np.eye(len(H)))
    cov = 0.5 * (naive + naive.T)
    for n in _N_STRETCHES:
        left_out = _without_each(J, r, weight, seen.label, stretches(seen.stamps, n), prior)
        m, p = left_out.shape
        few = (m - 1.0) / (m - p - 2.0) if m > p + 2 else 1.0  # so that squares are p on average (Hotelling 1931)
        if m > 1:
            cov = larger(few * (m - 1.0) / m * left_out.T @ left_out + naive @ prior @ naive, cov)
    return no_worse(cov, prior)


def _without_each(J: Array, r: Array, weight: Array, label: IntArray, stretch: IntArray, prior: Array) -> Array:
    """By how much (m, p) the answer moves, to first order, where one of the stretches (q,) is left out (jackknife).

    The prior's information (p, p) stays: what the session does not show cannot move further than was known before.
    """
    out = []
    several = np.unique(stretch)
    at_rest = np.einsum("q,qia,qi->a", weight, J, r, optimize=True)  # what the prior holds against at the answer
    for k in several if len(several) > 1 else []:
        rest = stretch != k
        w = weight[rest]
        A, b = J[rest] - _means(J[rest], w, label[rest]), r[rest] - _means(r[rest], w, label[rest])
        H = np.einsum("q,qia,qib->ab", w, A, A, optimize=True) + prior
        g = np.einsum("q,qia,qi->a", w, A, b, optimize=True) - at_rest
        out.append(np.linalg.solve(H + 1e-9 * np.trace(H) / len(H) * np.eye(len(H)), g))
    return np.array(out).reshape(len(out), J.shape[2])


def larger(a: Array, b: Array) -> Array:
    """The least covariance that is at least b and, along b's principal directions of a, at least a."""
    L = np.linalg.cholesky(b)
    half = np.linalg.solve(L, 0.5 * (a + a.T))
    values, axes = np.linalg.eigh(np.linalg.solve(L, half.T))
    grown = L @ axes
    out: Array = (grown * np.maximum(values, 1.0)) @ grown.T
    return 0.5 * (out + out.T)


def no_worse(cov: Array, prior: Array) -> Array:
    """The covariance, but along no direction more than before the session, as the prior's information (p, p) has it.

    Stretches are few, and a jackknife may claim that a session has made known worse what was known.
    """
    L = np.linalg.cholesky(prior)
    values, axes = np.linalg.eigh(L.T @ cov @ L)
    half = np.linalg.solve(L.T, axes * np.sqrt(np.minimum(values, 1.0)))
    out: Array = half @ half.T
    return out


def scatter_of(seen: StillPoints, X: Array, offset: float = 0.0, scale: float = 1.0) -> float:
    """Median distance (m) of the observations from their points' medians in the world, under a mounting X (4, 4)."""
    w = transform(seen.flange_at(offset), transform(X, scale * seen.points))
    away = np.empty(len(w))
    for j in np.unique(seen.label):
        here = seen.label == j
        away[here] = np.linalg.norm(w[here] - np.median(w[here], axis=0), axis=1)
    return float(np.median(away))


def stretches(stamps: Array, n: int) -> IntArray:
    """Stretch of time (q,) of each stamp, all equally long."""
    span = max(float(np.ptp(stamps)), 1e-9)
    out: IntArray = np.minimum((n * (stamps - stamps.min()) / span).astype(np.int64), n - 1)
    return out
