"""Maps of many plants: which one is in view."""

from __future__ import annotations

import numpy as np
import pytest
from localisation_trials import Trial, kidnapped, map_of, plant_of
from localisation_windows import window

from cluster_slam.geometry import inverse, se3_exp, se3_log, transform
from cluster_slam.localisation import Localiser
from cluster_slam.localisation.atlas import Atlas, group
from cluster_slam.localisation.landmarks import landmarks
from cluster_slam.localisation.merging import merged_points
from cluster_slam.localisation.scene import ErrorScale, make_look
from cluster_slam.pipeline.localise import localise
from cluster_slam.simulate.plant import Plant

N_PLANTS = 30


@pytest.fixture(scope="module")
def field() -> list[Plant]:
    return [plant_of(seed + 700) for seed in range(N_PLANTS)]


@pytest.fixture(scope="module")
def localiser(field: list[Plant]) -> Localiser:
    return Localiser([map_of(p, f"row{i}") for i, p in enumerate(field)], point_sigma_m=0.002)


def test_groups_hang_together() -> None:
    """Three flowers on a line 3 cm apart are one group of size sqrt(2 / 3) 3 cm; a lone one is none."""
    places = np.array([[0.0, 0, 0], [0.03, 0, 0], [0.06, 0, 0], [0.5, 0, 0], [0.0, 0, 0], [0.03, 0, 0]])
    found = group(places, np.array([0, 0, 0, 0, 1, 1]), 0.04)
    np.testing.assert_array_equal(found.plant, [0, 1])
    np.testing.assert_allclose(found.centroids, [[0.03, 0, 0], [0.015, 0, 0]], atol=1e-12)
    np.testing.assert_allclose(found.sizes, [0.03 * np.sqrt(2.0 / 3.0), 0.015])


def test_a_clean_look_finds_its_plant_and_pose(field: list[Plant]) -> None:
    atlas = Atlas([map_of(p) for p in field], 0.002)
    rng = np.random.default_rng(0)
    for plant in (0, 11, 29):
        T = se3_exp(rng.normal(size=6))
        near = np.argsort(np.linalg.norm(field[plant].flowers - field[plant].centroids[0], axis=1))[:40]
        best = atlas.guesses(transform(inverse(T), field[plant].flowers[near]))[0]
        assert best.plant == plant
        np.testing.assert_allclose(best.T_map_camera, T, atol=1e-6)


def test_frames_of_six_clusters_are_located_in_their_plant(field: list[Plant], localiser: Localiser) -> None:
    n_right = 0
    for k in range(12):
        plant = 2 * k
        frame = kidnapped(field[plant], Trial(7), rng=np.random.default_rng([k, 8]))
        found = localiser.locate_points(frame.points, frame.covs)
        if not found.is_located:
            continue
        assert found.plant == f"row{plant}"
        assert np.linalg.norm(se3_log(inverse(found.T_map_camera) @ frame.T_map_camera)[3:]) < 0.05
        n_right += 1
    assert n_right >= 10


def test_frames_of_a_plant_that_the_map_lacks_are_lost(localiser: Localiser) -> None:
    other = plant_of(801)
    for k in range(2):
        frame = kidnapped(other, Trial(6), rng=np.random.default_rng([k, 9]))
        assert not localiser.locate_points(frame.points, frame.covs).is_located


def test_a_short_session_is_found_in_a_field(field: list[Plant]) -> None:
    made = window(field[17], Trial(6), rng=np.random.default_rng(3))
    found = localise(made.session, [map_of(p, f"row{i}") for i, p in enumerate(field)])
    assert found.is_located[-1]
    assert found.plants[-1] == "row17"
    xi = se3_log(inverse(found.T_map_camera[-1]) @ made.T_map_camera[-1])
    assert np.linalg.norm(xi[3:]) < 0.01


def test_what_is_seen_again_is_kept_once() -> None:
    scale = ErrorScale()
    rng = np.random.default_rng(4)
    places = rng.uniform(-0.2, 0.2, (8, 3)) + np.array([0, 0, 0.5])
    T = se3_exp(0.05 * rng.normal(size=(5, 6)))
    looks = []
    for k in range(5):
        false = rng.uniform(-0.2, 0.2, (1, 3)) + np.array([0, 0, 1.0])
        points = np.vstack([transform(inverse(T[k]), places) + rng.normal(0.0, 0.001, (8, 3)), false])
        looks.append(make_look(points, np.tile(1e-6 * np.eye(3), (9, 1, 1)), scale))
    merged = merged_points(looks, T, 0.001)
    assert len(merged) == 8
    np.testing.assert_allclose(merged, places, atol=0.003)


def test_a_map_of_single_flowers_has_an_index_too() -> None:
    marks = [landmarks(np.random.default_rng(k).uniform(0, 5, (3, 3)), np.arange(3)) for k in range(9)]
    localiser = Localiser(marks)
    found = localiser.locate_points(np.eye(3) + np.array([0, 0, 1]), np.tile(1e-6 * np.eye(3), (3, 1, 1)))
    assert not found.is_located
