"""Rigid motions as (4, 4) arrays, their tangent vectors, and quaternions.

Tangent vectors are ``[rx ry rz tx ty tz]``, applied on the right: ``T = T_mean @ exp(xi)``. All functions take
stacks: leading dimensions are kept. Formulas: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in
robotics" (2018), section 7 and appendix D.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
_SMALL_ANGLE_SQ = 1e-8  # below this the series of the trigonometric ratios is exact to 1e-17


def skew(v: Array) -> Array:
    """Cross-product matrices (..., 3, 3) of vectors (..., 3)."""
    out = np.zeros((*v.shape[:-1], 3, 3))
    out[..., 0, 1], out[..., 0, 2], out[..., 1, 2] = -v[..., 2], v[..., 1], -v[..., 0]
    out[..., 1, 0], out[..., 2, 0], out[..., 2, 1] = v[..., 2], -v[..., 1], v[..., 0]
    return out


def _ratios(angle_sq: Array) -> tuple[Array, Array, Array]:
    """sin(a) / a, (1 - cos a) / a^2 and (a - sin a) / a^3, without cancellation near zero."""
    small = angle_sq < _SMALL_ANGLE_SQ
    a2 = np.where(small, 1.0, angle_sq)
    a = np.sqrt(a2)
    sinc = np.where(small, 1.0 - angle_sq / 6.0, np.sin(a) / a)
    cosc = np.where(small, 0.5 - angle_sq / 24.0, (1.0 - np.cos(a)) / a2)
    third = np.where(small, 1.0 / 6.0 - angle_sq / 120.0, (a - np.sin(a)) / (a2 * a))
    return sinc, cosc, third


def so3_exp(omega: Array) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors (..., 3), radians (Rodrigues)."""
    sinc, cosc, _ = _ratios((omega * omega).sum(-1))
    W = skew(omega)
    return np.eye(3) + sinc[..., None, None] * W + cosc[..., None, None] * (W @ W)


def so3_log(R: Array) -> Array:
    """Rotation vectors (..., 3), radians, norm at most pi, of rotation matrices (..., 3, 3)."""
    q = quaternion_from_rotation(R)
    q = np.where(q[..., 3:] < 0, -q, q)
    s = np.linalg.norm(q[..., :3], axis=-1)
    angle = 2.0 * np.arctan2(s, q[..., 3])
    scale = np.where(s < 1e-9, 2.0, angle / np.where(s < 1e-9, 1.0, s))
    return q[..., :3] * scale[..., None]


def se3_exp(xi: Array) -> Array:
    """Rigid motions (..., 4, 4) of tangent vectors (..., 6)."""
    omega, v = xi[..., :3], xi[..., 3:]
    sinc, cosc, third = _ratios((omega * omega).sum(-1))
    W = skew(omega)
    W2 = W @ W
    V = np.eye(3) + cosc[..., None, None] * W + third[..., None, None] * W2
    T = np.zeros((*xi.shape[:-1], 4, 4))
    T[..., :3, :3] = np.eye(3) + sinc[..., None, None] * W + cosc[..., None, None] * W2
    T[..., :3, 3] = (V @ v[..., None])[..., 0]
    T[..., 3, 3] = 1.0
    return T


def se3_log(T: Array) -> Array:
    """Tangent vectors (..., 6) of rigid motions (..., 4, 4)."""
    omega = so3_log(T[..., :3, :3])
    _, cosc, third = _ratios((omega * omega).sum(-1))
    W = skew(omega)
    V = np.eye(3) + cosc[..., None, None] * W + third[..., None, None] * (W @ W)
    return np.concatenate([omega, np.linalg.solve(V, T[..., :3, 3, None])[..., 0]], axis=-1)


def inverse(T: Array) -> Array:
    """Inverse rigid motions (..., 4, 4)."""
    out = np.zeros_like(T)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    out[..., :3, :3] = Rt
    out[..., :3, 3] = -(Rt @ T[..., :3, 3, None])[..., 0]
    out[..., 3, 3] = 1.0
    return out


