"""All of a session in one factor graph: camera poses, hand-eye transform, flowers at rest, displacements of clusters.

Unknowns, with their keys: z_i tangent of camera pose i, x tangent of the hand-eye transform, l_j place of flower j at
rest, d_p displacement that all flowers of one cluster share in one frame (a "pair" p), b_s mean displacement of a
cluster over a stretch of frames in which it moves. An observation k of flower j in frame i is

    c_k = T_world_camera[i]^-1 (l_j + d_p) + noise

The residuals are linearised for all observations at once in NumPy; GTSAM eliminates the Gaussian factor graph (frames
first, then flowers) and gives the joint marginal of flowers and hand-eye transform. Wrong associations are weighted out
by graduated non-convexity with truncated least squares (Yang et al., "Graduated Non-Convexity for Robust Spatial
Perception", RA-L 2020, eq. 14 and remark 5).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from cluster_slam.association.frames import Frames
from cluster_slam.errors import EstimationError
from cluster_slam.geometry import Array, adjoint, inverse, se3_exp, se3_log, skew
from cluster_slam.graph.elimination import Increments, Linearised, Links, remaining_information, solve_step
from cluster_slam.records import IntArray

_WEAK = 1e-3  # 1 / m: what is known of a place that nobody saw
_UNIT = {3: gtsam.noiseModel.Unit.Create(3), 6: gtsam.noiseModel.Unit.Create(6)}


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """Cluster-in-frame pairs: ``of`` (m,) pair of each observation (-1 none), and of each pair frame, cluster, sigma.

    ``sigma`` (p,) m is how far the cluster may be from rest in that frame, ``stretch`` (p,) numbers the stretches of
    motion (-1 at rest), ``stretch_sigma`` (s,) m is how far a whole stretch's mean may be from rest.
    """

    of: IntArray
    frame: IntArray
    cluster: IntArray
    sigma: Array
    stretch: IntArray
    stretch_sigma: Array

    @property
    def total_sigma(self) -> Array:
        """How far each cluster (p,) may be from rest, its stretch and itself together, m."""
        if len(self.stretch_sigma) == 0:
            return self.sigma
        return np.hypot(self.sigma, np.where(self.stretch >= 0, self.stretch_sigma[self.stretch], 0.0))


@dataclass(frozen=True, slots=True, eq=False)
class PoseModel:
    """What is known of the poses. ``given`` (n, 4, 4) are the flange's (with ``X0``) or the camera's (``X0`` None).

    ``cov`` (6, 6): each pose for itself; ``cov_step`` (n - 1, 6, 6): odometry from frame to frame (None: absolute).
    ``cov_hand_eye`` (6, 6): the prior of the hand-eye tangent.
    """

    given: Array
    cov: Array
    cov_step: Array | None
    X0: Array | None
    cov_hand_eye: Array


@dataclass(frozen=True, slots=True, eq=False)
class Estimate:
    """The unknowns: poses (n, 4, 4), hand-eye (4, 4) or None, places (l, 3), displacements (p, 3); weights (m,)."""

    T: Array
    X: Array | None
    places: Array
    d: Array
    weight: Array
    residual_chi2: Array  # (m,) NaN where unassigned


@dataclass(frozen=True, slots=True, eq=False)
class Marginals:
    """Joint covariance of all places (3 l, 3 l) and of the hand-eye tangent (6, 6)."""

    places: Array
    hand_eye: Array | None


class _Keys:
    """Integer keys of the unknowns, in the order of elimination, but for b between the z's: d, z, b, l, x."""

    def __init__(self, n_pairs: int, n_frames: int, n_stretches: int, n_places: int) -> None:
        ends = np.cumsum([n_pairs, n_frames, n_stretches, n_places, 1])
        self.d, self.z, self.b, self.l, self.x = 0, int(ends[0]), int(ends[1]), int(ends[2]), int(ends[3])


