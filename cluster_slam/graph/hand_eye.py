"""The hand-eye transform from flowers that were followed for a while, before anybody knows which flower is which.

Each piece of a flower's history is one unknown point; the hand-eye transform that makes the pieces' points stand still
in the world is the answer. The pieces' points are eliminated in closed form (variable projection), so that only the six
unknowns of the transform are left; Cauchy weights keep swaying flowers from pulling.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.frames import point_jacobian
from cluster_slam.geometry import Array, inverse, se3_exp, se3_log, so3_exp, transform
from cluster_slam.records import IntArray

_MULTI_START_RAD = 0.5  # a prior wider than this says nothing: all orientations are tried


def _octahedral_rotations() -> Array:
    """The 24 rotations of a cube (24, 3, 3): no rotation is farther than 63 degrees from all of them."""
    rotations: list[Array] = []
    for axes in ((0, 1, 2), (0, 2, 1), (1, 0, 2), (1, 2, 0), (2, 0, 1), (2, 1, 0)):
        for signs in np.ndindex(2, 2, 2):
            R = np.zeros((3, 3))
            R[range(3), axes] = 1.0 - 2.0 * np.array(signs)
            if np.linalg.det(R) > 0:
                rotations.append(R)
    return np.array(rotations)


class _PieceProblem:
    """Normal equations of the hand-eye tangent with the pieces' points eliminated."""

    def __init__(self, T_world_flange: Array, points: Array, var: Array, labels: IntArray) -> None:
        """T (q, 4, 4) of each observation, camera points (q, 3), scalar variances (q,), piece of each (q,)."""
        _, self.piece = np.unique(labels, return_inverse=True)
        self.n_pieces = int(self.piece.max()) + 1
        self.F, self.c, self.var = T_world_flange, points, var

    def _mean(self, weight: Array, values: Array) -> Array:
        total = np.bincount(self.piece, weight, self.n_pieces)
        flat = (values * weight.reshape(-1, *([1] * (values.ndim - 1)))).reshape(len(values), -1)
        sums = np.stack([np.bincount(self.piece, col, self.n_pieces) for col in flat.T], axis=-1)
        return (sums / total[:, None]).reshape(self.n_pieces, *values.shape[1:])[self.piece]

    def residuals(self, X: Array, weight: Array) -> Array:
        w = transform(self.F, transform(X, self.c))
        return w - self._mean(weight, w)

    def step(self, X: Array, weight: Array, prior_information: Array, prior_error: Array) -> tuple[Array, Array]:
        """Gauss-Newton step (6,) and the data's information (6, 6)."""
        R = self.F[:, :3, :3] @ X[:3, :3]
        J = point_jacobian(R, self.c)
        r = self.residuals(X, weight)
        J = J - self._mean(weight, J)
        H = np.einsum("q,qia,qib->ab", weight, J, J, optimize=True)
        g = -np.einsum("q,qia,qi->a", weight, J, r, optimize=True) - prior_information @ prior_error
        return np.linalg.solve(H + prior_information, g), H

    def solve(self, X: Array, X0: Array, prior_information: Array, n_iterations: int) -> tuple[Array, Array, float]:
        weight = 1.0 / self.var
        H = np.zeros((6, 6))
        scale = np.inf
        for _ in range(n_iterations):
            r2 = (self.residuals(X, weight) ** 2).sum(-1) / self.var
            scale = max(float(np.median(r2)) / 2.366, 1.0)  # far from the answer all residuals are large
            weight = 1.0 / (self.var * scale * (1.0 + r2 / (3.0 * scale)))
            xi, H = self.step(X, weight, prior_information, se3_log(inverse(X0) @ X))
            X = X @ se3_exp(xi)
            if np.linalg.norm(xi) < 1e-7:
                break
        return X, H, scale


@dataclass(frozen=True, slots=True, eq=False)
class HandEye:
    """Transform (4, 4), the data's information (6, 6) about its tangent, and a projector on what must be held."""

    X: Array
    information: Array
    held: Array


def hand_eye_from_pieces(
    T_world_flange: Array,
    points: Array,
    var: Array,
    labels: IntArray,
    X0: Array,
    prior_cov: Array,
    rotation_var: float,
) -> HandEye:
    """The hand-eye transform under which the pieces' points stand still.

    Parameters
    ----------
    T_world_flange : (q, 4, 4) flange pose of each observation.
    points : (q, 3) camera frame, m.
    var : (q,) variance of each point along any axis, m^2, with what the pose errs.
    labels : (q,) piece of each observation.
    X0 : (4, 4) the measured transform.
    prior_cov : (6, 6) how well it is known.
    rotation_var : rad^2, by which the given rotations err: turns no larger than that tell nothing of the lever.
    """
    prior_information: Array = np.linalg.inv(prior_cov).astype(np.float64)
    problem = _PieceProblem(T_world_flange, points, var, labels)
    start = X0
    if np.sqrt(prior_cov[0, 0]) > _MULTI_START_RAD:
        start = _best_start(problem, X0, prior_information)
    X, H, _ = problem.solve(start, X0, prior_information, 30)
    held = _not_turned(problem, H, rotation_var)
    if held.any():
        X, H, _ = problem.solve(X0, X0, prior_information + 1e12 * held, 30)
        free = np.eye(6) - held
        H = free @ H @ free
    return HandEye(X, H, held)


def _not_turned(problem: _PieceProblem, H: Array, rotation_var: float, least: float = 5.0) -> Array:
    """Projector (6, 6) on the shifts of which the turns of the flange say no more than their own errors would.

    The lever is seen by turning. Errors of the given rotations look like turns of that size, and pull it astray.
    """
    weight = 1.0 / problem.var
    chance = 2.0 * rotation_var * float(weight.sum())
    shift = H[3:, 3:] - H[3:, :3] @ np.linalg.solve(H[:3, :3] + 1e-9 * np.eye(3), H[:3, 3:])
    size, direction = np.linalg.eigh(shift)
    lost = direction[:, size < least * chance]
    held = np.zeros((6, 6))
    held[3:, 3:] = lost @ lost.T
    return held


def _best_start(problem: _PieceProblem, X0: Array, prior_information: Array, n_max: int = 4000) -> Array:
    """The best of 24 orientations, each improved on a share of the observations."""
    stride = max(1, len(problem.c) // n_max)
    few = _PieceProblem(problem.F[::stride], problem.c[::stride], problem.var[::stride], problem.piece[::stride])
    best, best_scale = X0, np.inf
    for R in _octahedral_rotations():
        X = X0.copy()
        X[:3, :3] = X0[:3, :3] @ R @ so3_exp(np.array([0.1, 0.2, -0.15]))  # off the symmetry axes
        X, _, scale = few.solve(X, X0, prior_information, 15)
        if scale < best_scale:
            best, best_scale = X, scale
    return best
