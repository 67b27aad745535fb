"""Smoothing of a chain of odometry steps and points, fast enough to be asked a thousand times.

The poses form a chain, so their part of the normal equations is banded; the places are few and are eliminated last
(the Schur complement). Only the motions that odometry leaves free are unknowns: three for a vehicle on a floor, six
else. Errors of steps and of points are taken from Student's t (iteratively reweighted least squares; Lange, Little,
Taylor, "Robust statistical modeling using the t distribution", 1989): wheels slip, detections are wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular, solveh_banded

from cluster_slam.association.frames import Frames, information
from cluster_slam.config import ParticleConfig
from cluster_slam.geometry import Array, adjoint, inverse, se3_exp, se3_log, skew
from cluster_slam.records import IntArray

_TIGHT = 1e12  # information of the pose that defines the world
_WEAK = 1e-6  # information of a place that nothing holds


@dataclass(frozen=True, slots=True, eq=False)
class Steps:
    """Odometry between successive poses: motions (s, 4, 4), free directions (6, d), covariances (s, d, d) in them.

    ``dof`` (s,) of Student's t: the sum of many steps (a gap in which nothing was seen) is nearly Gaussian.
    """

    motion: Array
    basis: Array
    cov: Array
    dof: Array
    length: Array  # (s,) how many usual steps each spans, at least 1

    def between(self, first: int, end: int) -> Steps:
        """The steps between the frames ``first`` to ``end`` (without it)."""
        s = slice(first, max(end - 1, first))
        return Steps(self.motion[s], self.basis, self.cov[s], self.dof[s], self.length[s])


def steps_of(given: Array, cov_step: Array, stamps: Array, config: ParticleConfig) -> Steps:
    """Steps of given poses (n, 4, 4) with covariances (n - 1, 6, 6), stated sigmas times ``odometry_scale``."""
    share = cov_step / np.trace(cov_step, axis1=1, axis2=2)[:, None, None]
    values, vectors = np.linalg.eigh(share.mean(axis=0))
    basis = vectors[:, values > 1e-9 * values.max()]
    dt = np.diff(stamps)
    length = np.maximum(1.0, dt / np.median(dt))
    cov = basis.T @ cov_step @ basis * config.odometry_scale**2
    return Steps(inverse(given[:-1]) @ given[1:], basis, cov, config.odometry_dof * length, length)


class DriftSmoother:
    """Poses and places from odometry and points, the association given.

    ``known`` (l, 3) with ``known_information`` (l,) in 1/m^2 are the first l places as other observations have them.
    The pose of the frame ``fixed`` stays: usually the first, which defines the world.
    """

    def __init__(
        self,
        frames: Frames,
        steps: Steps,
        point_dof: float,
        known: Array | None = None,
        known_information: Array | None = None,
        fixed: int = 0,
    ) -> None:
        self.frames, self.steps, self.point_dof, self.fixed = frames, steps, point_dof, fixed
        self.known = np.empty((0, 3)) if known is None else known
        self.known_information = np.empty(0) if known_information is None else known_information
        self.information = information(frames.covs)
        self.step_information = np.linalg.inv(steps.cov)  # (s, d, d), well scaled

    def cost(self, T: Array, places: Array, label: IntArray) -> float:
        """Twice the negative log-likelihood of points and steps, up to a constant."""
        rows, _, _, error = self._point_errors(T, places, label)
        chi2 = np.einsum("mi,mij,mj->m", error, self.information[rows], error)
        moved = ((places[: len(self.known)] - self.known) ** 2).sum(axis=1) @ self.known_information
        return float(self.point_cost(chi2).sum() + self._step_cost(T) + moved)

    def point_cost(self, chi2: Array) -> Array:
        """Twice the negative log-likelihood of points at squared normalised distances."""
        cost: Array = (self.point_dof + 3.0) * np.log1p(chi2 / self.point_dof)
        return cost

    def distances(self, T: Array, places: Array) -> Array:
        """Squared normalised distance (m, l) of every point from every place."""
        f = self.frames.frame
        expected = np.einsum("mji,mlj->mli", T[f, :3, :3], places[None] - T[f, None, :3, 3])
        error = self.frames.points[:, None] - expected
        chi2: Array = ((error @ self.information) * error).sum(-1)
        return chi2

    def step_weights(self, T: Array) -> Array:
        """Weight (s,) of each step at the poses: below one where odometry slipped."""
        d = self.steps.basis.shape[1]
        error = self._step_errors(T)
        chi2 = np.einsum("ni,nij,nj->n", error, self.step_information, error)
        weights: Array = (self.steps.dof + d) / (self.steps.dof + chi2)
        return weights

    def solve(
        self, T: Array, places: Array, label: IntArray, n_iterations: int = 4, tolerance: float = 1e-4
    ) -> tuple[Array, Array]:
        """Poses (n, 4, 4) and places (l, 3) after reweighted Gauss-Newton from a start; ``label`` -1 is no point."""
        for _ in range(n_iterations):
            dz, dx = self._increments(T, places, label)
            T, places = T @ se3_exp(dz @ self.steps.basis.T), places + dx
            if np.abs(dx).max(initial=0.0) < tolerance:
                break
        return T, places

    def _point_errors(self, T: Array, places: Array, label: IntArray) -> tuple[IntArray, IntArray, Array, Array]:
        rows = np.flatnonzero(label >= 0)
        f = self.frames.frame[rows]
        expected = np.einsum("mji,mj->mi", T[f, :3, :3], places[label[rows]] - T[f, :3, 3])
        return rows, f, expected, self.frames.points[rows] - expected

    def _step_errors(self, T: Array) -> Array:
        now = inverse(T[:-1]) @ T[1:]
        return se3_log(inverse(self.steps.motion) @ now) @ self.steps.basis

    def _step_cost(self, T: Array) -> float:
        error, d = self._step_errors(T), self.steps.basis.shape[1]
        chi2 = np.einsum("ni,nij,nj->n", error, self.step_information, error)
        return float(((self.steps.dof + d) * np.log1p(chi2 / self.steps.dof)).sum())

    def _chain(self, T: Array) -> tuple[Array, Array, Array]:
        """Diagonal (n, d, d) and lower (n - 1, d, d) blocks of the poses' information, and gradient (n, d)."""
        n, d = len(T), self.steps.basis.shape[1]
        B, error = self.steps.basis, self._step_errors(T)
        V = self.step_information * self.step_weights(T)[:, None, None]
        A = -(B.T @ adjoint(inverse(inverse(T[:-1]) @ T[1:])) @ B)
        AV = np.swapaxes(A, 1, 2) @ V
        H, g = np.zeros((n, d, d)), np.zeros((n, d))
        H[self.fixed] += _TIGHT * np.eye(d)
        H[1:] += V
        H[:-1] += AV @ A
        g[1:] -= (V @ error[..., None])[..., 0]
        g[:-1] -= (AV @ error[..., None])[..., 0]
        return H, np.swapaxes(AV, 1, 2), g

    def place_covs(self, T: Array, places: Array, label: IntArray) -> Array:
        """Joint covariance (3 l, 3 l) of the places, seen from the pose that stays."""
        _, _, schur, _ = self._eliminated(T, places, label)
        half = np.linalg.cholesky(schur)
        root = solve_triangular(half, np.eye(len(half)), lower=True, check_finite=False)
        return np.asarray(root.T @ root)

    def _increments(self, T: Array, places: Array, label: IntArray) -> tuple[Array, Array]:
        """Steps (n, d) of the poses and (l, 3) of the places."""
        n, d = len(T), self.steps.basis.shape[1]
        Y, coupling, schur, g_place = self._eliminated(T, places, label)
        dx = np.linalg.solve(schur, g_place.ravel() - coupling.T @ Y[:, 0])
        dz: Array = (Y[:, 0] - Y[:, 1:] @ dx).reshape(n, d)
        return dz, np.asarray(dx.reshape(len(places), 3))

    def _eliminated(self, T: Array, places: Array, label: IntArray) -> tuple[Array, Array, Array, Array]:
        """The poses solved for resting places and for each (n d, 1 + 3 l), their coupling, and those of places."""
        n, d, n_places = len(T), self.steps.basis.shape[1], len(places)
        rows, f, expected, error = self._point_errors(T, places, label)
        C = self.information[rows]
        chi2 = np.einsum("mi,mij,mj->m", error, C, error)
        C = C * ((self.point_dof + 3.0) / (self.point_dof + chi2))[:, None, None]
        eye = np.broadcast_to(np.eye(3), (len(rows), 3, 3))
        J_pose = np.concatenate([skew(expected), -eye], axis=-1) @ self.steps.basis
        J_place = np.swapaxes(T[f, :3, :3], 1, 2)
        WP, WL = np.swapaxes(J_pose, 1, 2) @ C, np.swapaxes(J_place, 1, 2) @ C
        H, lower, g = self._chain(T)
        np.add.at(H, f, WP @ J_pose)
        np.add.at(g, f, (WP @ error[..., None])[..., 0])
        M, g_place = np.tile(_WEAK * np.eye(3), (n_places, 1, 1)), np.zeros((n_places, 3))
        known = slice(0, len(self.known))
        M[known] += self.known_information[:, None, None] * np.eye(3)
        g_place[known] += self.known_information[:, None] * (self.known - places[known])
        np.add.at(M, label[rows], WL @ J_place)
        np.add.at(g_place, label[rows], (WL @ error[..., None])[..., 0])
        cross = np.zeros((n, n_places, d, 3))
        np.add.at(cross, (f, label[rows]), WP @ J_place)
        coupling = cross.transpose(0, 2, 1, 3).reshape(n * d, 3 * n_places)
        rhs = np.concatenate([g.reshape(-1, 1), coupling], axis=1)
        Y = solveh_banded(_banded(H, lower), rhs, lower=True, check_finite=False)
        schur = -coupling.T @ Y[:, 1:]
        for j in range(n_places):
            schur[3 * j : 3 * j + 3, 3 * j : 3 * j + 3] += M[j]
        return Y, coupling, 0.5 * (schur + schur.T), g_place


def _banded(H: Array, lower: Array) -> Array:
    """Block tridiagonal matrix in the lower band storage of LAPACK, (2 d, n d)."""
    n, d = H.shape[:2]
    out = np.zeros((2 * d, n * d))
    for column in range(d):
        for row in range(column, d):
            out[row - column, column::d] = H[:, row, column]
        for row in range(d):
            out[d + row - column, column : (n - 1) * d : d] = lower[:, row, column]
    return out
