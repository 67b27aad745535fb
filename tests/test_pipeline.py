"""Smoothing a session: what must not matter does not, what is said about the result holds, and how good it is."""

from __future__ import annotations

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from oracle import smooth_with_truth

from cluster_slam import evaluate, smooth
from cluster_slam.config import GroupingConfig, SmoothConfig
from cluster_slam.errors import ConfigError
from cluster_slam.evaluation import Metrics
from cluster_slam.geometry import inverse, se3_exp, se3_log, transform
from cluster_slam.records import CLUTTER, Observations, RejectReason, Result, Session
from cluster_slam.simulate import PRESETS, Simulated, simulate_session
from tracking.gating import chi2_threshold

SEED = 21


@cache
def made(**changes: Any) -> Simulated:
    """Ten seconds of a small plant, with some options changed."""
    return simulate_session(replace(PRESETS["sample"], **changes), seed=SEED)


@cache
def smoothed(**changes: Any) -> Result:
    return smooth(made(**changes).session)


def measured(**changes: Any) -> Metrics:
    world = made(**changes)
    return evaluate(smoothed(**changes), world.session, world.truth)


# --- what must not matter


def test_the_world_may_be_anywhere() -> None:
    """Poses in another frame: the same labels, and a map that has moved with them."""
    T = se3_exp(np.array([0.3, -1.1, 0.7, 2.0, -1.0, 0.5]))
    session, before = made().session, smoothed()
    after = smooth(replace(session, poses=T @ session.poses))
    np.testing.assert_array_equal(after.flower_ids, before.flower_ids)
    np.testing.assert_array_equal(after.cluster_ids, before.cluster_ids)
    np.testing.assert_allclose(after.flowers.positions, transform(T, before.flowers.positions), rtol=0, atol=1e-6)
    R = T[:3, :3]
    np.testing.assert_allclose(after.flowers.covs, R @ before.flowers.covs @ R.T, rtol=1e-3, atol=1e-11)


def test_time_may_begin_anywhere() -> None:
    session = made().session
    after = smooth(replace(session, stamps=session.stamps - session.stamps[0]))
    np.testing.assert_array_equal(after.flower_ids, smoothed().flower_ids)


def test_the_order_within_a_file_does_not_matter() -> None:
    """Rows shuffled: the same partition of the detections, and the same places but for rounding."""
    session, before = made().session, smoothed()
    rows = np.random.default_rng(0).permutation(len(session.observations))
    o = session.observations
    shuffled = Observations(o.frame[rows], o.points[rows], o.covs[rows], o.scores[rows])
    after = smooth(replace(session, observations=shuffled))
    pairs = np.unique(np.column_stack([after.flower_ids, before.flower_ids[rows]]), axis=0)
    assert len(pairs) == len(before.flowers) + 1
    a, b = (r.flowers.positions[np.lexsort(r.flowers.positions.round(5).T)] for r in (after, before))
    np.testing.assert_allclose(a, b, rtol=0, atol=1e-6)


def test_pixels_give_what_points_give() -> None:
    """Level 2 is lifted with the same camera and noise that made the points of level 3."""
    np.testing.assert_array_equal(smoothed(level=2).flower_ids, smoothed().flower_ids)


# --- what is said about the result


def test_every_row_has_its_flower_and_its_cluster() -> None:
    result = smoothed()
    ids, clusters = result.flowers, result.clusters
    assert (np.diff(ids.ids) > 0).all()
    assert (np.diff(clusters.ids) > 0).all()
    known = result.flower_ids != CLUTTER
    np.testing.assert_array_equal(known, result.cluster_ids != CLUTTER)
    at = np.searchsorted(ids.ids, result.flower_ids[known])
    np.testing.assert_array_equal(ids.ids[at], result.flower_ids[known])
    np.testing.assert_array_equal(ids.cluster_ids[at], result.cluster_ids[known])
    np.testing.assert_array_equal(np.bincount(at, minlength=len(ids)), ids.n_observations)
    accepted = result.diagnostics.reasons == RejectReason.ACCEPTED
    assert (known | ~accepted).all()
    np.testing.assert_array_equal(np.isfinite(result.diagnostics.nis), known)


