"""Simulated sessions tracked live, and clusters hidden for a while."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.evaluation.trajectory import hand_eye_truth
from cluster_slam.geometry import se3_exp
from cluster_slam.live.replay import Replay
from cluster_slam.online import OnlineTracker
from cluster_slam.records import Calibration
from cluster_slam.simulate import PRESETS, Simulated, simulate_session

SIGMA = np.repeat([3e-4, 2e-4], 3)  # of a hand-eye transform as ``smooth`` finds it
FPS, HIDDEN_S, EVERY_S = 15, 10.0, 10.0 / 3.0
WATCHED = replace(  # all in view of a camera that hardly turns, a touch every three seconds
    PRESETS["moderate"],
    duration_s=62.0,
    fps=float(FPS),
    n_leaves=0,
    turn_rad=0.25,
    touches_per_minute=20.0,
    sway_m=0.03,
)


def calibration_of(world: Simulated, seed: int) -> Calibration | None:
    """The true hand-eye transform, with an error and its covariance."""
    true = hand_eye_truth(world.session, world.truth)
    if true is None:
        return None
    error = np.random.default_rng(seed).normal(size=6) * SIGMA
    return Calibration(true.T_flange_camera @ se3_exp(error), np.diag(SIGMA**2))


@dataclass(frozen=True)
class Trial:
    """A cluster whose detections are left out in the frames from ``begin`` to ``end``."""

    cluster: int
    begin: int
    end: int


def plan(world: Simulated, seed: int) -> list[Trial]:
    """Trials, three at a time: clusters of three flowers or more that are seen just before and just after."""
    truth, frame = world.truth, world.session.observations.frame
    counts = np.zeros((world.session.n_frames, int(truth.cluster_ids.max()) + 1), dtype=int)
    real = truth.cluster_ids >= 0
    np.add.at(counts, (frame[real], truth.cluster_ids[real]), 1)
    rng, trials, free = np.random.default_rng(seed), [], np.zeros(counts.shape[1], dtype=int)
    for start in np.arange(3.0, WATCHED.duration_s - HIDDEN_S - 1.5, EVERY_S):
        begin, end = int(start * FPS), int((start + HIDDEN_S) * FPS)
        before, after = counts[begin - FPS : begin].sum(0), counts[end : end + FPS].sum(0)
        large = np.bincount(truth.rest_cluster_ids, minlength=counts.shape[1]) >= 3
        able = np.flatnonzero((before >= 10) & (after >= 10) & large & (free < begin - 3 * FPS))
        if len(able):
            cluster = int(rng.choice(able))
            free[cluster] = end
            trials.append(Trial(cluster, begin, end))
    return trials


def hidden(seed: int) -> list[bool]:
    """Whether each hidden cluster came back as itself within a second."""
    world = simulate_session(WATCHED, seed=seed)
    session, truth, trials = world.session, world.truth, plan(world, seed)
    tracker = OnlineTracker(session.noise, session.T_flange_camera, calibration=calibration_of(world, seed))
    before: list[list[int]] = [[] for _ in trials]
    after: list[list[int]] = [[] for _ in trials]
    order, at = np.argsort(session.observations.frame, kind="stable"), 0
    for i, frame in enumerate(Replay(session).frames()):
        cluster = truth.cluster_ids[order[at : at + len(frame)]]
        at += len(frame)
        gone = [t.cluster for t in trials if t.begin <= i < t.end]
        keep = ~np.isin(cluster, gone)
        update = tracker.step(replace(frame, points=frame.points[keep], covs=frame.covs[keep], scores=None))
        for k, trial in enumerate(trials):
            names = update.cluster_ids[(cluster[keep] == trial.cluster) & (update.cluster_ids >= 0)].tolist()
            if trial.begin - FPS <= i < trial.begin:
                before[k] += names
            elif trial.end <= i < trial.end + FPS:
                after[k] += names
    pairs = [(b, a) for b, a in zip(before, after, strict=True) if b and a]
    return [bool(np.bincount(b).argmax() == np.bincount(a).argmax()) for b, a in pairs]
