"""``track``: causal, complete, and as good as it must be."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest

from cluster_slam import evaluate, track
from cluster_slam.cli.app import run
from cluster_slam.evaluation import Metrics
from cluster_slam.evaluation.trajectory import hand_eye_truth
from cluster_slam.records import Calibration, Result, Session
from cluster_slam.simulate import PRESETS, Simulated, simulate_session

SEED = 5


@cache
def made() -> Simulated:
    return simulate_session(PRESETS["sample"], seed=SEED)


@cache
def calibration() -> Calibration:
    """The true hand-eye transform, known as well as ``smooth`` finds it."""
    true = hand_eye_truth(made().session, made().truth)
    assert true is not None
    return Calibration(true.T_flange_camera, np.diag(np.repeat([3e-4, 2e-4], 3) ** 2))


@cache
def tracked() -> Result:
    return track(made().session, calibration=calibration())


@cache
def metrics() -> Metrics:
    return evaluate(tracked(), made().session, made().truth)


def first_frames(session: Session, n: int) -> Session:
    seen = session.observations
    keep = seen.frame < n
    part = replace(
        seen, frame=seen.frame[keep], points=seen.points[keep], covs=seen.covs[keep], scores=seen.scores[keep]
    )
    return replace(session, stamps=session.stamps[:n], poses=session.poses[:n], observations=part)


def test_it_is_causal() -> None:
    """What comes later changes no row: the first half alone gives the same rows as the whole."""
    session = made().session
    n = session.n_frames // 2
    half = track(first_frames(session, n), calibration=calibration())
    early = session.observations.frame < n
    np.testing.assert_array_equal(half.flower_ids, tracked().flower_ids[early])
    np.testing.assert_array_equal(half.cluster_ids, tracked().cluster_ids[early])
    np.testing.assert_array_equal(half.T_world_camera, tracked().T_world_camera[:n])


def test_the_order_of_rows_does_not_matter() -> None:
    session, rng = made().session, np.random.default_rng(0)
    order = rng.permutation(len(session.observations))
    seen = session.observations
    mixed = replace(
        seen, frame=seen.frame[order], points=seen.points[order], covs=seen.covs[order], scores=seen.scores[order]
    )
    kept = np.argsort(mixed.frame, kind="stable")
    again = track(
        replace(
            session,
            observations=replace(
                seen,
                frame=mixed.frame[kept],
                points=mixed.points[kept],
                covs=mixed.covs[kept],
                scores=mixed.scores[kept],
            ),
        )
    )
    back = track(replace(session, observations=mixed))
    np.testing.assert_array_equal(back.flower_ids[kept], again.flower_ids)


def test_identities_and_trajectory() -> None:
    found = metrics()
    assert found.cluster_idf1 is not None
    assert found.cluster_idf1 > 0.84
    assert found.flower_idf1 is not None
    assert found.flower_idf1 > 0.98
    assert found.ate_rmse_m is not None
    assert found.ate_rmse_given_m is not None
    assert found.ate_rmse_m < found.ate_rmse_given_m


def test_the_hand_eye_transform_is_found_on_the_way() -> None:
    """Ten seconds without a calibration: most of its error is gone, and what is left is as large as is said."""
    found = evaluate(track(made().session), made().session, made().truth)
    assert found.hand_eye_m is not None
    assert found.hand_eye_given_m is not None
    assert found.hand_eye_m < 0.5 * found.hand_eye_given_m
    assert found.nees_hand_eye is not None
    assert found.nees_hand_eye < 4.0


def test_tables_belong_together() -> None:
    result = tracked()
    assert (np.diff(result.flowers.ids) > 0).all()
    assert set(result.flowers.cluster_ids.tolist()) == set(result.clusters.ids.tolist())
    for cluster, position in zip(result.clusters.ids, result.clusters.positions, strict=True):
        members = result.flowers.positions[result.flowers.cluster_ids == cluster]
        np.testing.assert_allclose(members.mean(axis=0), position, atol=1e-12)
    assert ((result.flower_ids < 0) == (result.cluster_ids < 0)).all()
    assert (np.linalg.eigvalsh(result.flowers.covs)[:, 0] > 0).all()
    assert (np.linalg.eigvalsh(result.drift.covs)[:, 0] > 0).all()


def test_the_command_writes_a_result(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    session = tmp_path / "session"
    assert run(["simulate", str(session), "--preset", "sample", "--set", "duration_s=3", "--quiet"]) == 0
    out = tmp_path / "out"
    assert run(["track", str(session), "-o", str(out), "--json"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert said["command"] == "track"
    assert said["metrics"]["flower_idf1"] > 0.9
    assert {p.name for p in out.iterdir()} >= {"trajectory.txt", "observations.csv", "drift.csv", "report.html"}
    assert not (tmp_path / "out.tracking").exists()
    assert run(["evaluate", str(out), str(session), "--quiet"]) == 0


def test_what_drifts_is_said_to_drift() -> None:
    world = simulate_session(replace(PRESETS["moderate-odometry"], duration_s=3.0, fps=15.0), seed=6)
    assert any("poses drift" in text for text in track(world.session).warnings)
    assert not any("poses drift" in text for text in tracked().warnings)
