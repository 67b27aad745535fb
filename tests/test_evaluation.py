"""Evaluation against results whose errors are known."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest
from made_result import CAMERA_SIGMA, FLANGE_SIGMA, FLOWER_SIGMA, Made, make

from cluster_slam.evaluation import Metrics, evaluate
from cluster_slam.evaluation.landmarks import cluster_errors, flower_errors, ghost_clusters, normalised_squared
from cluster_slam.evaluation.trajectory import absolute_error, align_points, alignment, hand_eye_truth, relative_error
from cluster_slam.geometry import inverse, se3_exp, transform
from cluster_slam.records import Clusters, Drift, Flowers, Observations, Truth
from tracking.metrics import identity_scores

FORMAT_KEYS = [
    *("ate_rmse_m", "ate_rotation_rad", "cluster_idf1", "flower_idf1", "cluster_hota", "flower_hota"),
    *("clutter_precision", "clutter_recall", "flower_rmse_m", "nees_flowers", "nees_clusters"),
    *("hand_eye_m", "hand_eye_rad"),
]


@pytest.fixture(scope="module")
def made() -> Made:
    return make(0)


def score(made: Made, **changes: object) -> Metrics:
    return evaluate(replace(made.result, **changes), made.session, made.truth)


def test_all_keys_of_the_format_are_there(made: Made) -> None:
    values = score(made).as_json()
    assert set(FORMAT_KEYS) <= set(values)
    assert all(np.isfinite(v) for v in values.values())


def test_errors_drawn_from_stated_covariances() -> None:
    """Over 20 worlds of about 27 flowers: NEES of 1 within 4 standard errors (variance of chi2_3 / 3 is 2 / 3)."""
    metrics = [evaluate(m.result, m.session, m.truth) for m in (make(seed, n_frames=60) for seed in range(20))]
    nees = np.array([m.nees_flowers for m in metrics])
    count = np.array([m.n_flowers_compared for m in metrics])
    assert np.average(nees, weights=count) == pytest.approx(1.0, abs=4 * np.sqrt(2 / 3 / count.sum()))
    clusters = np.array([m.nees_clusters for m in metrics])
    assert clusters.mean() == pytest.approx(1.0, abs=4 * np.sqrt(2 / 3 / (6 * 20)))
    hand_eye = np.array([m.nees_hand_eye for m in metrics])
    assert hand_eye.mean() == pytest.approx(1.0, abs=4 * np.sqrt(2 / 6 / 20))
    rmse = np.sqrt(np.average([m.flower_rmse_m**2 for m in metrics], weights=count))
    assert rmse == pytest.approx(np.linalg.norm(FLOWER_SIGMA), rel=4 / np.sqrt(2 * count.sum()))
    assert np.average([m.inside95_flowers for m in metrics], weights=count) == pytest.approx(0.95, abs=0.04)


def test_trajectory_error_is_what_was_put_in(made: Made) -> None:
    metrics = score(made)
    expected = np.linalg.norm(CAMERA_SIGMA[3:])
    assert metrics.ate_rmse_unaligned_m == pytest.approx(expected, rel=0.12)
    assert metrics.ate_rotation_unaligned_rad == pytest.approx(np.linalg.norm(CAMERA_SIGMA[:3]), rel=0.12)
    assert metrics.ate_rmse_m == pytest.approx(metrics.ate_rmse_unaligned_m, rel=0.1)
    assert metrics.rpe_translation_m == pytest.approx(np.sqrt(2) * expected, rel=0.12)
    assert metrics.ate_rmse_given_m == pytest.approx(np.linalg.norm(FLANGE_SIGMA[3:]), rel=0.15)


def test_a_moved_world_shows_unaligned_only(made: Made) -> None:
    T = se3_exp(np.array([0.0, 0.0, 0.5, 1.0, 0.0, 0.0]))
    plain, moved = score(made), score(made, T_world_camera=T @ made.result.T_world_camera)
    assert moved.ate_rmse_m == pytest.approx(plain.ate_rmse_m)
    assert moved.ate_rotation_rad == pytest.approx(plain.ate_rotation_rad)
    assert moved.ate_rmse_unaligned_m > 0.5
    assert moved.ate_rotation_unaligned_rad == pytest.approx(0.5, rel=0.01)


def test_absolute_error_by_hand() -> None:
    true = np.tile(np.eye(4), (2, 1, 1))
    estimated = se3_exp(np.array([[0.0, 0.0, 0.3, 0.0, 0.0, 0.0], [0.0, 0.0, 0.0, 3.0, 4.0, 0.0]]))
    error = absolute_error(estimated, true)
    assert error.position_m == pytest.approx(np.sqrt(25 / 2))
    assert error.rotation_rad == pytest.approx(np.sqrt(0.09 / 2))


@pytest.mark.parametrize("path", ["plane", "line", "point", "one"])
def test_alignment_undoes_a_rigid_motion(path: str) -> None:
    rng = np.random.default_rng(3)
    n = 1 if path == "one" else 20
    true = se3_exp(rng.normal(size=(n, 6)))
    shape = {"plane": [1, 1, 0], "line": [1, 0, 0], "point": [0, 0, 0], "one": [1, 1, 1]}[path]
    true[:, :3, 3] *= shape
    T = se3_exp(rng.normal(size=6))
    found = alignment(T @ true, true)
    np.testing.assert_allclose(found, inverse(T), atol=1e-9)


def test_relative_error_ignores_gaps() -> None:
    stamps = np.array([0.0, 0.5, 1.0, 10.0])
    true = np.tile(np.eye(4), (4, 1, 1))
    estimated = true.copy()
    estimated[:, 0, 3] = [0.0, 7.0, 0.2, 100.0]
    error = relative_error(estimated, true, stamps)
    assert error is not None
    assert error.position_m == pytest.approx(0.2)  # the pair 0 and 1 s alone
    assert relative_error(estimated[:2], true[:2], stamps[:2]) is None


def test_hand_eye_truth_from_poses(made: Made) -> None:
    found = hand_eye_truth(made.session, made.truth)
    assert found is not None
    exact = se3_exp(np.array([0.02, -0.01, 1.57, 0.01, -0.02, 0.06]))
    assert np.linalg.norm(found.T_flange_camera[:3, 3] - exact[:3, 3]) < 5e-4
    assert np.sqrt(np.diag(found.cov)[0]) == pytest.approx(0.002 / np.sqrt(240), rel=0.2)
    stated = hand_eye_truth(made.session, replace(made.truth, T_flange_camera=exact))
    assert stated is not None
    assert not stated.cov.any()
    drifting = replace(made.session, pose_error="odometry")
    assert hand_eye_truth(drifting, made.truth) is None


def test_hand_eye_error_by_hand(made: Made) -> None:
    exact = se3_exp(np.array([0.02, -0.01, 1.57, 0.01, -0.02, 0.06]))
    calibration = made.result.calibration
    assert calibration is not None
    wrong = replace(calibration, T_flange_camera=exact @ se3_exp(np.array([0, 0.01, 0, 0, 0, 0.0])))
    shifted = wrong.T_flange_camera.copy()
    shifted[:3, 3] += [0.003, 0.004, 0.0]
    wrong = replace(wrong, T_flange_camera=shifted)
    truth = replace(made.truth, T_flange_camera=exact)
    metrics = evaluate(replace(made.result, calibration=wrong), made.session, truth)
    assert metrics.hand_eye_rad == pytest.approx(0.01)
    assert metrics.hand_eye_m == pytest.approx(0.005)


def test_a_truth_that_is_less_sure_than_the_estimate_does_not_judge_it(made: Made) -> None:
    assert made.result.calibration is not None
    surer = replace(made.result.calibration, cov=1e-12 * np.eye(6))
    metrics = evaluate(replace(made.result, calibration=surer), made.session, made.truth)
    assert metrics.nees_hand_eye is None
    assert metrics.hand_eye_m is not None


def test_clutter_scores_by_hand(made: Made) -> None:
    true = made.truth.flower_ids
    assert true is not None
    called = np.where(np.arange(len(true)) % 2 == 0, -1, true + 100)
    metrics = score(made, flower_ids=called)
    both = ((true == -1) & (called == -1)).sum()
    assert metrics.clutter_precision == pytest.approx(both / (called == -1).sum())
    assert metrics.clutter_recall == pytest.approx(both / (true == -1).sum())
    spotless = replace(made.truth, flower_ids=np.zeros(len(true), int))
    found = evaluate(replace(made.result, flower_ids=np.full(len(true), 4)), made.session, spotless)
    assert (found.clutter_precision, found.clutter_recall) == (1.0, 1.0)


def test_landmarks_are_matched_by_identity_and_not_by_distance(made: Made) -> None:
    swapped = made.result.flowers.positions.copy()
    swapped[[0, 1]] = swapped[[1, 0]]
    flowers = replace(made.result.flowers, positions=swapped)
    rest = made.truth.rest_positions
    assert rest is not None
    gap = np.linalg.norm(rest[0] - rest[1])
    expected = np.sqrt(2 * gap**2 / len(rest))
    assert score(made, flowers=flowers).flower_rmse_m == pytest.approx(expected, rel=0.1)


def test_often_seen_flowers_have_a_figure_of_their_own(made: Made) -> None:
    counts = np.where(np.arange(len(made.result.flowers)) == 0, 59, 60)
    positions = made.result.flowers.positions.copy()
    positions[0] += 1.0
    flowers = replace(made.result.flowers, positions=positions, n_observations=counts)
    metrics = score(made, flowers=flowers)
    assert metrics.flower_rmse_m > 0.1
    assert metrics.flower_rmse_60_m < 0.002


def test_a_duplicated_cluster_is_a_ghost(made: Made) -> None:
    true = made.truth.flower_ids
    assert true is not None
    matching = identity_scores(true, made.result.flower_ids)
    assert len(ghost_clusters(made.result.clusters, made.result.flowers, matching)) == 0
    renamed = made.result.flowers.ids + np.where(made.result.flowers.cluster_ids == 15, 10_000, 0)
    ghosts = ghost_clusters(made.result.clusters, replace(made.result.flowers, ids=renamed), matching)
    assert ghosts.tolist() == [15]
    tentative = replace(made.result.clusters, states=("tentative",) * 6)
    assert len(ghost_clusters(tentative, replace(made.result.flowers, ids=renamed), matching)) == 0


def test_clusters_with_an_unmatched_member_have_no_truth(made: Made) -> None:
    rest = np.array(made.truth.rest_positions)
    assert len(cluster_errors(made.result.clusters, made.result.flowers, rest)) == 6
    rest[0] = np.nan
    errors = cluster_errors(made.result.clusters, made.result.flowers, rest)
    assert errors.index.tolist() == [1, 2, 3, 4, 5]
    assert len(flower_errors(made.result.flowers, rest)) == len(rest) - 1


def test_normalised_squared_by_hand() -> None:
    errors = np.array([[2.0, 0, 0], [0, 3.0, 0], [1.0, 1, 1]])
    covs = np.array([np.diag([4.0, 1, 1]), np.diag([1, 0.5, 1.0]), np.diag([1.0, -1, 1])])
    np.testing.assert_allclose(normalised_squared(errors, covs), [1.0, 18.0, np.inf])


def test_few_points_are_left_where_they_are() -> None:
    a = np.eye(3)
    T = se3_exp(np.array([0.3, 0, 0, 1.0, 0, 0]))
    np.testing.assert_allclose(align_points(transform(T, a), a), a, atol=1e-12)
    np.testing.assert_array_equal(align_points(a[:2], a[:2] + 1), a[:2])


@pytest.mark.parametrize(
    ("missing", "gone"),
    [
        ({"T_world_camera"}, {"ate_rmse_m", "hand_eye_m", "ate_rmse_given_m"}),
        ({"flower_ids", "cluster_ids"}, {"flower_idf1", "cluster_idf1", "clutter_recall", "flower_rmse_m"}),
        ({"cluster_ids"}, {"cluster_idf1", "cluster_hota"}),
        ({"rest_flower_ids", "rest_cluster_ids", "rest_positions"}, {"flower_rmse_m", "nees_clusters"}),
    ],
)
def test_what_lacks_truth_is_left_out(made: Made, missing: set[str], gone: set[str]) -> None:
    truth = replace(made.truth, **dict.fromkeys(missing))
    values = evaluate(made.result, made.session, truth).as_json()
    assert not gone & set(values)
    assert evaluate(made.result, made.session, Truth()).as_json() == {}


def test_frames_without_a_true_pose_are_left_out(made: Made) -> None:
    holes = np.array(made.truth.T_world_camera)
    holes[::3] = np.nan
    metrics = evaluate(made.result, made.session, replace(made.truth, T_world_camera=holes))
    assert metrics.ate_rmse_m == pytest.approx(score(made).ate_rmse_m, rel=0.2)


def test_one_frame_and_no_flowers() -> None:
    empty = made_empty()
    values = evaluate(empty.result, empty.session, empty.truth).as_json()
    assert values["flower_idf1"] == 1.0
    assert values["ate_rmse_m"] == pytest.approx(0.0, abs=1e-12)
    assert "rpe_translation_m" not in values
    assert "flower_rmse_m" not in values


def made_empty() -> Made:
    """One frame that saw nothing."""
    full = make(1, n_frames=20)
    no_ids, no_points, no_covs, no_stamps = np.zeros(0, int), np.zeros((0, 3)), np.zeros((0, 3, 3)), np.zeros(0)
    session = replace(
        full.session,
        stamps=full.session.stamps[:1],
        poses=full.session.poses[:1],
        observations=Observations(no_ids, no_points, no_covs, no_stamps),
    )
    truth = Truth(full.result.T_world_camera[:1], no_ids, no_ids, no_ids, no_ids, no_points)
    result = replace(
        full.result,
        session=session,
        T_world_camera=full.result.T_world_camera[:1],
        flower_ids=no_ids,
        cluster_ids=no_ids,
        flowers=Flowers(no_ids, no_ids, no_points, no_covs, no_stamps, no_stamps, no_ids),
        clusters=Clusters(
            no_ids,
            no_points,
            no_covs,
            no_ids,
            np.zeros((0, 2)),
            np.zeros((0, 2, 2)),
            no_stamps,
            no_stamps,
            no_ids,
            (),
        ),
        drift=Drift(no_ids, no_ids, no_points, no_covs),
        calibration=None,
        diagnostics=replace(full.result.diagnostics, nis=no_stamps, reasons=no_ids),
    )
    return Made(session, truth, result)


def test_a_hundred_thousand_rows_take_less_than_two_seconds() -> None:
    big = make(2, n_frames=1800, n_clusters=17)
    assert len(big.session.observations) > 100_000
    start = time.perf_counter()
    metrics = evaluate(big.result, big.session, big.truth)
    assert time.perf_counter() - start < 2.0
    assert metrics.flower_idf1 == pytest.approx(0.993, abs=0.003)
