"""Maps that are days old: clusters have drifted by about as much as their flowers lie apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cluster_slam.evaluation.localised import pose_nees
from cluster_slam.localisation.landmarks import landmarks
from cluster_slam.localisation.shifts import shift_of
from cluster_slam.pipeline.localise import localise
from cluster_slam.records import CLUTTER
from cluster_slam.simulate import simulate_session
from cluster_slam.simulate.config import MODERATE

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
