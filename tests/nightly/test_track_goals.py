"""Live tracking: identities, switches, trajectory, time and memory, on seeds that nothing was tuned on."""

from __future__ import annotations

import resource
from dataclasses import dataclass, replace
from time import process_time

import numpy as np
import pytest
from tables import Tables
from tracked import calibration_of

from cluster_slam import evaluate, smooth, track
from cluster_slam.live.replay import Replay
from cluster_slam.online import OnlineTracker
from cluster_slam.simulate import PRESETS, Simulated, simulate_session
from tracking.metrics import hota, identity_scores

pytestmark = pytest.mark.nightly
STRANGE = ("fps5", "fps15", "fps60", "small", "large", "sigma-half", "sigma-double")


@dataclass(frozen=True)
class Tracked:
    """What the tracker said of a session, row by row, and how long its frames took (s of the processor)."""

    world: Simulated
    flowers: np.ndarray
    clusters: np.ndarray
    seconds: np.ndarray
    memory_mb: np.ndarray

    def scores(self, after_s: float = 0.0) -> tuple[float, float]:
        """IDF1 of flowers and clusters, counted after some seconds."""
        session, truth = self.world.session, self.world.truth
        late = session.stamps[session.observations.frame] - session.stamps[0] >= after_s
        return (
            identity_scores(truth.flower_ids[late], self.flowers[late]).idf1,
            identity_scores(truth.cluster_ids[late], self.clusters[late]).idf1,
        )


def follow(world: Simulated, seed: int, *, calibrated: bool) -> Tracked:
    session = world.session
    given = calibration_of(world, seed) if calibrated else None
    tracker = OnlineTracker(session.noise, session.T_flange_camera, calibration=given, pose_error=session.pose_error)
    order, at = np.argsort(session.observations.frame, kind="stable"), 0
    flowers, clusters = np.full(len(order), -1), np.full(len(order), -1)
    seconds, memory = np.zeros(session.n_frames), np.zeros(session.n_frames)
    for i, frame in enumerate(Replay(session).frames()):
        begun = process_time()
        update = tracker.step(frame)
        seconds[i] = process_time() - begun
        memory[i] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
        rows = order[at : at + len(frame)]
        flowers[rows], clusters[rows], at = update.flower_ids, update.cluster_ids, at + len(frame)
    return Tracked(world, flowers, clusters, seconds, memory)


@pytest.mark.parametrize(("preset", "flower", "cluster"), [("moderate", 0.97, 0.99), ("hard", 0.85, 0.94)])
def test_with_a_calibration(preset: str, flower: float, cluster: float, add_row: Tables) -> None:
    for seed in range(331, 333):
        found = follow(simulate_session(PRESETS[preset], seed=seed), seed, calibrated=True)
        by_flower, by_cluster = found.scores()
        truth = found.world.truth
        p50, p99 = 1e3 * np.percentile(found.seconds, [50, 99])
        scores = {"hota_flower": hota(truth.flower_ids, found.flowers).hota, "p50_ms": p50, "p99_ms": p99}
        add_row("track", preset=preset, seed=seed, flower_idf1=by_flower, cluster_idf1=by_cluster, **scores)
        assert by_flower >= flower
        assert by_cluster >= cluster


def test_without_a_calibration_after_ten_seconds(add_row: Tables) -> None:
    found = follow(simulate_session(PRESETS["moderate"], seed=333), 333, calibrated=False)
    flower, cluster = found.scores(10.0)
    add_row("track-uncalibrated", flower_idf1=flower, cluster_idf1=cluster)
    assert flower >= 0.97
    assert cluster >= 0.99


def test_trajectory_and_landmarks_beside_smoothing(add_row: Tables) -> None:
    """With the calibration that ``smooth`` has found: what another one is off by would shift all flowers."""
    world = simulate_session(PRESETS["moderate"], seed=334)
    smoothed = smooth(world.session)
    live = evaluate(track(world.session, calibration=smoothed.calibration), world.session, world.truth)
    later = evaluate(smoothed, world.session, world.truth)
    assert live.ate_rmse_m is not None
    assert later.ate_rmse_m is not None
    assert live.flower_rmse_m is not None
    assert later.flower_rmse_m is not None
    trajectory, flowers = live.ate_rmse_m / later.ate_rmse_m, live.flower_rmse_m / later.flower_rmse_m
    add_row("track-against-smooth", trajectory=trajectory, flowers=flowers)
    assert trajectory <= 1.5
    assert flowers <= 1.3


@pytest.mark.parametrize("name", STRANGE)
def test_strange_worlds(name: str, add_row: Tables) -> None:
    world = simulate_session(replace(PRESETS[f"moderate-{name}"], duration_s=15.0), seed=335)
    flower, cluster = follow(world, 335, calibrated=True).scores()
    add_row("track-strange", world=name, flower_idf1=flower, cluster_idf1=cluster)
    assert flower >= 0.95
    assert cluster >= 0.95


def test_twenty_thousand_frames(add_row: Tables) -> None:
    found = follow(simulate_session(PRESETS["moderate-longest"], seed=336), 336, calibrated=True)
    flower, cluster = found.scores()
    early, late = (1e3 * np.percentile(part, 99) for part in (found.seconds[1000:2000], found.seconds[19000:]))
    grown = found.memory_mb[-1] - found.memory_mb[1000]
    add_row("track-long", flower_idf1=flower, cluster_idf1=cluster, p99_early=early, p99_late=late, grown_mb=grown)
    assert grown < 50.0
    assert late < 33.0
