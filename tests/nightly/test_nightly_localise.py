"""Kidnapped frames by the thousand, tracks over many seeds, and recordings in a map."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from localisation_trials import Trial, kidnapped, map_of, plant_of
from tables import Tables

from cluster_slam import open_session
from cluster_slam.geometry import Array, inverse, se3_log
from cluster_slam.io.session import open_truth
from cluster_slam.localisation import Localiser
from cluster_slam.localisation.landmarks import landmarks
from cluster_slam.localisation.scene import ErrorScale
from cluster_slam.pipeline.localise import localise
from cluster_slam.records import CLUTTER
from cluster_slam.simulate import simulate_session
from cluster_slam.simulate.config import MODERATE

pytestmark = pytest.mark.nightly
N_FRAMES = 3000
N_SEEDS = 30
DATA = Path(os.environ.get("CLUSTER_SLAM_DATA", "/nowhere"))


def frames(n: int, clusters: tuple[int, ...], *, other_map: bool = False) -> Array:
    """Located, share of right identities, NEES (where located), within 1 cm and 1 degree, clusters in view."""
    rows = []
    for seed in range(n):
        if seed % 20 == 0:
            plant = plant_of(seed)
            localiser = Localiser(map_of(plant_of(seed + 10**6) if other_map else plant), point_sigma_m=0.002)
        trial = Trial(clusters[seed % len(clusters)])
        frame = kidnapped(plant, trial, rng=np.random.default_rng([seed, 99]))
        scale = ErrorScale(sway_m=trial.sway_m / np.sqrt(3.0))
        found = localiser.locate_points(frame.points, frame.covs, scale=scale)
        known = found.flower_ids != CLUTTER
        right = float(np.mean(found.flower_ids[known] == frame.flowers[known])) if known.any() else 0.0
        xi = se3_log(inverse(found.T_map_camera) @ frame.T_map_camera) if found.hypotheses else np.full(6, np.inf)
        nees = float(xi @ found.hypotheses[0].fit.information @ xi) if found.is_located else np.nan
        near = np.linalg.norm(xi[3:]) < 0.01 and np.linalg.norm(xi[:3]) < np.pi / 180.0
        rows.append((found.is_located, right, nees, near, trial.n_clusters))
    return np.array(rows, dtype=float)


def test_kidnapped_frames(add_row: Tables) -> None:
    found = frames(N_FRAMES, (3, 4, 5, 6, 8))
    located, right = found[:, 0] > 0, found[:, 1] > 0.6
    for k in np.unique(found[:, 4]):
        here = found[:, 4] == k
        add_row(
            "kidnapped",
            clusters=int(k),
            frames=int(here.sum()),
            identities_right=right[here].mean(),
            located=located[here].mean(),
            within_1cm_1deg=found[here, 3].mean(),
            nees_over_6=np.nanmean(found[here, 2]) / 6.0,
        )
    assert right.mean() >= 0.99
    assert not (located & ~right).any()
    assert 0.8 < np.nanmean(found[:, 2]) / 6.0 < 1.25


def test_two_clusters_are_located_only_when_true(add_row: Tables) -> None:
    found = frames(1000, (2,))
    located = found[:, 0] > 0
    add_row("two_clusters", frames=1000, located=located.mean(), wrong=int((located & (found[:, 1] < 0.6)).sum()))
    assert not (located & (found[:, 1] < 0.6)).any()


def test_other_maps_and_single_clusters_are_lost(add_row: Tables) -> None:
    other, single = frames(1000, (2, 3, 5, 8), other_map=True), frames(300, (1,))
    add_row("lost", other_map_located=int(other[:, 0].sum()), single_cluster_located=int(single[:, 0].sum()))
    assert not other[:, 0].any()
    assert not single[:, 0].any()


def test_tracks_are_true(add_row: Tables) -> None:
    nees, shift = [], []
    for seed in range(N_SEEDS):
        made = simulate_session(MODERATE, seed=seed)
        found = localise(made.session, [landmarks(made.plant.flowers, made.plant.flower_cluster)])
        here = found.is_located
        truth = made.truth.T_world_camera
        assert truth is not None
        xi = se3_log(inverse(found.T_map_camera[here]) @ truth[here])
        nees.append(np.einsum("ni,ni->n", xi, np.linalg.solve(found.covs[here], xi[..., None])[..., 0]).mean() / 6.0)
        shift.append(np.sqrt((xi[:, 3:] ** 2).sum(1).mean()))
    add_row("tracks", seeds=N_SEEDS, nees_over_6=np.mean(nees), position_mm=1e3 * np.sqrt(np.mean(np.square(shift))))
    assert 0.8 < np.mean(nees) < 1.25


@pytest.mark.recordings
@pytest.mark.skipif(not DATA.is_dir(), reason="CLUSTER_SLAM_DATA names no folder of recordings")
@pytest.mark.parametrize("name", sorted(p.name for p in DATA.glob("mrclam6-*")) if DATA.is_dir() else [])
def test_vehicles_among_tubes(name: str, add_row: Tables) -> None:
    session = open_session(DATA / name)
    truth = open_truth(DATA / name, session)
    assert truth is not None
    assert truth.T_world_camera is not None
    assert truth.rest_positions is not None
    assert truth.rest_cluster_ids is not None
    found = localise(session, [landmarks(truth.rest_positions, truth.rest_cluster_ids, plant="mrclam6")])

    def share(T: Array) -> float:
        xi = se3_log(inverse(T) @ truth.T_world_camera)
        turned, away = (
            np.linalg.norm(xi[:, :3], axis=1),
            np.linalg.norm(T[:, :3, 3] - truth.T_world_camera[:, :3, 3], axis=1),
        )
        return float(np.mean((away < 0.15) & (turned < np.radians(3.0))))

    lost = np.full((4, 4), np.nan)
    T = np.where(found.is_located[:, None, None], found.T_map_camera, lost)
    add_row(
        "vehicles",
        session=name,
        odometry=share(session.T_world_camera),
        ours=share(T),
        located=found.is_located.mean(),
    )
    assert share(T) > share(session.T_world_camera)
