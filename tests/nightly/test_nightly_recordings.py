"""The figures on recordings of other people; the environment variable CLUSTER_SLAM_DATA names their folder."""

from __future__ import annotations

import os
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from oracle import smooth_with_truth
from tables import Tables

from cluster_slam import evaluate, open_session, smooth
from cluster_slam.evaluation import Metrics
from cluster_slam.geometry import Array, transform
from cluster_slam.io.session import open_truth
from cluster_slam.records import Result, Session, Truth

DATA = Path(os.environ.get("CLUSTER_SLAM_DATA", "/nowhere"))
NEAR_M, ABOUT_M = 0.06, 0.25  # a landmark stands at an object within; detections are of an object within
pytestmark = [
    pytest.mark.nightly,
    pytest.mark.recordings,
    pytest.mark.skipif(not DATA.is_dir(), reason="CLUSTER_SLAM_DATA names no folder of recordings"),
]


def recordings(prefix: str) -> list[str]:
    """Names of the recordings that begin so."""
    return sorted(path.name for path in DATA.glob(f"{prefix}*") if path.is_dir())


@cache
def smoothed(name: str) -> tuple[Session, Truth, Result, Metrics]:
    """A recording with its truth, what ``smooth`` made of it, and how good that is."""
    session = open_session(DATA / name)
    truth = open_truth(DATA / name, session)
    assert truth is not None
    result = smooth(session)
    return session, truth, result, evaluate(result, session, truth)


def confirmed(result: Result) -> Array:
    """Places (c, 3) of the confirmed clusters."""
    states = np.array([state == "confirmed" for state in result.clusters.states], dtype=bool)
    return result.clusters.positions[states]


@pytest.mark.parametrize("name", recordings("mrclam6-"))
def test_wheeled_robot(name: str, add_row: Tables) -> None:
    session, truth, result, metrics = smoothed(name)
    told = evaluate(smooth_with_truth(session, truth), session, truth)
    assert metrics.ate_rmse_m is not None
    assert told.ate_rmse_m is not None
    ratio, n = metrics.ate_rmse_m / told.ate_rmse_m, len(confirmed(result))
    add_row(
        "wheeled",
        session=name,
        landmark_idf1=metrics.cluster_idf1,
        landmarks=n,
        trajectory_m=metrics.ate_rmse_m,
        told_m=told.ate_rmse_m,
        given_m=metrics.ate_rmse_given_m,
        ratio=ratio,
    )
    assert (metrics.cluster_idf1 or 0) >= 0.97
    assert n == 15
    assert ratio <= 1.2


@pytest.mark.parametrize("name", recordings("ycbv-"))
def test_household_objects(name: str, add_row: Tables) -> None:
    session, truth, result, metrics = smoothed(name)
    sure, found, ghosts = objects(session, truth, result)
    assert metrics.ate_rmse_m is not None
    assert metrics.ate_rmse_given_m is not None
    ratio = metrics.ate_rmse_m / metrics.ate_rmse_given_m
    trajectory = {"trajectory_m": metrics.ate_rmse_m, "given_m": metrics.ate_rmse_given_m, "ratio": ratio}
    add_row("objects", session=name, objects_that_count=sure, found=found, ghosts=ghosts, **trajectory)
    assert found == sure
    assert ratio <= 1.02


def test_few_ghosts_among_household_objects(add_row: Tables) -> None:
    names = recordings("ycbv-")
    ghosts = [objects(*smoothed(name)[:3])[2] for name in names]
    add_row("ghosts", sequences=len(names), ghosts_on_average=float(np.mean(ghosts)))
    assert np.mean(ghosts) <= 1


def objects(session: Session, truth: Truth, result: Result) -> tuple[int, int, int]:
    """Objects that count (4 in 10 of the detections about them are good), those of them found, and ghosts."""
    assert truth.rest_positions is not None
    seen = transform(session.T_world_camera[session.observations.frame], session.observations.points)
    away = np.linalg.norm(seen[:, None] - truth.rest_positions, axis=-1)
    counts = (away <= NEAR_M).sum(0) >= 0.4 * np.maximum((away <= ABOUT_M).sum(0), 1)
    far = np.linalg.norm(confirmed(result)[:, None] - truth.rest_positions, axis=-1)
    is_found = (far <= NEAR_M).any(0)
    n_ghosts = len(far) - int(is_found.sum())  # a second landmark at an object is a ghost too
    return int(counts.sum()), int((counts & is_found).sum()), n_ghosts


@pytest.mark.parametrize("name", recordings("handeye-"))
def test_hand_eye_from_nothing(name: str, add_row: Tables) -> None:
    session, truth, result, _ = smoothed(name)
    assert truth.flower_ids is not None
    assert result.calibration is not None
    T = session.poses[session.observations.frame] @ result.calibration.T_flange_camera
    where = transform(T, session.observations.points)
    medians = np.array([np.median(where[truth.flower_ids == i], axis=0) for i in range(truth.flower_ids.max() + 1)])
    known = truth.flower_ids >= 0
    scatter = 1e3 * float(np.median(np.linalg.norm(where[known] - medians[truth.flower_ids[known]], axis=1)))
    sigma = 1e3 * float(np.sqrt(np.diag(result.calibration.cov)[3:].max()))
    add_row("board", session=name, median_scatter_mm=scatter, translation_known_to_mm=sigma)
    assert scatter <= 3.6


@pytest.mark.parametrize("name", recordings("strawberry"))
def test_single_frames(name: str, add_row: Tables) -> None:
    if not (DATA / name / "poses.txt").is_file():
        pytest.skip("pictures alone, without poses")
    session, _, result, metrics = smoothed(name)
    add_row(
        "strawberries",
        session=name,
        detections=len(session.observations),
        clusters=len(result.clusters),
        cluster_idf1=metrics.cluster_idf1,
    )
    assert len(result.clusters) >= 1
    assert (result.flower_ids >= 0).all()
    assert set(result.clusters.states) == {"confirmed"}
