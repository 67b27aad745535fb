"""All of a session in one factor graph: camera poses, hand-eye transform, flowers at rest, displacements of clusters.

Unknowns, with their keys: z_i tangent of camera pose i, x tangent of the hand-eye transform, l_j place of flower j at
rest, d_p displacement that all flowers of one cluster share in one frame (a "pair" p), b_s mean displacement of a
cluster over a stretch of frames in which it moves. An observation k of flower j in frame i is

    c_k = T_world_camera[i]^-1 (l_j + d_p) + noise

The residuals are linearised for all observations at once in NumPy. What is linear GTSAM solves by eliminating the whole
factor graph; that gives the joint marginal of places and hand-eye transform, too. On the way there, where each pose is
known for itself, all but places and hand-eye transform are eliminated in closed form: the same step, several times
sooner. Wrong associations are weighted out by graduated non-convexity with truncated least squares (Yang et al.,
"Graduated Non-Convexity for Robust Spatial Perception", RA-L 2020, eq. 14 and remark 5).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.association.frames import Frames
from cluster_slam.errors import EstimationError
from cluster_slam.geometry import Array, adjoint, inverse, se3_exp, skew
from cluster_slam.graph import elimination, whole
from cluster_slam.graph.linearised import Linearised, Links
from cluster_slam.graph.poses import PoseModel, PosePrior, pose_prior
from cluster_slam.records import IntArray

_WEAK = 1e-3  # 1 / m: what is known of a place that nobody saw


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


class BatchSmoother:
    """Gauss-Newton on the whole session with the association given."""

    def __init__(
        self,
        frames: Frames,
        poses: PoseModel,
        landmark: IntArray,
        pairs: Pairs,
        correlation: float = 1.0,
        tied: Array | None = None,
    ) -> None:
        """``landmark`` (m,) flower of each sorted observation or -1; ``correlation`` observations count as one.

        ``tied`` (3 l, 3 l): information that places have of each other.
        """
        self.correlation, self.tied = correlation, tied
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

    def pose_information(self, e: Estimate) -> Array:
        """Information (n, 6, 6) that the given poses alone have about each camera pose, its neighbours held."""
        return self._pose_prior(e).z_information

    def _pose_prior(self, e: Estimate, poses: PoseModel | None = None) -> PosePrior:
        """Pose errors are taken at the lever that the solution started with.

        Were they to follow it, longer levers would explain anything: a weight is no unknown.
        """
        if self._lever is None:
            self._lever = np.eye(6) if e.X is None else adjoint(inverse(e.X))
        return pose_prior(poses or self.poses, self._lever, e.T, e.X)

    pose_correlation = 1.0  # given poses count as one, where it is said how sure the result is
    _stretch_mean: Array | None = None
    _lever: Array | None = None

    def step(self, e: Estimate, *, in_gtsam: bool = False) -> tuple[Estimate, float]:
        """One Gauss-Newton step and the size of the largest change of a place, m.

        ``in_gtsam``: by eliminating the whole factor graph, where the closed form would do, too.
        """
        # odometry ties each pose to the next: the closed form knows no such chain
        alone = self.poses.cov_step is None and self.tied is None
        way = whole if self.poses.cov_step is not None or (in_gtsam and alone) else elimination
        try:
            by = way.solve_step(self.links, self.linearised(e))
        except (RuntimeError, np.linalg.LinAlgError) as error:  # their words for it are no answer to a person
            raise self._undetermined() from error
        self._stretch_mean = by.b if self._stretch_mean is None else self._stretch_mean + by.b
        X = None if e.X is None else e.X @ se3_exp(by.x)
        moved = replace(e, T=e.T @ se3_exp(by.z), X=X, places=e.places + by.places, d=e.d + by.d)
        return self._with_residuals(moved), float(np.abs(by.places).max(initial=0.0))

    def _undetermined(self) -> EstimationError:
        return EstimationError(
            f"the {len(self.rows)} observations of {self.n_places} flowers do not determine its poses and "
            "places in numbers: are they copies of each other, or their covariances far from their errors?"
        )

    def linearised(self, e: Estimate, poses: PoseModel | None = None) -> Linearised:
        """The problem at an estimate, every observation weighted by its robust weight; ``poses`` instead of its own."""
        pairs, prior = self.pairs, self._pose_prior(e, poses)
        A_z, A_l, r = self._weighted(e)
        mean = np.zeros((len(pairs.stretch_sigma), 3)) if self._stretch_mean is None else self._stretch_mean
        within = pairs.stretch >= 0
        d = e.d.copy()
        d[within] -= mean[pairs.stretch[within]]
        return Linearised(
            A_z=A_z,
            A_l=A_l,
            r=r,
            d=d,
            d_information=pairs.sigma**-2,
            b=mean,
            b_information=pairs.stretch_sigma**-2,
            z_information=prior.z_information,
            z_vector=prior.z_vector,
            chain=prior.chain,
            zx_information=prior.zx_information,
            x_information=prior.x_information,
            x_vector=prior.x_vector,
            place_information=_WEAK**2,
            tied=self.tied,
            tied_vector=None if self.tied is None else -self.tied @ e.places.ravel(),
        )

    def _with_residuals(self, e: Estimate) -> Estimate:
        r, _ = self.residuals(e)
        chi2 = np.full(self.m, np.nan)
        chi2[self.rows] = (r * r).sum(-1)
        return replace(e, residual_chi2=chi2)

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
        """Joint covariance of places and hand-eye transform; all else is eliminated, by GTSAM."""
        poses = replace(self.poses, cov=self.poses.cov * self.pose_correlation)
        try:
            H = whole.remaining(self.links, self.linearised(e, poses))
            H = 0.5 * (H + H.T)
            scale = 1.0 / np.sqrt(np.diag(H))
            L = np.linalg.cholesky(H * scale[:, None] * scale)
        except (RuntimeError, np.linalg.LinAlgError) as error:
            raise self._undetermined() from error
        half = np.linalg.solve(L, np.diag(scale))
        cov = half.T @ half
        n = 3 * self.n_places
        return Marginals(cov[:n, :n], None if e.X is None else cov[n:, n:])


def _truncated_weights(chi2: Array, threshold: float, mu: float) -> Array:
    """Weights of graduated truncated least squares (Yang et al. 2020, eq. 14); the unassigned weigh nothing."""
    r2 = np.nan_to_num(chi2, nan=np.inf)
    low, high = mu / (mu + 1.0) * threshold, (mu + 1.0) / mu * threshold
    with np.errstate(invalid="ignore", divide="ignore"):
        middle = np.sqrt(threshold * mu * (mu + 1.0) / r2) - mu
    return np.where(r2 <= low, 1.0, np.where(r2 >= high, 0.0, np.clip(middle, 0.0, 1.0)))
