"""What is known while a session is being smoothed, and what is learned from each smoothing."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np

from cluster_slam.association.calibration import Calibration, delayed
from cluster_slam.association.depth_noise import NoiseShape, at_expected_depth, expected_depth
from cluster_slam.association.frames import Frames
from cluster_slam.config import SmoothConfig
from cluster_slam.geometry import Array
from cluster_slam.graph.batch import BatchSmoother, Estimate, Marginals
from cluster_slam.graph.noise_shape import noise_shape
from cluster_slam.graph.poses import PoseModel
from cluster_slam.graph.variance import VarianceFactors, variance_factors
from cluster_slam.records import IntArray, StatedNoise
from cluster_slam.smoothing.lasting import LastingErrors

NO_WEIGHT = 1e6  # observations that must not bend the trajectory count as one in so many
_FEW_FRAMES = 8  # fewer confirm nothing
_LEAST_FACTOR = 1e-4  # on stated variances: sessions without any error would leave no variance to reckon with


@dataclass(frozen=True, slots=True, eq=False)
class World:
    """What is known while the session is being associated."""

    T: Array  # (n, 4, 4) camera poses
    X: Array | None  # hand-eye
    landmark: IntArray  # (m,)
    places: Array  # (l, 3)
    cluster: IntArray  # (l,)
    radius: float  # pieces of one flower lie within, m
    noise: VarianceFactors  # what was found about the stated variances so far
    held: Array  # (6, 6) projector on what of the hand-eye tangent the session cannot tell
    cov_step: Array | None = None  # (n - 1, 6, 6) of odometry, where following its drift has told more than is stated
    wild_share: float = 0.0  # of observations whose errors are several times what the others' are
    errs_slowly: bool = False  # errors of observations cannot be told from drift of the poses
    only_sigma: float | None = None  # m, where that is all that is stated of the observations' noise
    shape: NoiseShape | None = None  # then what was found of it
    depth: Array | None = None  # (m,) m, where the flowers of observations are; NaN where that is not known
    lasting: LastingErrors | None = None  # what of the observations' errors is no smaller in many frames of one view
    instruments: Calibration = field(default_factory=Calibration)  # what the session shows to be wrong with them


def corrected(frames: Frames, model: PoseModel, instruments: Calibration) -> tuple[Frames, PoseModel]:
    """The session without what its instruments do wrong."""
    return instruments.correct(frames), replace(model, given=delayed(model.given, frames.stamps, instruments.lag_s))


def with_variances(frames: Frames, model: PoseModel, noise: VarianceFactors) -> tuple[Frames, PoseModel]:
    """The session with the variances that were found instead of those that are stated."""
    return replace(frames, covs=frames.covs * noise.flower), replace(model, cov=model.cov * noise.pose)


def for_solving(frames: Frames, model: PoseModel, world: World) -> tuple[Frames, PoseModel]:
    """The same, with the hand-eye transform held at its prior where the session cannot tell it.

    The estimated poses' own errors look like motion there, and would pull it away (errors in variables).
    """
    if world.shape is not None:
        frames = replace(frames, covs=world.shape.covs(frames.points, expected_depth(frames.points, world.depth)))
    frames, model = with_variances(frames, model, world.noise)
    if world.depth is not None and world.shape is None:
        frames = at_expected_depth(frames, world.depth)
    free = np.eye(6) - world.held
    cov = free @ model.cov_hand_eye @ free + 1e-12 * world.held
    step = model.cov_step if world.cov_step is None else world.cov_step
    return frames, replace(model, cov_hand_eye=cov, cov_step=step)


def learn(world: World, smoother: BatchSmoother, estimate: Estimate) -> World:
    """Take over what the smoothing found: poses, hand-eye transform, places, and how large the errors really are."""
    found = variance_factors(smoother, estimate)
    if world.errs_slowly:
        found = VarianceFactors(1.0, 1.0, NO_WEIGHT)  # slow errors hide from residuals: the stated ones stay
    in_stretches = len(smoother.pairs.stretch_sigma) > 0
    noise = _combined(world, found, in_stretches=in_stretches)
    shape = world.shape
    if world.only_sigma is not None and not in_stretches and not world.errs_slowly:
        shape = noise_shape(smoother, estimate, _LEAST_FACTOR * world.only_sigma**2) or shape
    if shape is not world.shape:  # holds all that residuals say of the size, too
        noise = replace(noise, flower=1.0)
    noise = replace(noise, flower=max(noise.flower, _LEAST_FACTOR), pose=max(noise.pose, _LEAST_FACTOR))
    depth = np.full(smoother.m, np.nan)
    depth[smoother.rows] = smoother.residuals(estimate)[1][:, 2]
    return replace(world, T=estimate.T, X=estimate.X, places=estimate.places, noise=noise, depth=depth, shape=shape)


def _combined(world: World, found: VarianceFactors, *, in_stretches: bool) -> VarianceFactors:
    """Factors so far times those that were found, each where it can be found.

    Redundancies are reckoned frame by frame, as if displacements were new in each: without stretches. What residuals
    have in common over time is sway, unless stretches hold it or nothing sways.
    """
    if in_stretches:
        return replace(world.noise, correlation=found.correlation, pose_correlation=found.pose_correlation)
    sways = bool(np.bincount(world.cluster, minlength=1).max() > 1)
    correlation = 1.0 if sways and not world.errs_slowly else found.correlation
    noise = world.noise
    flower, pose, sway = noise.flower * found.flower, noise.pose * found.pose, noise.sway * found.sway
    return VarianceFactors(flower, pose, correlation, sway, found.pose_correlation)


def say_how_sure(smoother: BatchSmoother, stated: Frames, stated_poses: PoseModel, world: World) -> None:
    """Let covariances follow from what the last solution has told about the errors."""
    smoother.correlation = world.noise.correlation
    if world.errs_slowly:  # all observations of a flower say the same: its place is as uncertain as one of them
        smoother.correlation = float(np.bincount(smoother.landmark, minlength=1).max())
    _, smoother.poses = with_variances(stated, stated_poses, world.noise)
    smoother.pose_correlation = world.noise.pose_correlation


def with_unknown_scale(
    marginals: Marginals, estimate: Estimate, instruments: Calibration, noise: StatedNoise
) -> Marginals:
    """Covariances that hold although lengths of odometry and of ranges may be wrong by a common factor.

    Residuals cannot show it. Odometry may be wrong by what it is stated to err per metre, ranges by their correction;
    the factor moves all places from where the session began.
    """
    if instruments.scale_sigma == 0.0 or noise.odometry_translation == 0.0:
        return marginals
    precision = instruments.scale_sigma**-2 + noise.odometry_translation**-2
    away = (estimate.places - estimate.T[0, :3, 3]).ravel()
    return replace(marginals, places=marginals.places + np.outer(away, away) / precision)


def fewest_observations(frames: Frames, config: SmoothConfig) -> int:
    """Observations of a flower that counts: a few frames cannot confirm anything, there every one stands.

    In short sessions it is a tenth of the frames, at least two: false detections meet in one place by chance the less,
    the fewer there are.
    """
    if frames.n_frames < _FEW_FRAMES:
        return 1
    return int(min(config.min_observations, max(2, frames.n_frames // 10)))


def scalar_var(frames: Frames, model: PoseModel) -> Array:
    """Variance (m,) along any axis of each observation in the world, with what a pose errs."""
    rotation, translation = model.cov[0, 0], model.cov[3, 3]
    lever_sq = (frames.points**2).sum(axis=1)
    return np.asarray(np.trace(frames.covs, axis1=1, axis2=2) / 3.0 + translation + rotation * lever_sq)