def test_clusters_follow_from_their_members() -> None:
    result = smoothed()
    for j, cluster in enumerate(result.clusters.ids):
        members = result.flowers.cluster_ids == cluster
        places = result.flowers.positions[members]
        away = np.linalg.norm(places - places.mean(0), axis=1)
        assert result.clusters.n_flowers[j] == members.sum()
        np.testing.assert_allclose(result.clusters.positions[j], places.mean(0), rtol=0, atol=1e-12)
        expected = [(away**2).sum(), away.mean()] if members.sum() > 1 else [0.0, 0.0]
        np.testing.assert_allclose(result.clusters.descriptors[j], expected, rtol=1e-9, atol=1e-12)
        if members.sum() == 1:
            np.testing.assert_allclose(result.clusters.covs[j], result.flowers.covs[members][0], rtol=1e-9)


def test_a_centroid_is_no_surer_than_its_flowers_share_of_errors_allows() -> None:
    """Errors of the mount are common to all flowers, so that a mean of n is not n times surer in variance."""
    result = smoothed()
    for j, cluster in enumerate(result.clusters.ids):
        members = result.flowers.covs[result.flowers.cluster_ids == cluster]
        independent = np.trace(members.sum(0)) / len(members) ** 2
        assert (
            independent * (1 - 1e-9) <= np.trace(result.clusters.covs[j]) <= np.trace(members, axis1=1, axis2=2).max()
        )


def test_drift_is_at_rest_where_nothing_moves() -> None:
    """Touches switched off: clusters stay within what the pose error of a single frame explains."""
    result = smoothed(sway_m=0.0, ambient_sway_m=0.0)
    row = np.searchsorted(result.clusters.ids, result.drift.cluster_ids)
    away = np.linalg.norm(result.drift.positions - result.clusters.positions[row], axis=1)
    assert np.quantile(away, 0.95) < 0.001


def test_drift_follows_the_sway() -> None:
    """Centroids in each frame against the truth of the same frame; at rest they would be a centimetre off."""
    world, result = made(), smoothed()
    assert world.truth.flower_ids is not None
    errors, moved = [], []
    for cluster in result.clusters.ids:
        members = result.flowers.ids[result.flowers.cluster_ids == cluster]
        true = [np.bincount(world.truth.flower_ids[result.flower_ids == f] + 1).argmax() - 1 for f in members]
        rows = result.drift.cluster_ids == cluster
        where = world.flower_positions[result.drift.frame[rows]][:, true].mean(1)
        errors.append(np.linalg.norm(result.drift.positions[rows] - where, axis=1))
        moved.append(np.linalg.norm(where - world.plant.flowers[true].mean(0), axis=1))
    error, away = np.concatenate(errors), np.concatenate(moved)
    assert away.max() > 0.012
    assert np.sqrt((error[away > 0.005] ** 2).mean()) < 0.35 * np.sqrt((away[away > 0.005] ** 2).mean())


def test_misfits_are_chi_square() -> None:
    """Of each detection against what all the others say of it: the fit takes nothing away."""
    nis = smoothed().diagnostics.nis
    nis = nis[np.isfinite(nis)]
    assert nis.mean() / 3 == pytest.approx(1.0, abs=0.06)
    assert (nis <= chi2_threshold(3, 0.95)).mean() == pytest.approx(0.95, abs=0.012)


# --- the hand-eye transform


def test_a_mount_that_nobody_measured_well_is_found() -> None:
    """Off by 8 degrees and 5 cm, and said to be: as good as from half a degree and 4 mm."""
    world = made()
    off = se3_exp(np.array([0.1, -0.06, 0.07, 0.03, 0.04, 0.0]))
    noise = replace(world.session.noise, hand_eye_translation=0.05, hand_eye_rotation=0.15)
    session = replace(world.session, T_flange_camera=world.hand_eye.true @ off, noise=noise)
    result = smooth(session)
    metrics = evaluate(result, session, world.truth)
    assert metrics.flower_idf1 is not None
    assert metrics.flower_idf1 > 0.99
    assert result.calibration is not None
    usual = smoothed().calibration
    assert usual is not None
    found, best = (se3_log(inverse(world.hand_eye.true) @ c.T_flange_camera) for c in (result.calibration, usual))
    assert np.linalg.norm(found[3:]) < min(0.002, 1.2 * np.linalg.norm(best[3:]))
    assert np.linalg.norm(found[:3]) < 1.2 * np.linalg.norm(best[:3])
    assert found @ np.linalg.solve(result.calibration.cov, found) < chi2_threshold(6, 0.999)


