"""One round: associate, smooth, group again, mend the set of landmarks."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_slam.association.alone import without_support
from cluster_slam.association.claim import claim_wild, let_go
from cluster_slam.association.displacement import (
    cluster_pairs,
    measured_displacements,
    motion_scale,
    presence_of,
)
from cluster_slam.association.frames import Frames, view_volume
from cluster_slam.association.landmarks import group_means
from cluster_slam.association.refine import compact, find_overlooked, merge_ghosts, supported
from cluster_slam.association.springs import REST_SIGMA_M
from cluster_slam.association.templates import Follower, combine_directions
from cluster_slam.config import SmoothConfig
from cluster_slam.geometry import Array, transform
from cluster_slam.graph.batch import BatchSmoother, Estimate, Pairs
from cluster_slam.graph.noise import camera_covs
from cluster_slam.graph.poses import PoseModel
from cluster_slam.graph.variance import errs_slowly
from cluster_slam.grouping import Motion, group_flowers
from cluster_slam.records import BoolArray, IntArray
from cluster_slam.smoothing.displaced import Displaced, taken_by_poses
from cluster_slam.smoothing.stretches import at_rest, beyond_rest, standing_still, stretches
from cluster_slam.smoothing.world import NO_WEIGHT, World, fewest_observations, scalar_var
from tracking.gating import chi2_threshold

LEAST_WILD = 0.001  # share of wild errors that is always reckoned with


def associate(frames: Frames, model: PoseModel, world: World, config: SmoothConfig) -> World:
    """Follow the clusters; flowers that were never found are left out."""
    landmark = followed(frames, model, world, config)
    keep = np.bincount(landmark[landmark >= 0], minlength=len(world.places)) > 0
    _, cluster = np.unique(world.cluster[keep], return_inverse=True)
    return replace(world, landmark=compact(keep, landmark), places=world.places[keep], cluster=cluster)


def followed(frames: Frames, model: PoseModel, world: World, config: SmoothConfig) -> IntArray:
    """Flower (m,) of each observation, -1 none: each frame of each cluster takes the better of both directions."""
    cov, _ = camera_covs(model, world.X)
    false = max(int((world.landmark < 0).sum()), 1) / max(frames.n_frames, 1) / view_volume(frames)
    follower = Follower(frames, world.T, cov, world.places, world.cluster, false, config.follow)
    forward, backward = follower.run()
    landmark = combine_directions(forward, backward, frames, world.cluster)
    if len(np.unique(world.cluster)) < len(world.places):
        agree = forward.landmark == backward.landmark
        alone = without_support(
            frames, world.T, world.places, world.cluster, landmark, agree, REST_SIGMA_M, config.follow.gate_chi2
        )
        landmark = np.where(alone, -1, landmark)
    return landmark


def let_all_stand(frames: Frames, world: World, config: SmoothConfig) -> World:
    """In a session of so few frames that nothing can be confirmed, what has no flower becomes one of its own."""
    free = np.flatnonzero(world.landmark < 0)
    if fewest_observations(frames, config) > 1 or len(free) == 0:
        return world
    n, landmark = len(world.places), world.landmark.copy()
    landmark[free] = n + np.arange(len(free))
    new = transform(world.T[frames.frame[free]], frames.points[free])
    alone = int(world.cluster.max(initial=-1)) + 1 + np.arange(len(free))
    return replace(
        world,
        landmark=landmark,
        places=np.concatenate([world.places, new]),
        cluster=np.concatenate([world.cluster, alone]),
    )


def solve(
    frames: Frames,
    model: PoseModel,
    world: World,
    config: SmoothConfig,
    n_iterations: int,
    *,
    in_stretches: bool = False,
    tied: Array | None = None,
) -> tuple[BatchSmoother, Estimate]:
    """Solve for poses, hand-eye transform, flowers and displacements, the association given.

    ``in_stretches``: displacements are correlated in time, as covariances need it; places hardly change by it.
    ``tied`` (3 l, 3 l): information that places have of each other.
    """
    smoother, start = problem(frames, model, world, in_stretches=in_stretches, tied=tied)
    threshold = chi2_threshold(3, config.outlier_probability)
    return smoother, smoother.solve(start, threshold, n_iterations, is_smoothed=world.cov_step is not None)


def problem(
    frames: Frames, model: PoseModel, world: World, *, in_stretches: bool = False, tied: Array | None = None
) -> tuple[BatchSmoother, Estimate]:
    """The graph of the session and where its solution starts."""
    of, frame, cluster = cluster_pairs(frames, world.landmark, world.cluster)
    d, cov = measured_displacements(frames, world.T, world.landmark, world.places, of, len(frame))
    camera, _ = camera_covs(model, world.X)
    share, left = taken_by_poses(frames, world.T, of, frame, cov, camera)
    scale = np.sqrt(world.noise.sway) * motion_scale(d, left, frame, cluster, frames.stamps)
    alone = np.bincount(world.cluster, minlength=1).max(initial=0) < 2
    if alone:
        scale = np.zeros_like(scale)  # flowers that stand alone tell no sway from errors of their own
    moved = Displaced(d, cov, share, scale, frame, cluster, frames.stamps)
    rest, lasting_s = standing_still(cov), 0.0
    if not alone:
        moved = beyond_rest(moved)
        rest, lasting_s = at_rest(moved)
    sigma = np.hypot(moved.scale, rest)
    stretch, stretch_sigma = np.full(len(frame), -1), np.empty(0)
    if in_stretches and not alone and len(frame):
        stretch, stretch_sigma, sigma = stretches(moved, rest, lasting_s)
    pairs = Pairs(of=of, frame=frame, cluster=cluster, sigma=sigma, stretch=stretch, stretch_sigma=stretch_sigma)
    start = Estimate(
        T=world.T,
        X=world.X,
        places=world.places,
        d=np.where(moved.scale[:, None] > 0, d, 0.0),
        weight=(world.landmark >= 0).astype(float),
        residual_chi2=np.full(len(frames), np.nan),
    )
    correlation = NO_WEIGHT if world.errs_slowly else world.noise.correlation
    return BatchSmoother(frames, model, world.landmark, pairs, correlation, tied), start


def observations_err_slowly(frames: Frames, model: PoseModel, world: World) -> bool:
    """Whether the observations of this session err slowly, if the odometry is believed as it is given."""
    given = model.given if world.X is None else model.given @ world.X
    w = transform(given[frames.frame], frames.points)
    var = np.trace(frames.covs, axis1=1, axis2=2) / 3.0
    places = group_means(w, var, world.landmark, len(world.places)).mean
    smoother, start = problem(frames, model, replace(world, T=given, places=places))
    return errs_slowly(smoother, replace(start, d=np.zeros_like(start.d)))


def regroup(
    frames: Frames, world: World, config: SmoothConfig, rng: np.random.Generator, claimed: BoolArray | None = None
) -> World:
    """Group the flowers again, now that it is known how each moved; wild observations (m,) have no say in that."""
    n = len(world.places)
    presence = presence_of(frames.frame, world.landmark, n, frames.n_frames)
    used = (world.landmark >= 0) if claimed is None else (world.landmark >= 0) & ~claimed
    u = np.full((frames.n_frames, n, 3), np.nan)
    var = np.full((frames.n_frames, n), np.nan)
    at = (frames.frame[used], world.landmark[used])
    u[at] = transform(world.T[frames.frame[used]], frames.points[used]) - world.places[world.landmark[used]]
    var[at] = np.trace(frames.covs[used], axis1=1, axis2=2) / 3.0
    # Errors that change slowly, of the poses or of the detector, look like motion that flowers have in common.
    motion = None if world.errs_slowly else Motion(u, var, frames.stamps)
    return replace(
        world,
        cluster=group_flowers(world.places, presence, motion, view_volume(frames), config.grouping, rng=rng),
    )


def same_groups(a: World, b: World) -> bool:
    """Whether two worlds with the same flowers have the same clusters, whatever their numbers."""
    both = np.unique(np.stack([a.cluster, b.cluster]), axis=1).shape[1]
    return bool(both == len(np.unique(a.cluster)) == len(np.unique(b.cluster)))


def settle(frames: Frames, world: World, smoother: BatchSmoother, estimate: Estimate) -> World:
    """Claim wild observations for their flowers, and let go what no flower explains."""
    n_clusters = int(world.cluster.max(initial=-1)) + 1
    pairs = smoother.pairs
    moved = np.zeros((frames.n_frames, n_clusters, 3))
    known = np.zeros((frames.n_frames, n_clusters), dtype=bool)
    moved[pairs.frame, pairs.cluster] = estimate.d
    known[pairs.frame, pairs.cluster] = True
    landmark, wild = claim_wild(frames, estimate.T, estimate.places, world.cluster, world.landmark, moved, known)
    landmark = let_go(landmark, estimate.residual_chi2, frames, wild, LEAST_WILD)
    return replace(world, landmark=landmark, wild_share=wild.share)


def drop_unsupported(frames: Frames, world: World, config: SmoothConfig) -> World:
    """Leave out what the last association does not support."""
    keep = supported(frames, world.T, world.places, world.landmark, fewest_observations(frames, config))
    _, cluster = np.unique(world.cluster[keep], return_inverse=True)
    return replace(world, landmark=compact(keep, world.landmark), places=world.places[keep], cluster=cluster)


def mend(
    frames: Frames, model: PoseModel, world: World, estimate: Estimate, pairs: Pairs, config: SmoothConfig
) -> tuple[World, list[tuple[int, int]]]:
    """Merge ghosts, drop what too few observations support, and look for flowers that were overlooked."""
    sigma = float(np.sqrt(np.median(scalar_var(frames, model))))
    duplicate_radius = max(0.6 * world.radius, 4.0 * sigma)
    landmark, merged = merge_ghosts(world.places, world.landmark, frames, duplicate_radius)
    keep = supported(frames, world.T, world.places, landmark, fewest_observations(frames, config))
    displacement = np.full((frames.n_frames, int(pairs.cluster.max(initial=0)) + 1, 3), np.nan)
    displacement[pairs.frame, pairs.cluster] = estimate.d
    owner = np.zeros(len(world.places), dtype=np.int64)
    used = (world.landmark >= 0) & (pairs.of >= 0)
    owner[world.landmark[used]] = pairs.cluster[pairs.of[used]]
    cov, _ = camera_covs(model, world.X)
    found = find_overlooked(
        frames,
        world.T,
        np.tile(cov, (frames.n_frames, 1, 1)),
        scalar_var(frames, model),
        landmark,
        world.places,
        displacement,
        owner,
        world.radius,
        duplicate_radius,
        min(14, max(fewest_observations(frames, config), 1)),
        config.tracklets,
    )
    landmark, places = compact(keep, landmark), world.places[keep]
    places = np.concatenate([places, found])
    # A new flower belongs to the cluster of the flower next to it until the next grouping.
    cluster = world.cluster[keep]
    if len(found) and len(cluster):
        nearest = np.linalg.norm(found[:, None] - places[None, : len(cluster)], axis=-1).argmin(axis=1)
        cluster = np.concatenate([cluster, cluster[nearest]])
    elif len(found):
        cluster = np.arange(len(found))
    _, cluster = np.unique(cluster, return_inverse=True)
    return replace(world, landmark=landmark, places=places, cluster=cluster), merged
