"""The methods, each to be read like the method section of a paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from time import perf_counter

import numpy as np

from cluster_slam.association.displacement import (
    cluster_pairs,
    measured_displacements,
    motion_scale,
    presence_of,
)
from cluster_slam.association.frames import Frames, sort_by_frame, view_volume
from cluster_slam.association.landmarks import flower_spacing, group_means, merge_pieces
from cluster_slam.association.refine import compact, find_overlooked, merge_ghosts, supported
from cluster_slam.association.templates import Follower, combine_directions
from cluster_slam.association.tracklets import build_tracklets, relative_pose_cov
from cluster_slam.config import SmoothConfig
from cluster_slam.geometry import Array, transform
from cluster_slam.graph.batch import BatchSmoother, Estimate, Marginals, Pairs, PoseModel
from cluster_slam.graph.hand_eye import hand_eye_from_pieces
from cluster_slam.graph.noise import camera_covs, pose_model
from cluster_slam.graph.variance import VarianceFactors, displacement_correlation, errs_slowly, variance_factors
from cluster_slam.grouping import Motion, group_flowers
from cluster_slam.landmark_tables import RestMap, cluster_table, drift_table, flower_table
from cluster_slam.records import BoolArray, Calibration, Diagnostics, IntArray, RejectReason, Result, Session
from tracking.gating import chi2_threshold

Progress = Callable[[str, float], None]
_NO_WEIGHT = 1e6  # observations that must not bend the trajectory count as one in so many
_CALM_HAND_EYE_RAD = 0.005  # a hand-eye transform known so well does not spoil pieces
_REST_SIGMA_M = 0.0004  # ambient sway of a cluster at rest


@dataclass(frozen=True, slots=True, eq=False)
class _World:
    """What is known while the session is being associated."""

    T: Array  # (n, 4, 4) camera poses
    X: Array | None  # hand-eye
    landmark: IntArray  # (m,)
    places: Array  # (l, 3)
    cluster: IntArray  # (l,)
    radius: float  # pieces of one flower lie within, m
    noise: VarianceFactors  # what was found about the stated variances so far
    errs_slowly: bool = False  # errors of observations cannot be told from drift of the poses


def smooth(
    session: Session,
    *,
    config: SmoothConfig | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Result:
    """Smooth a whole session: who is who, where everything was, and how sure that is.

    Parameters
    ----------
    session : as ``open_session`` reads it.
    config : the options, defaults where None.
    seed : of what is random (K-means only).
    progress : called with the stage in words and a fraction 0..1.
    """
    config = config or SmoothConfig()
    say = progress or (lambda _stage, _fraction: None)
    rng = np.random.default_rng(seed)
    clock = _Clock()
    stated = sort_by_frame(session.observations, session.stamps)
    stated_poses = pose_model(session)
    say("calibrating", 0.0)
    world = _first_world(stated, stated_poses, config, rng)
    clock.lap("landmarks")
    merged: list[tuple[int, int]] = []
    for i in range(config.max_rounds):
        frames, model = _with_variances(stated, stated_poses, world.noise)
        say(f"associating, round {i + 1}", 0.15 + 0.7 * i / config.max_rounds)
        before = world.landmark
        world = _associate(frames, model, world, config)
        clock.lap("association")
        say(f"smoothing, round {i + 1}", 0.15 + 0.7 * (i + 0.6) / config.max_rounds)
        is_last = (
            len(frames) == 0
            or i + 1 == config.max_rounds
            or (i > 0 and int((world.landmark != before).sum()) < 5e-4 * len(before))
        )
        if i == 0 and model.cov_step is not None:
            world = replace(world, errs_slowly=_errs_slowly(frames, model, world))
        smoother, estimate = _smooth(frames, model, world, config, 2)
        world = _learn(world, smoother, estimate)
        world = _regroup(frames, world, config, rng)
        clock.lap("smoothing")
        if is_last:
            break
        world, new = _mend(frames, model, world, estimate, smoother.pairs, config)
        merged += new
    world = _drop_unsupported(stated, world, config)
    say("smoothing all", 0.85)
    for n_iterations in (4, 2):
        frames, model = _with_variances(stated, stated_poses, world.noise)
        smoother, estimate = _smooth(frames, model, world, config, n_iterations)
        known, world = world.noise, _learn(world, smoother, estimate)
        if abs(np.log(world.noise.flower / known.flower)) + abs(np.log(world.noise.pose / known.pose)) < 0.1:
            break
    if world.errs_slowly:  # all observations of a flower say the same: its place is as uncertain as one of them
        smoother.correlation = float(np.bincount(smoother.landmark, minlength=1).max())
    smoother.pairs = replace(
        smoother.pairs, sigma=smoother.pairs.sigma * np.sqrt(displacement_correlation(smoother, estimate))
    )
    marginals = smoother.marginals(estimate)
    clock.lap("smoothing")
    return _result(session, frames, world, smoother, estimate, marginals, config, seed, merged, clock.laps)


def _with_variances(frames: Frames, model: PoseModel, noise: VarianceFactors) -> tuple[Frames, PoseModel]:
    """The session with the variances that were found instead of those that are stated."""
    return replace(frames, covs=frames.covs * noise.flower), replace(model, cov=model.cov * noise.pose)


def _learn(world: _World, smoother: BatchSmoother, estimate: Estimate) -> _World:
    """Take over what the smoothing found: poses, hand-eye transform, places, and how large the errors really are."""
    found = variance_factors(smoother, estimate)
    if world.errs_slowly:
        found = VarianceFactors(1.0, 1.0, _NO_WEIGHT)  # slow errors hide from residuals: the stated ones stay
    noise = VarianceFactors(world.noise.flower * found.flower, world.noise.pose * found.pose, found.correlation)
    return replace(world, T=estimate.T, X=estimate.X, places=estimate.places, noise=noise)


def _errs_slowly(frames: Frames, model: PoseModel, world: _World) -> bool:
    """Whether the observations of this session err slowly, if the odometry is believed as it is given."""
    given = model.given if world.X is None else model.given @ world.X
    w = transform(given[frames.frame], frames.points)
    var = np.trace(frames.covs, axis1=1, axis2=2) / 3.0
    places = group_means(w, var, world.landmark, len(world.places)).mean
    smoother, start = _problem(frames, model, replace(world, T=given, places=places))
    return errs_slowly(smoother, replace(start, d=np.zeros_like(start.d)))


class _Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = perf_counter()

    def lap(self, stage: str) -> None:
        now = perf_counter()
        self.laps[stage] = round(self.laps.get(stage, 0.0) + now - self._last, 3)
        self._last = now


def _first_world(stated: Frames, stated_poses: PoseModel, config: SmoothConfig, rng: np.random.Generator) -> _World:
    """Pieces, the hand-eye transform from them, landmarks from the pieces, and a first grouping."""
    X, cov_X = stated_poses.X0, stated_poses.cov_hand_eye
    noise = VarianceFactors(1.0, 1.0, 1.0)
    shortest = _shortest_piece(stated)
    for _ in range(3):
        frames, model = _with_variances(stated, stated_poses, noise)
        T = model.given if X is None else model.given @ X
        cov, step = camera_covs(model, X)
        relative = relative_pose_cov(T, frames.stamps, cov, None if X is None else cov_X, step, 0.5)
        pieces = build_tracklets(frames, T, relative, config.tracklets)
        long = _in_long_pieces(pieces.labels, shortest)
        factor = _innovation_factor(pieces.innovation_chi2[long])
        noise = VarianceFactors(noise.flower * factor, noise.pose * factor, 1.0)
        cov_before = cov_X
        if model.X0 is not None and long.any():
            X, data = hand_eye_from_pieces(
                model.given[frames.frame[long]],
                frames.points[long],
                _scalar_var(frames, model)[long],
                pieces.labels[long],
                model.X0,
                model.cov_hand_eye,
            )
            cov_X = np.linalg.inv(data + np.linalg.inv(model.cov_hand_eye))
        if factor == 1.0 and (X is None or cov_X[0, 0] + cov_before[0, 0] < _CALM_HAND_EYE_RAD**2):
            break
    T = model.given if X is None else model.given @ X
    w, var, labels = transform(T[frames.frame], frames.points), _scalar_var(frames, model), pieces.labels
    radius = 0.65 * _spacing(frames, w, var, labels, shortest)
    landmark, places = merge_pieces(w, var, labels, frames.frame, frames.n_frames, radius, shortest)
    keep = supported(frames, T, places, landmark, _minimum(frames, config))
    landmark, places = _keep(keep, landmark, places)
    presence = presence_of(frames.frame, landmark, len(places), frames.n_frames)
    cluster = group_flowers(places, presence, None, view_volume(frames), config.grouping, rng=rng)
    return _World(T, X, landmark, places, cluster, radius, noise)


def _innovation_factor(chi2: Array) -> float:
    """Factor on the stated variances that innovations of pieces ask for; one where they are about right."""
    chi2 = chi2[np.isfinite(chi2)]
    if len(chi2) < 50:
        return 1.0
    factor = float(np.median(chi2)) / chi2_threshold(3, 0.5)
    return factor if factor > 1.6 else 1.0  # errors that change slowly hide from innovations: never narrower here


def _scalar_var(frames: Frames, model: PoseModel) -> Array:
    """Variance (m,) along any axis of each observation in the world, with what a pose errs."""
    rotation, translation = model.cov[0, 0], model.cov[3, 3]
    lever_sq = (frames.points**2).sum(axis=1)
    return np.asarray(np.trace(frames.covs, axis1=1, axis2=2) / 3.0 + translation + rotation * lever_sq)


def _shortest_piece(frames: Frames) -> int:
    """Observations of a piece that counts: half a second, 5 to 15; fewer where the session is short."""
    if frames.n_frames < 2:
        return 1
    dt = float(np.median(np.diff(frames.stamps)))
    return int(min(np.clip(round(0.5 / dt), 5, 15), max(1, frames.n_frames // 4)))


def _minimum(frames: Frames, config: SmoothConfig) -> int:
    """Observations of a flower that counts: a few frames cannot confirm anything, there every one stands."""
    return int(min(config.min_observations, max(1, frames.n_frames // 4)))


def _in_long_pieces(labels: IntArray, shortest: int) -> BoolArray:
    count = np.bincount(labels[labels >= 0])
    long: BoolArray = count[labels] >= shortest
    return long


def _spacing(frames: Frames, w: Array, var: Array, labels: IntArray, shortest: int) -> float:
    """How close flowers stand, m, from pieces seen at the same time; where there are none, from the noise."""
    long = _in_long_pieces(labels, shortest)
    if not long.any():
        return 1.0
    _, piece = np.unique(labels[long], return_inverse=True)
    n = int(piece.max()) + 1
    groups = group_means(w[long], var[long], piece, n)
    presence = presence_of(frames.frame[long], piece, n, frames.n_frames)
    spacing = flower_spacing(groups.mean, presence, groups.count / np.maximum(groups.chi2, 0.5))
    return spacing if np.isfinite(spacing) else 6.0 * float(np.sqrt(np.median(var)))


def _keep(keep: BoolArray, landmark: IntArray, places: Array) -> tuple[IntArray, Array]:
    return compact(keep, landmark), places[keep]


def _associate(frames: Frames, model: PoseModel, world: _World, config: SmoothConfig) -> _World:
    """Follow the clusters forwards and backwards; each frame of each cluster takes the better of the two."""
    cov, _ = camera_covs(model, world.X)
    cov_pose = np.tile(cov, (frames.n_frames, 1, 1))
    forward = Follower(frames, world.T, cov_pose, world.places, world.cluster, config.follow).run()
    back = frames.reversed()
    backward = Follower(back, world.T[::-1], cov_pose, world.places, world.cluster, config.follow).run()
    landmark = np.empty(len(frames), dtype=np.int64)
    landmark[back.order] = backward.landmark
    backward = replace(backward, landmark=landmark, score=backward.score[::-1])
    landmark = combine_directions(forward, backward, frames, world.cluster)
    keep = np.bincount(landmark[landmark >= 0], minlength=len(world.places)) > 0
    _, cluster = np.unique(world.cluster[keep], return_inverse=True)
    return replace(world, landmark=compact(keep, landmark), places=world.places[keep], cluster=cluster)


def _smooth(
    frames: Frames, model: PoseModel, world: _World, config: SmoothConfig, n_iterations: int
) -> tuple[BatchSmoother, Estimate]:
    """Solve for poses, hand-eye transform, flowers and displacements, the association given."""
    smoother, start = _problem(frames, model, world)
    return smoother, smoother.solve(start, chi2_threshold(3, config.outlier_probability), n_iterations)


def _problem(frames: Frames, model: PoseModel, world: _World) -> tuple[BatchSmoother, Estimate]:
    """The graph of the session and where its solution starts."""
    of, frame, cluster = cluster_pairs(frames, world.landmark, world.cluster)
    d, cov = measured_displacements(frames, world.T, world.landmark, world.places, of, len(frame))
    pose_var = model.cov[3, 3] + model.cov[0, 0] * float(np.median((frames.points**2).sum(axis=1), keepdims=False))
    scale = motion_scale(d, cov + pose_var * np.eye(3), frame, cluster, frames.stamps)
    if np.bincount(world.cluster, minlength=1).max(initial=0) < 2:
        scale = np.zeros_like(scale)  # flowers that stand alone tell no sway from errors of their own
    pairs = Pairs(
        of=of,
        frame=frame,
        cluster=cluster,
        sigma=np.hypot(scale, _REST_SIGMA_M),
        stretch=np.full(len(frame), -1),
        stretch_sigma=np.empty(0),
    )
    start = Estimate(
        T=world.T,
        X=world.X,
        places=world.places,
        d=np.where(scale[:, None] > 0, d, 0.0),
        weight=(world.landmark >= 0).astype(float),
        residual_chi2=np.full(len(frames), np.nan),
    )
    correlation = _NO_WEIGHT if world.errs_slowly else world.noise.correlation
    return BatchSmoother(frames, model, world.landmark, pairs, correlation), start


def _regroup(frames: Frames, world: _World, config: SmoothConfig, rng: np.random.Generator) -> _World:
    """Group the flowers again, now that it is known how each moved."""
    n = len(world.places)
    presence = presence_of(frames.frame, world.landmark, n, frames.n_frames)
    used = world.landmark >= 0
    u = np.full((frames.n_frames, n, 3), np.nan)
    var = np.full((frames.n_frames, n), np.nan)
    at = (frames.frame[used], world.landmark[used])
    u[at] = transform(world.T[frames.frame[used]], frames.points[used]) - world.places[world.landmark[used]]
    var[at] = np.trace(frames.covs[used], axis1=1, axis2=2) / 3.0
    return replace(
        world,
        cluster=group_flowers(world.places, presence, Motion(u, var), view_volume(frames), config.grouping, rng=rng),
    )


def _drop_unsupported(frames: Frames, world: _World, config: SmoothConfig) -> _World:
    """Leave out what the last association does not support."""
    keep = supported(frames, world.T, world.places, world.landmark, _minimum(frames, config))
    _, cluster = np.unique(world.cluster[keep], return_inverse=True)
    return replace(world, landmark=compact(keep, world.landmark), places=world.places[keep], cluster=cluster)


def _mend(
    frames: Frames, model: PoseModel, world: _World, estimate: Estimate, pairs: Pairs, config: SmoothConfig
) -> tuple[_World, list[tuple[int, int]]]:
    """Merge ghosts, drop what too few observations support, and look for flowers that were overlooked."""
    sigma = float(np.sqrt(np.median(_scalar_var(frames, model))))
    duplicate_radius = max(0.6 * world.radius, 4.0 * sigma)
    landmark, merged = merge_ghosts(world.places, world.landmark, frames, duplicate_radius)
    keep = supported(frames, world.T, world.places, landmark, _minimum(frames, config))
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
        _scalar_var(frames, model),
        landmark,
        world.places,
        displacement,
        owner,
        world.radius,
        duplicate_radius,
        min(14, max(_minimum(frames, config), 1)),
        config.tracklets,
    )
    landmark, places = _keep(keep, landmark, world.places)
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


def _result(
    session: Session,
    frames: Frames,
    world: _World,
    smoother: BatchSmoother,
    estimate: Estimate,
    marginals: Marginals,
    config: SmoothConfig,
    seed: int,
    merged: list[tuple[int, int]],
    timings: dict[str, float],
) -> Result:
    """Put everything into the tables of a result, in the order of the input's rows."""
    threshold = chi2_threshold(3, config.outlier_probability)
    outlier = (world.landmark >= 0) & (estimate.weight < 0.5)
    rest = RestMap(estimate.places, marginals.places, world.cluster, world.landmark)
    flowers = flower_table(rest, frames)
    n_clusters = int(world.cluster.max(initial=-1)) + 1
    warnings = _shortcomings(session, frames, world)
    confirmed = np.zeros(n_clusters, dtype=bool)
    np.logical_or.at(confirmed, world.cluster, _is_confirmed(world, outlier, _minimum(frames, config)))
    clusters = cluster_table(rest, frames, confirmed)
    pairs = smoother.pairs
    _, cov = measured_displacements(frames, estimate.T, world.landmark, estimate.places, pairs.of, len(pairs.frame))
    drift = drift_table(rest, frames, clusters, estimate.d, pairs.sigma**2, cov)
    flower_ids = np.full(len(frames), -1, dtype=np.int64)
    flower_ids[frames.order] = world.landmark
    cluster_ids = np.where(flower_ids >= 0, world.cluster[flower_ids], -1) if n_clusters else flower_ids
    reasons = np.full(len(frames), int(RejectReason.POSITION_GATE))
    reasons[frames.order] = np.where(
        outlier, int(RejectReason.OUTLIER), np.where(world.landmark >= 0, 0, int(RejectReason.POSITION_GATE))
    )
    nis = np.full(len(frames), np.nan)
    nis[frames.order] = estimate.residual_chi2
    calibration = None
    if estimate.X is not None and marginals.hand_eye is not None:
        calibration = Calibration(estimate.X, marginals.hand_eye)
    return Result(
        session=session,
        T_world_camera=estimate.T,
        flower_ids=flower_ids,
        cluster_ids=cluster_ids,
        flowers=flowers,
        clusters=clusters,
        drift=drift,
        calibration=calibration,
        diagnostics=Diagnostics(nis=nis, reasons=reasons),
        config=asdict(config),
        seed=seed,
        timings_s=timings,
        counts={
            "frames": frames.n_frames,
            "observations": len(frames),
            "flowers": len(flowers),
            "clusters": len(clusters),
            "clutter": int((world.landmark < 0).sum()),
            "outliers": int((np.nan_to_num(estimate.residual_chi2) > threshold).sum()),
        },
        warnings=(*session.warnings, *warnings),
        merged=tuple(merged),
        status="poor" if warnings else "ok",
    )


def _is_confirmed(world: _World, outlier: BoolArray, minimum: int) -> BoolArray:
    """Which flowers (l,) stand: enough observations that agree, and more of those than of others."""
    n = len(world.places)
    total = np.bincount(world.landmark[world.landmark >= 0], minlength=n)
    disagree = np.bincount(world.landmark[outlier], minlength=n)
    stands: BoolArray = (total - disagree >= minimum) & (disagree <= 0.5 * total)
    return stands


def _shortcomings(session: Session, frames: Frames, world: _World) -> tuple[str, ...]:
    """Why the result is poor, in words; empty where it is not."""
    if len(frames) == 0:
        return ("no flowers in the session: there is nothing to find",)
    if len(world.places) == 0:
        return (f"none of the {len(frames)} observations was seen again: no flower could be confirmed",)
    share = float((world.landmark >= 0).mean())
    if share < 0.5:
        return (f"only {100 * share:.0f} % of the observations belong to a flower: the rest was taken for false ones",)
    return ()