def test_camera_poses_have_no_mount() -> None:
    result = smoothed(pose_frame="T_world_camera")
    assert result.calibration is None
    assert (measured(pose_frame="T_world_camera").cluster_idf1 or 0) > 0.99


# --- how good it is


WORLDS: dict[str, dict[str, Any]] = {
    "as it is": {},
    "no covariances": {"with_covariances": False},
    "no touches": {"sway_m": 0.0},
    "clutter": {"clutter_per_frame": 1.5},
}


@pytest.mark.parametrize("name", WORLDS)
def test_small_worlds(name: str) -> None:
    metrics, result = measured(**WORLDS[name]), smoothed(**WORLDS[name])
    assert result.status == "ok"
    assert (metrics.cluster_idf1 or 0) > 0.98
    assert (metrics.flower_idf1 or 0) > 0.98
    assert (metrics.clutter_recall or 0) > 0.95
    assert metrics.n_ghost_clusters == 0
    assert (metrics.flower_rmse_m or 1) < 0.003
    assert (metrics.ate_rmse_m or 1) < (metrics.ate_rmse_given_m or 0)


def test_as_good_as_with_the_true_association() -> None:
    """The small share of the figure that `make nightly` pools over ten moderate seeds."""
    world, ours = made(), measured()
    told = evaluate(smooth_with_truth(world.session, world.truth), world.session, world.truth)
    for name in ("ate_rmse_m", "flower_rmse_m", "hand_eye_m"):
        assert getattr(ours, name) < 1.1 * getattr(told, name), name


def test_one_moderate_session() -> None:
    """Twelve clusters, 900 frames: the floors lie a little below what ten seeds reach."""
    world = simulate_session(PRESETS["moderate"], seed=3)
    metrics = evaluate(smooth(world.session), world.session, world.truth)
    assert (metrics.cluster_idf1 or 0) >= 0.998
    assert (metrics.flower_idf1 or 0) >= 0.997
    assert (metrics.clutter_recall or 0) >= 0.98
    assert metrics.n_ghost_clusters == 0
    assert (metrics.ate_rmse_m or 1) < 0.0015
    assert (metrics.flower_rmse_m or 1) < 0.001
    assert (metrics.hand_eye_m or 1) < 0.001


# --- options


def test_poses_that_drift_farther_than_flowers_stand_apart() -> None:
    """One metre in five is wrong when the camera comes back: laid upon each other by such poses, pieces mix flowers."""
    config = replace(PRESETS["moderate-odometry"], duration_s=12.0, fps=10.0, odometry_translation=0.2)
    made = simulate_session(config, seed=6)
    metrics = evaluate(smooth(made.session), made.session, made.truth)
    assert metrics.cluster_idf1 is not None
    assert metrics.cluster_idf1 > 0.99
    assert metrics.flower_idf1 is not None
    assert metrics.flower_idf1 > 0.98


def test_a_given_number_of_clusters() -> None:
    config = SmoothConfig(grouping=GroupingConfig("kmeans", n_clusters=6))
    result = smooth(made().session, config=config, seed=3)
    assert len(result.clusters) == 6
    metrics = evaluate(result, made().session, made().truth)
    assert (metrics.flower_idf1 or 0) > 0.99


def test_every_flower_for_itself() -> None:
    result = smooth(made().session, config=SmoothConfig(grouping=GroupingConfig("none")))
    assert len(result.clusters) == len(result.flowers)
    assert (result.clusters.n_flowers == 1).all()


def test_kmeans_wants_its_number() -> None:
    with pytest.raises(ConfigError, match="n_clusters"):
        smooth(made().session, config=SmoothConfig(grouping=GroupingConfig("kmeans")))


def test_progress_is_told_in_order() -> None:
    told: list[tuple[str, float]] = []
    smooth(_short(made().session, 40), progress=lambda stage, fraction: told.append((stage, fraction)))
    fractions = [fraction for _, fraction in told]
    assert fractions == sorted(fractions)
    assert 0 <= fractions[0] <= fractions[-1] <= 1
    assert all(stage for stage, _ in told)


def _short(session: Session, n: int) -> Session:
    """The first frames of a session."""
    o = session.observations
    few = o.frame < n
    observations = Observations(o.frame[few], o.points[few], o.covs[few], o.scores[few], o.has_covariance)
    return replace(session, stamps=session.stamps[:n], poses=session.poses[:n], observations=observations)