def transform(T: Array, points: Array) -> Array:
    """Apply T (..., 4, 4) to points (..., 3): one motion a point, or one motion for all."""
    return (T[..., :3, :3] @ points[..., None])[..., 0] + T[..., :3, 3]


def rotate_cov(R: Array, cov: Array) -> Array:
    """Covariances R C R' (..., 3, 3)."""
    return R @ cov @ np.swapaxes(R, -1, -2)


def adjoint(T: Array) -> Array:
    """Adjoint matrices (..., 6, 6): ``T @ exp(xi) = exp(adjoint(T) @ xi) @ T``, rotation first."""
    R = T[..., :3, :3]
    out = np.zeros((*T.shape[:-2], 6, 6))
    out[..., :3, :3] = R
    out[..., 3:, 3:] = R
    out[..., 3:, :3] = skew(T[..., :3, 3]) @ R
    return out


def rotation_from_quaternion(q: Array) -> Array:
    """Rotation matrices (..., 3, 3) of Hamilton quaternions ``qx qy qz qw`` (..., 4), normalised first."""
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    v, w = q[..., :3], q[..., 3:, None]
    V = skew(v)
    return np.eye(3) + 2.0 * w * V + 2.0 * (V @ V)


def quaternion_from_rotation(R: Array) -> Array:
    """Unit quaternions ``qx qy qz qw`` (..., 4), qw >= 0, of rotation matrices (..., 3, 3).

    The largest of the four components is found first and the others follow from it (Shepperd 1978).
    """
    r = R
    trace = r[..., 0, 0] + r[..., 1, 1] + r[..., 2, 2]
    four = np.stack([2 * r[..., 0, 0] - trace, 2 * r[..., 1, 1] - trace, 2 * r[..., 2, 2] - trace, trace], axis=-1)
    products = np.empty((*R.shape[:-2], 4, 4))  # 4 q_i q_j
    for i in range(4):
        products[..., i, i] = 1.0 + four[..., i]
    for i, j, sign in ((0, 1, 1), (0, 2, 1), (1, 2, 1)):
        products[..., i, j] = products[..., j, i] = r[..., i, j] + sign * r[..., j, i]
    for i, a, b in ((0, 2, 1), (1, 0, 2), (2, 1, 0)):
        products[..., i, 3] = products[..., 3, i] = r[..., a, b] - r[..., b, a]
    best = four.argmax(-1)
    q = np.take_along_axis(products, best[..., None, None], axis=-2)[..., 0, :]
    q = q / np.linalg.norm(q, axis=-1, keepdims=True)
    flipped: Array = np.where(q[..., 3:] < 0, -q, q)
    return flipped


def pose_from_tum(rows: Array) -> Array:
    """Rigid motions (..., 4, 4) of rows ``tx ty tz qx qy qz qw`` (..., 7)."""
    T = np.zeros((*rows.shape[:-1], 4, 4))
    T[..., :3, :3] = rotation_from_quaternion(rows[..., 3:])
    T[..., :3, 3] = rows[..., :3]
    T[..., 3, 3] = 1.0
    return T


def tum_from_pose(T: Array) -> Array:
    """Rows ``tx ty tz qx qy qz qw`` (..., 7) of rigid motions (..., 4, 4)."""
    return np.concatenate([T[..., :3, 3], quaternion_from_rotation(T[..., :3, :3])], axis=-1)


def kabsch(a: Array, b: Array, weights: Array | None = None) -> Array:
    """Rigid motion T (4, 4) that takes points a (n, 3) onto b (n, 3) with least weighted squares (Kabsch 1976)."""
    w = np.ones(len(a)) if weights is None else weights
    w = w / w.sum()
    ca, cb = w @ a, w @ b
    U, _, Vt = np.linalg.svd((a - ca).T @ ((b - cb) * w[:, None]))
    D = np.diag([1.0, 1.0, np.sign(np.linalg.det(U @ Vt))])
    T = np.eye(4)
    T[:3, :3] = Vt.T @ D @ U.T
    T[:3, 3] = cb - T[:3, :3] @ ca
    return T
