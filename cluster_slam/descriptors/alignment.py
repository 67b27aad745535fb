"""Rigid alignment of matched points, for stacks: least squares, its residual alone, and with full covariances."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, skew, so3_exp
from tracking.gaussian import LOG_2PI, cholesky, symmetrise

NEWTON_STEPS = 12
GAUSS_NEWTON_STEPS = 10
CONVERGED = 1e-7  # rad and m; the distance is off by the square of it in sigmas
FREE_TURN = 1.0 / (2.0 * np.pi)  # information of a rotation about which nothing is known: its integral is 2 pi


@dataclass(frozen=True, slots=True, eq=False)
class Aligned:
    """What the best rigid motion leaves."""

    T: Array  # (..., 4, 4) takes a onto b
    distance_sq: Array  # (...) e' S^-1 e of the residuals
    dof: Array  # (...) 3 k - 6, more where the shape leaves a rotation undetermined
    log_likelihood: Array  # (...) of b given a, integrated over a pose of which nothing is known (per m^3)

    def of(self, index: int) -> Aligned:
        """One of a stack."""
        return Aligned(self.T[index], self.distance_sq[index], self.dof[index], self.log_likelihood[index])


def largest_overlap(H: Array) -> Array:
    """max over rotations R of tr(R' H) (...), for sums H = sum a b' given as nine components (9, ...).

    The largest root of Horn's quartic (1987) by Newton's method from above: never below the truth, wherever it is cut
    short. With singular values s of H it is s1 + s2 + sign(det H) s3.
    """
    a, b, c, d, e, f, g, h, i = H
    p = (H * H).sum(0)
    first = (e * i - f * h, f * g - d * i, d * h - e * g)
    det = a * first[0] + b * first[1] + c * first[2]
    others = (b * i - c * h, c * g - a * i, a * h - b * g, b * f - c * e, c * d - a * f, a * e - b * d)
    minors_sq = sum((x * x for x in (*first, *others)), start=np.zeros_like(p))
    constant, det8 = p * p - 4.0 * minors_sq, 8.0 * det
    x: Array = np.sqrt(3.0 * p)
    for _ in range(NEWTON_STEPS):
        x_sq = x * x
        value = (x_sq - 2.0 * p) * x_sq - det8 * x + constant
        slope = 4.0 * x * (x_sq - p) - det8
        x = x - np.maximum(value, 0.0) / np.where(slope > 0, slope, np.inf)
    return x


def rigid_fit(a: Array, b: Array) -> Array:
    """Motions (..., 4, 4) that take a (..., k, 3) onto b with least squares (Kabsch 1976, Umeyama 1991)."""
    ca, cb = a.mean(-2), b.mean(-2)
    U, _, Vt = np.linalg.svd(np.swapaxes(a - ca[..., None, :], -1, -2) @ (b - cb[..., None, :]))
    flip = np.ones((*ca.shape[:-1], 3))
    flip[..., 2] = np.where(np.linalg.det(U @ Vt) < 0, -1.0, 1.0)
    T = np.zeros((*ca.shape[:-1], 4, 4))
    T[..., :3, :3] = np.swapaxes(U * flip[..., None, :] @ Vt, -1, -2)
    T[..., :3, 3] = cb - (T[..., :3, :3] @ ca[..., None])[..., 0]
    T[..., 3, 3] = 1.0
    return T


def align(a: Array, cov_a: Array, b: Array, cov_b: Array) -> Aligned:
    """Most likely rigid motion of matched points with joint covariances, and what it leaves.

    Minimises e' S^-1 e, e = b - (R a + t), S = R cov_a R' + cov_b, by Gauss-Newton from the least squares fit.

    Parameters
    ----------
    a, b
        (..., k, 3), each in its own frame, m.
    cov_a, cov_b
        (..., 3 k, 3 k), m^2.
    """
    T = rigid_fit(a, b)
    R, centre = T[..., :3, :3], a.mean(-2)
    offsets = a - centre[..., None, :]
    t = b.mean(-2)
    for _ in range(GAUSS_NEWTON_STEPS):
        lower, J, e = _linearised(R, t, offsets, cov_a, b, cov_b)
        gradient = (np.swapaxes(J, -1, -2) @ e[..., None])[..., 0]
        step = np.asarray(np.linalg.solve(_information(J), gradient[..., None])[..., 0], np.float64)
        R = R @ so3_exp(step[..., :3])
        t = t + step[..., 3:]
        if np.abs(step).max() < CONVERGED:
            break
    lower, J, e = _linearised(R, t, offsets, cov_a, b, cov_b)
    return _summary(R, t - (R @ centre[..., None])[..., 0], lower, J, e)


def align_isotropic(a: Array, b: Array, var: Array) -> Aligned:
    """The same where every residual has covariance `var` (...) times the identity: no iteration needed."""
    T = rigid_fit(a, b)
    offsets = a - a.mean(-2, keepdims=True)
    e = b - (a @ np.swapaxes(T[..., :3, :3], -1, -2) + T[..., None, :3, 3])
    distance_sq = (e * e).sum((-1, -2)) / var
    spread = (offsets * offsets).sum((-1, -2))
    turning = spread[..., None, None] * np.eye(3) - np.swapaxes(offsets, -1, -2) @ offsets
    turning = turning / np.asarray(var)[..., None, None]
    k = a.shape[-2]
    log_det = np.linalg.slogdet(turning + FREE_TURN * np.eye(3))[1] + 3.0 * np.log(k / var)
    log_det_S = 3 * k * np.log(var)
    return Aligned(T, distance_sq, _dof(turning, k), _evidence(distance_sq, log_det_S, log_det, k))


def _linearised(R: Array, t: Array, offsets: Array, cov_a: Array, b: Array, cov_b: Array) -> tuple[Array, Array, Array]:
    """Cholesky factor of S, whitened Jacobian (..., 3 k, 6) of the prediction and whitened residual (..., 3 k)."""
    k = b.shape[-2]
    turned = offsets @ np.swapaxes(R, -1, -2)
    e = (b - turned - t[..., None, :]).reshape(*b.shape[:-2], 3 * k)
    lower = cholesky(symmetrise(_turned_cov(R, cov_a) + cov_b), "covariance of the residuals")
    J = np.concatenate([-R[..., None, :, :] @ skew(offsets), np.broadcast_to(np.eye(3), (*b.shape, 3))], axis=-1)
    J = J.reshape(*b.shape[:-2], 3 * k, 6)
    white = np.asarray(np.linalg.solve(lower, np.concatenate([J, e[..., None]], axis=-1)), np.float64)
    return lower, white[..., :6], white[..., 6]


def _turned_cov(R: Array, cov: Array) -> Array:
    k = cov.shape[-1] // 3
    blocks = cov.reshape(*cov.shape[:-2], k, 3, k, 3)
    out: Array = np.einsum("...xy,...iyjz,...wz->...ixjw", R, blocks, R).reshape(*R.shape[:-2], 3 * k, 3 * k)
    return out


def _information(J: Array) -> Array:
    """J'J with a trace of information on rotations, so that undetermined ones stay where they are."""
    information = np.swapaxes(J, -1, -2) @ J
    information[..., [0, 1, 2], [0, 1, 2]] += FREE_TURN
    return information


def _summary(R: Array, t: Array, lower: Array, J: Array, e: Array) -> Aligned:
    T = np.zeros((*t.shape[:-1], 4, 4))
    T[..., :3, :3], T[..., :3, 3], T[..., 3, 3] = R, t, 1.0
    distance_sq = (e * e).sum(-1)
    k = e.shape[-1] // 3
    turning = np.swapaxes(J[..., :3], -1, -2) @ J[..., :3]
    log_det = np.linalg.slogdet(_information(J))[1]
    log_det_S = 2.0 * np.log(np.diagonal(lower, axis1=-2, axis2=-1)).sum(-1)
    return Aligned(T, distance_sq, _dof(turning, k), _evidence(distance_sq, log_det_S, log_det, k))


def _dof(turning: Array, k: int) -> Array:
    """3 k - 3 less the rotations that the shape determines to within a radian."""
    determined = (np.linalg.eigvalsh(turning) > 1.0).sum(-1)
    return np.asarray(3.0 * k - 3.0 - determined)


def _evidence(distance_sq: Array, log_det_S: Array, log_det_information: Array, k: int) -> Array:
    """Laplace's integral over the pose: rotations uniform (1 / 8 pi^2), translations with density 1 per m^3."""
    out: Array = -0.5 * (distance_sq + log_det_S + log_det_information + (3 * k - 6) * LOG_2PI) - np.log(8.0 * np.pi**2)
    return out
