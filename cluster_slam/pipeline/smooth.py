"""Smoothing of a whole session, to be read like the method section of a paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from time import perf_counter

import numpy as np

from cluster_slam.association.frames import Frames, sort_by_frame
from cluster_slam.config import SmoothConfig
from cluster_slam.geometry import Array
from cluster_slam.graph.batch import BatchSmoother, Estimate, Marginals
from cluster_slam.graph.innovations import squared_innovations
from cluster_slam.graph.noise import pose_model
from cluster_slam.graph.poses import PoseModel
from cluster_slam.pipeline.followed import world_followed_live
from cluster_slam.records import Result, Session
from cluster_slam.smoothing.again import follow_joined, same_noise, settle_again
from cluster_slam.smoothing.finish import make_result
from cluster_slam.smoothing.first import first_world
from cluster_slam.smoothing.looks import solve_in_looks
from cluster_slam.smoothing.rounds import (
    associate,
    drop_unsupported,
    let_all_stand,
    mend,
    observations_err_slowly,
    regroup,
    same_groups,
    settle,
    solve,
)
from cluster_slam.smoothing.world import World, corrected, for_solving, learn, say_how_sure, with_unknown_scale

Progress = Callable[[str, float], None]


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
    world = first_world(
        stated, stated_poses, config, rng, lambda: world_followed_live(session, stated, stated_poses, seed)
    )
    if not session.observations.has_covariance:
        world = replace(world, only_sigma=session.noise.flower)
    stated, stated_poses = corrected(stated, stated_poses, world.instruments)
    noise_stated = world.noise
    clock.lap("landmarks")
    merged: list[tuple[int, int]] = []
    drifts = world.cov_step is not None
    if not drifts:  # where drift was followed, the association has been made with it
        world, merged = _associate_and_smooth(stated, stated_poses, world, config, rng, say, clock)
        world = drop_unsupported(stated, world, config)
    say("smoothing all", 0.85)
    frames, model = for_solving(stated, stated_poses, world)
    smoother, estimate = solve(frames, model, world, config, 4)
    before = world.landmark
    if not drifts and not world.errs_slowly:
        world = settle(frames, world, smoother, estimate)
    claimed, noise = world.landmark != before, world.noise
    world = let_all_stand(frames, learn(world, smoother, estimate), config)
    for i in range(config.max_rounds):
        grouped = world if drifts else regroup(frames, world, config, rng, claimed)
        if i > 0 and same_groups(world, grouped):
            break
        if i == 0 and not drifts:
            followed = follow_joined(frames, model, grouped, world.cluster, config)
            if followed is not grouped or not same_noise(noise, world.noise):
                grouped = settle_again(stated, stated_poses, followed, noise_stated, config)
        world = grouped
        frames, model = for_solving(stated, stated_poses, world)
        smoother, estimate = solve(frames, model, world, config, 2, in_stretches=True)
        world = learn(world, smoother, estimate)
    world, smoother, estimate, marginals, nis = _conclude(stated, stated_poses, world, smoother, estimate, config)
    marginals = with_unknown_scale(marginals, estimate, world.instruments, session.noise)
    clock.lap("smoothing")
    return make_result(session, frames, world, smoother, estimate, marginals, nis, config, seed, merged, clock.laps)


def _conclude(
    stated: Frames,
    stated_poses: PoseModel,
    world: World,
    smoother: BatchSmoother,
    estimate: Estimate,
    config: SmoothConfig,
) -> tuple[World, BatchSmoother, Estimate, Marginals, Array]:
    """Errors that last, where there are any; the last step in GTSAM; how sure all is, and the squared innovations."""
    in_looks = None
    if world.cov_step is None and not world.errs_slowly:
        in_looks = solve_in_looks(stated, stated_poses, world, estimate, config)
    if in_looks is not None:
        smoother, estimate = in_looks.smoother, in_looks.estimate
    estimate, _ = smoother.step(estimate, in_gtsam=True)
    say_how_sure(smoother, stated, stated_poses, world if in_looks is None else in_looks.world)
    marginals, nis = smoother.marginals(estimate), squared_innovations(smoother, estimate)
    if in_looks is not None:
        estimate, marginals = in_looks.looks.flowers(estimate), in_looks.looks.flowers_marginals(marginals)
        world = replace(world, T=estimate.T, X=estimate.X, places=estimate.places, lasting=in_looks.lasting)
    return world, smoother, estimate, marginals, nis


def _associate_and_smooth(
    stated: Frames,
    stated_poses: PoseModel,
    world: World,
    config: SmoothConfig,
    rng: np.random.Generator,
    say: Progress,
    clock: _Clock,
) -> tuple[World, list[tuple[int, int]]]:
    """Associate, smooth, group, mend the landmarks, and again, until nothing changes."""
    merged: list[tuple[int, int]] = []
    for i in range(config.max_rounds):
        frames, model = for_solving(stated, stated_poses, world)
        say(f"associating, round {i + 1}", 0.15 + 0.7 * i / config.max_rounds)
        before = world.landmark
        world = associate(frames, model, world, config)
        clock.lap("association")
        say(f"smoothing, round {i + 1}", 0.15 + 0.7 * (i + 0.6) / config.max_rounds)
        is_last = (
            len(frames) == 0
            or i + 1 == config.max_rounds
            or (i > 0 and int((world.landmark != before).sum()) < 5e-4 * len(before))
        )
        if i == 0 and model.cov_step is not None:
            world = replace(world, errs_slowly=observations_err_slowly(frames, model, world))
        smoother, estimate = solve(frames, model, world, config, 2)
        world = learn(world, smoother, estimate)
        before_groups, world = world.cluster, regroup(frames, world, config, rng)
        clock.lap("smoothing")
        if is_last:
            world = follow_joined(frames, model, world, before_groups, config)
            clock.lap("association")
            break
        world, new = mend(frames, model, world, estimate, smoother.pairs, config)
        merged += new
    return world, merged


class _Clock:
    """Seconds by stage."""

    def __init__(self) -> None:
        self.laps: dict[str, float] = {}
        self._last = perf_counter()

    def lap(self, stage: str) -> None:
        now = perf_counter()
        self.laps[stage] = round(self.laps.get(stage, 0.0) + now - self._last, 3)
        self._last = now