class BatchSmoother:
    """Gauss-Newton on the whole session with the association given."""

    def __init__(
        self, frames: Frames, poses: PoseModel, landmark: IntArray, pairs: Pairs, correlation: float = 1.0
    ) -> None:
        """``landmark`` (m,) flower of each sorted observation or -1; ``correlation`` observations count as one."""
        self.correlation = correlation
        self.frames, self.poses, self.pairs = frames, poses, pairs
        rows = np.flatnonzero(landmark >= 0)
        self.rows = rows[np.lexsort((pairs.of[rows], frames.frame[rows]))]
        self.landmark = landmark[self.rows]
        self.frame = frames.frame[self.rows]
        self.pair = pairs.of[self.rows]
        self.c = frames.points[self.rows]
        chol = np.linalg.cholesky(frames.covs[self.rows])
        self.whiten = np.linalg.inv(chol)  # triangular factors of well-scaled covariances
        self.n_places = int(landmark.max(initial=-1)) + 1
        self.keys = _Keys(len(pairs.frame), frames.n_frames, len(pairs.stretch_sigma), self.n_places)
        self.m = len(landmark)
        self.links = Links(
            frame=self.frame,
            pair=self.pair,
            landmark=self.landmark,
            pair_frame=pairs.frame,
            stretch=pairs.stretch,
            n_frames=frames.n_frames,
            n_places=self.n_places,
            n_stretches=len(pairs.stretch_sigma),
        )

    def residuals(self, e: Estimate) -> tuple[Array, Array]:
        """Whitened residuals (q, 3) and predicted camera points (q, 3) of the assigned observations."""
        R, t = e.T[self.frame, :3, :3], e.T[self.frame, :3, 3]
        p = e.places[self.landmark] + e.d[self.pair]
        h = (np.swapaxes(R, 1, 2) @ (p - t)[..., None])[..., 0]
        return (self.whiten @ (self.c - h)[..., None])[..., 0], h

    def graph(self, e: Estimate) -> gtsam.GaussianFactorGraph:
        """The linearised graph at an estimate; every observation weighted by its robust weight."""
        graph = gtsam.GaussianFactorGraph()
        self._add_poses(graph, e)
        self._add_displacements(graph, e)
        self._add_observations(graph, e)
        weak = np.asfortranarray(_WEAK * np.eye(3))
        for j in range(self.n_places):
            graph.add(gtsam.JacobianFactor(self.keys.l + j, weak, np.zeros(3), _UNIT[3]))
        return graph

    def whitened(self, e: Estimate) -> tuple[Array, Array, Array]:
        """Whitened Jacobians by the pose (q, 3, 6) and by the place or displacement (q, 3, 3), and residuals (q, 3)."""
        r, h = self.residuals(e)
        A_z = self.whiten @ np.concatenate([skew(h), np.broadcast_to(-np.eye(3), (len(h), 3, 3))], axis=-1)
        return A_z, self.whiten @ np.swapaxes(e.T[self.frame, :3, :3], 1, 2), r

    def _weighted(self, e: Estimate) -> tuple[Array, Array, Array]:
        """The same, every observation weighted by its robust weight."""
        root = np.sqrt(e.weight[self.rows] / self.correlation)
        A_z, A_l, r = self.whitened(e)
        return root[:, None, None] * A_z, root[:, None, None] * A_l, root[:, None] * r

    def _add_observations(self, graph: gtsam.GaussianFactorGraph, e: Estimate) -> None:
        use = np.flatnonzero(e.weight[self.rows] > 1e-8)
        A_z, A_l, b = (x[use] for x in self._weighted(e))
        z = (self.keys.z + self.frame[use]).tolist()
        place = (self.keys.l + self.landmark[use]).tolist()
        d = (self.keys.d + self.pair[use]).tolist()
        factor, unit = gtsam.JacobianFactor, _UNIT[3]
        for k in range(len(use)):
            graph.add(factor(z[k], A_z[k], place[k], A_l[k], d[k], A_l[k], b[k], unit))

    def pose_information(self, e: Estimate) -> Array:
        """Information (n, 6, 6) that the given poses alone have about each camera pose, its neighbours held."""
        if self.poses.cov_step is None:
            return np.broadcast_to(np.linalg.inv(self._cov_camera(e)), (len(e.T), 6, 6))
        step = np.linalg.inv(self.poses.cov_step)
        out = np.zeros((len(e.T), 6, 6))
        out[1:] += step
        back = adjoint(inverse(inverse(e.T[:-1]) @ e.T[1:]))
        out[:-1] += np.swapaxes(back, 1, 2) @ step @ back
        out[0] += 1e12 * np.eye(6)
        return out

    def _add_poses(self, graph: gtsam.GaussianFactorGraph, e: Estimate) -> None:
        model, keys = self.poses, self.keys
        predicted = model.given if e.X is None else model.given @ e.X
        root = np.linalg.inv(np.linalg.cholesky(self._cov_camera(e)))
        if model.cov_step is None:
            error = se3_log(inverse(predicted) @ e.T)
            A_x = -root @ adjoint(inverse(e.T) @ predicted)
            for i in range(len(e.T)):
                b = -root @ error[i]
                if e.X is None:
                    graph.add(gtsam.JacobianFactor(keys.z + i, root, b, _UNIT[6]))
                else:
                    graph.add(gtsam.JacobianFactor(keys.z + i, root, keys.x, A_x[i], b, _UNIT[6]))
        else:
            self._add_odometry(graph, e, predicted)
        if e.X is not None and model.X0 is not None:
            prior = np.linalg.inv(np.linalg.cholesky(model.cov_hand_eye))
            graph.add(gtsam.JacobianFactor(keys.x, prior, -prior @ se3_log(inverse(model.X0) @ e.X), _UNIT[6]))

    def _cov_camera(self, e: Estimate) -> Array:
        """Pose covariance in the camera's frame, at the lever that the solution started with.

        Were it to follow the lever, longer levers would explain anything: a weight is no unknown.
        """
        if e.X is None:
            return self.poses.cov
        if self._lever is None:
            self._lever = adjoint(inverse(e.X))
        return self._lever @ self.poses.cov @ self._lever.T

    def _add_odometry(self, graph: gtsam.GaussianFactorGraph, e: Estimate, predicted: Array) -> None:
        keys, cov_step = self.keys, self.poses.cov_step
        assert_step = cov_step if cov_step is not None else np.empty((0, 6, 6))
        tight = 1e6 * np.eye(6)  # the first pose defines the world
        graph.add(gtsam.JacobianFactor(keys.z, tight, -tight @ se3_log(inverse(predicted[0]) @ e.T[0]), _UNIT[6]))
        D = inverse(predicted[:-1]) @ predicted[1:]
        now = inverse(e.T[:-1]) @ e.T[1:]
        error = se3_log(inverse(D) @ now)
        A_first = -adjoint(inverse(now))
        root = np.linalg.inv(np.linalg.cholesky(assert_step))
        for i in range(len(D)):
            graph.add(
                gtsam.JacobianFactor(
                    keys.z + i, root[i] @ A_first[i], keys.z + i + 1, root[i], -root[i] @ error[i], _UNIT[6]
                )
            )

    def _add_displacements(self, graph: gtsam.GaussianFactorGraph, e: Estimate) -> None:
        keys, pairs = self.keys, self.pairs
        eye = np.eye(3)
        for p, (sigma, s) in enumerate(zip(pairs.sigma.tolist(), pairs.stretch.tolist(), strict=True)):
            A = eye / sigma
            if s >= 0:
                mean = self._stretch_mean[s] if self._stretch_mean is not None else np.zeros(3)
                graph.add(gtsam.JacobianFactor(keys.d + p, A, keys.b + s, -A, -(e.d[p] - mean) / sigma, _UNIT[3]))
            else:
                graph.add(gtsam.JacobianFactor(keys.d + p, A, -e.d[p] / sigma, _UNIT[3]))
        for s, sigma in enumerate(pairs.stretch_sigma.tolist()):
            mean = self._stretch_mean[s] if self._stretch_mean is not None else np.zeros(3)
            graph.add(gtsam.JacobianFactor(keys.b + s, eye / sigma, -mean / sigma, _UNIT[3]))

    _stretch_mean: Array | None = None
    _lever: Array | None = None

    def step(self, e: Estimate) -> tuple[Estimate, float]:
        """One Gauss-Newton step and the size of the largest change of a place, m."""
        try:
            by = self._by_graph(e) if self.poses.cov_step is not None else solve_step(self.links, self._linearised(e))
        except (RuntimeError, np.linalg.LinAlgError) as error:  # their words for it are no answer to a person
            raise EstimationError(
                f"the {len(self.rows)} observations of {self.n_places} flowers do not determine its poses and "
                "places in numbers: are they copies of each other, or their covariances far from their errors?"
            ) from error
        self._stretch_mean = by.b if self._stretch_mean is None else self._stretch_mean + by.b
        X = None if e.X is None else e.X @ se3_exp(by.x)
        moved = replace(e, T=e.T @ se3_exp(by.z), X=X, places=e.places + by.places, d=e.d + by.d)
        return self._with_residuals(moved), float(np.abs(by.places).max(initial=0.0))

    def _by_graph(self, e: Estimate) -> Increments:
        """As GTSAM solves the graph: with odometry each pose depends on the one before."""
        delta = self.graph(e).optimize(self._ordering())
        keys, links = self.keys, self.links

        def rows(first: int, n: int, width: int) -> Array:
            return np.array([delta.at(first + i) for i in range(n)]).reshape(n, width)

        return Increments(
            z=rows(keys.z, links.n_frames, 6),
            d=rows(keys.d, len(e.d), 3),
            b=rows(keys.b, links.n_stretches, 3),
            places=rows(keys.l, links.n_places, 3),
            x=np.empty(0) if e.X is None else delta.at(keys.x),
        )

    def _linearised(self, e: Estimate) -> Linearised:
        """The same problem as the graph's, for absolute poses."""
        model, pairs, n = self.poses, self.pairs, len(e.T)
        A_z, A_l, r = self._weighted(e)
        mean = np.zeros((len(pairs.stretch_sigma), 3)) if self._stretch_mean is None else self._stretch_mean
        within = pairs.stretch >= 0
        d = e.d.copy()
        d[within] -= mean[pairs.stretch[within]]
        predicted = model.given if e.X is None else model.given @ e.X
        W = np.linalg.inv(self._cov_camera(e))
        error = se3_log(inverse(predicted) @ e.T)
        by_x = np.empty((n, 6, 0)) if e.X is None else -adjoint(inverse(e.T) @ predicted)
        zx = W @ by_x
        x_information, x_vector = np.einsum("nai,naj->ij", by_x, zx), -np.einsum("nai,na->i", zx, error)
        if e.X is not None and model.X0 is not None:
            prior = np.linalg.inv(model.cov_hand_eye)
            x_information, x_vector = x_information + prior, x_vector - prior @ se3_log(inverse(model.X0) @ e.X)
        return Linearised(
            A_z=A_z,
            A_l=A_l,
            r=r,
            d=d,
            d_information=pairs.sigma**-2,
            b=mean,
            b_information=pairs.stretch_sigma**-2,
            z_information=np.broadcast_to(W, (n, 6, 6)),
            z_vector=-error @ W,
            zx_information=zx,
            x_information=x_information,
            x_vector=x_vector,
            place_information=_WEAK**2,
        )

    def _with_residuals(self, e: Estimate) -> Estimate:
        r, _ = self.residuals(e)
        chi2 = np.full(self.m, np.nan)
        chi2[self.rows] = (r * r).sum(-1)
        return replace(e, residual_chi2=chi2)

    def _ordering(self) -> gtsam.Ordering:
        last = self.keys.x + (0 if self.poses.X0 is None else 1)
        return _in_order([*self._of_frames(), *range(self.keys.l, last)])

    def _of_frames(self) -> list[int]:
        """Keys of what is eliminated before places: in time, so that odometry carries few stretches along."""
        keys, pairs = self.keys, self.pairs
        end = np.zeros(len(pairs.stretch_sigma))
        within = pairs.stretch >= 0
        np.maximum.at(end, pairs.stretch[within], pairs.frame[within] + 0.5)
        time = np.concatenate([np.arange(keys.b - keys.z), end])
        return [*range(keys.z), *(keys.z + np.argsort(time, kind="stable")).tolist()]

    def solve(
        self,
        e: Estimate,
        outlier_chi2: float,
        max_iterations: int = 8,
        tolerance_m: float = 2e-5,
        *,
        is_smoothed: bool = False,
    ) -> Estimate:
        """Gauss-Newton with truncated least squares at ``outlier_chi2`` (3 degrees of freedom), graduated.

        Association gates have kept what is far off: graduation starts where the loss is nearly the truncated one.
        ``is_smoothed``: the start has been smoothed with heavy tails, so that what is far off has no weight from the
        first step on: where only odometry ties poses together, one wild point tears the way apart.
        """
        if is_smoothed:
            e = self._with_residuals(e)
            e = replace(e, weight=_truncated_weights(e.residual_chi2, outlier_chi2, 1.0))
        e, _ = self.step(e)
        mu = 1.0
        for _ in range(max_iterations):
            e = replace(e, weight=_truncated_weights(e.residual_chi2, outlier_chi2, mu))
            e, change = self.step(e)
            if mu >= 100.0 and change < tolerance_m:
                break
            mu *= 10.0
        return e

    def marginals(self, e: Estimate) -> Marginals:
        """Joint covariance of places and hand-eye transform; all else is eliminated."""
        if self.poses.cov_step is None:
            H = remaining_information(self.links, self._linearised(e))
        else:
            _, rest = self.graph(e).eliminatePartialMultifrontal(_in_order(self._of_frames()))
            H, _ = rest.hessian(_in_order(range(self.keys.l, self.keys.x + (0 if e.X is None else 1))))
        H = 0.5 * (H + H.T)
        scale = 1.0 / np.sqrt(np.diag(H))
        L = np.linalg.cholesky(H * scale[:, None] * scale)
        half = np.linalg.solve(L, np.diag(scale))
        cov = half.T @ half
        n = 3 * self.n_places
        return Marginals(cov[:n, :n], None if e.X is None else cov[n:, n:])


def _in_order(keys: Iterable[int]) -> gtsam.Ordering:
    ordering = gtsam.Ordering()
    for key in keys:
        ordering.push_back(key)
    return ordering


def _truncated_weights(chi2: Array, threshold: float, mu: float) -> Array:
    """Weights of graduated truncated least squares (Yang et al. 2020, eq. 14); the unassigned weigh nothing."""
    r2 = np.nan_to_num(chi2, nan=np.inf)
    low, high = mu / (mu + 1.0) * threshold, (mu + 1.0) / mu * threshold
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = np.sqrt(threshold * mu * (mu + 1.0) / r2) - mu
    return np.where(r2 <= low, 1.0, np.where(r2 >= high, 0.0, np.clip(middle, 0.0, 1.0)))
