"""Maps that are days old: clusters have drifted by about as much as their flowers lie apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from map_help import SMALL as SMALL_SEASON
from map_help import map_of

from cluster_slam.constellation import growth
from cluster_slam.evaluation.localised import pose_nees
from cluster_slam.geometry import adjoint, inverse, se3_exp, skew
from cluster_slam.localisation.landmarks import landmarks, landmarks_at
from cluster_slam.localisation.motion import motion_of
from cluster_slam.localisation.scene import ErrorScale, make_look
from cluster_slam.localisation.shifts import shift_of
from cluster_slam.localisation.tracking import start
from cluster_slam.pipeline.localise import localise
from cluster_slam.records import CLUTTER
from cluster_slam.simulate import simulate_session
from cluster_slam.simulate.config import MODERATE
from cluster_slam.simulate.season import SeasonPlant

DRIFT_M, OWN_M = 0.009, 0.0015  # one sigma an axis: five days at 3 mm a day
SMALL = 1e-6 * np.eye(3)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_poses_in_an_old_map_are_as_sure_as_is_said(seed: int) -> None:
    """All frames share one error, that of the map: more frames do not make it smaller."""
    made = simulate_session(replace(MODERATE, duration_s=4.0, fps=10.0), seed=seed)
    rng = np.random.default_rng(seed)
    of = made.plant.flower_cluster
    drift, own = DRIFT_M * rng.normal(size=(of.max() + 1, 3)), OWN_M * rng.normal(size=(len(of), 3))
    marks = landmarks(
        made.plant.flowers - drift[of] - own,
        of,
        covs=np.tile(OWN_M**2 * np.eye(3), (len(of), 1, 1)),
        shared_covs=np.tile(DRIFT_M**2 * np.eye(3), (len(np.unique(of)), 1, 1)),
    )
    found = localise(made.session, [marks])
    here = found.is_located
    assert here.mean() > 0.8
    truth = made.truth
    nees = pose_nees(found.T_map_camera[here], found.covs[here], truth.T_world_camera[here]) / 6.0
    assert nees.mean() < 3.0  # one draw of six: 3 is exceeded by 0.6 % of them
    matched = found.flower_ids != CLUTTER
    assert (found.flower_ids == truth.flower_ids)[matched].mean() > 0.98


def test_frames_do_not_tell_how_the_map_as_a_whole_is_off() -> None:
    """However many frames, an old map stays as uncertain as the layout of its clusters leaves it.

    A filter of displacements from the map falls to 0.89 of that in these sixty frames, and further in more, as each
    is linearised about another orientation.
    """
    made = simulate_session(replace(MODERATE, duration_s=6.0, fps=10.0), seed=4)
    session, of, drift_m = made.session, made.plant.flower_cluster, 0.024
    drift = drift_m * np.random.default_rng(4).normal(size=(of.max() + 1, 3))
    n = len(np.unique(of))
    marks = landmarks(
        made.plant.flowers - drift[of],
        of,
        covs=np.tile(0.003**2 * np.eye(3), (len(of), 1, 1)),
        shared_covs=np.tile(drift_m**2 * np.eye(3), (n, 1, 1)),
    )
    scale = ErrorScale()
    track = start(marks, motion_of(session), 0, made.truth.T_world_camera[0], scale, 0.3)
    for k in range(session.n_frames):
        rows = np.flatnonzero((session.observations.frame == k) & (made.truth.flower_ids >= 0))
        if k:
            track.predict(k)
        if len(rows):
            look = make_look(session.observations.points[rows], session.observations.covs[rows], scale)
            track.update(look, np.arange(len(rows)), made.truth.flower_ids[rows], 1 if k else 4)
    seen = track.state.cluster_at >= 0
    J = np.concatenate([-skew(marks.centres[seen]), np.broadcast_to(np.eye(3), (seen.sum(), 3, 3))], axis=-1)
    layout = np.einsum("cia,cib->ab", J, J) / drift_m**2
    turns = np.zeros((6, 6))  # what the flowers of a cluster, of known shape, add on the orientation
    for f in np.flatnonzero(seen[marks.cluster]):
        arm = skew(marks.positions[f] - marks.centres[marks.cluster[f]])
        turns[:3, :3] += arm.T @ arm / 0.003**2
    W = track.state.W
    stated = adjoint(W) @ track.state.P[6:12, 6:12] @ adjoint(W).T  # as a motion of the map
    ratio = np.sqrt(np.linalg.eigvals((layout + turns) @ stated).real)  # over the bound: information by covariance
    assert ratio.min() > 0.95
    assert ratio.max() < 1.2


def test_a_cluster_that_moved_by_the_distance_of_its_flowers_is_found() -> None:
    """Four flowers 14 mm apart in a row, the displacement 14 mm along it: only all four together tell."""
    places = np.array([[0.0, 0, 0], [14, 0, 0], [28, 0, 0], [28, 20, 0]]) * 1e-3
    moved = places + np.array([0.014, 0.0, 0.0])
    found = shift_of(moved, SMALL, places, SMALL, 64e-6 * np.eye(3), 1e4)
    assert found.is_sure
    np.testing.assert_allclose(found.mean, [0.014 * 64 / 64.5, 0, 0], atol=1e-6)
    np.testing.assert_allclose(found.cov, 64e-6 * 0.5 / 64.5 * np.eye(3), atol=1e-12)


def test_a_cluster_is_left_alone_where_two_displacements_are_alike() -> None:
    places = np.array([[0.0, 0, 0], [14, 0, 0]]) * 1e-3
    points = np.array([[-7.0, 0, 0], [7, 0, 0], [21, 0, 0]]) * 1e-3
    assert not shift_of(points, SMALL, places, SMALL, 64e-6 * np.eye(3), 1e4).is_sure


def test_no_point_near_says_nothing() -> None:
    found = shift_of(np.ones((2, 3)), SMALL, np.zeros((2, 3)), SMALL, SMALL, 1e4)
    np.testing.assert_array_equal(found.mean, 0.0)
    np.testing.assert_array_equal(found.cov, SMALL)


def test_what_all_clusters_drift_in_common_is_in_the_pose(tmp_path: Path) -> None:
    """A map that knows its clusters well by now has still been aligned with where it expected them, each time."""
    with map_of(tmp_path, SeasonPlant(SMALL_SEASON, seed=3)) as store:
        plant = store.plants()[0]
    later = float(np.nanmin(plant.cluster_first_seen)) + 5.0 * growth.DAY_S
    assert not landmarks_at(plant, later).frame_cov.any()  # one session: what may have drifted is in its clusters
    n = len(plant.cluster_ids)
    known = replace(
        plant,
        cluster_time=np.full(n, later),
        cluster_covs=np.tile(1e-10 * np.eye(3), (n, 1, 1)),
        velocity_covs=np.zeros((n, 3, 3)),
    )
    marks = landmarks_at(known, later)
    rng, sigma = np.random.default_rng(0), np.sqrt(growth.drifted(plant, 5.0 * growth.DAY_S, 60.0))
    J = np.concatenate([-skew(marks.centres), np.broadcast_to(np.eye(3), (n, 3, 3))], axis=-1).reshape(-1, 6)
    common = np.linalg.lstsq(J, sigma * rng.normal(size=(3 * n, 4000)), rcond=None)[0]
    scale = np.sqrt(np.diag(np.cov(common)))
    np.testing.assert_allclose(marks.frame_cov / np.outer(scale, scale), np.corrcoef(common), atol=0.08)
    T = se3_exp(np.array([0.3, -0.2, 0.1, 0.5, 0.2, -0.4]))
    by_pose = adjoint(inverse(T)) @ common  # as errors of a pose, tangent on the right
    np.testing.assert_allclose(np.diag(marks.in_first_frame(np.zeros((6, 6)), T)), by_pose.var(axis=1), rtol=0.08)
