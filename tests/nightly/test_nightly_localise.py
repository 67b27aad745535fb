"""Kidnapped frames by the thousand, tracks over many seeds, and recordings in a map."""

from __future__ import annotations

import os
from pathlib import Path
from time import process_time

import numpy as np
import pytest
from localisation_studies import BOUND, CLUSTERS, LOCATED, NEAR, NEES, RIGHT, frames, windows
from localisation_trials import Trial, map_of, plant_of
from localisation_windows import Window, window
from particle_reference import particle_filter
from tables import Tables
from vehicle_reference import told_filter

from cluster_slam import open_session
from cluster_slam.evaluation.localised import is_near
from cluster_slam.geometry import Array, inverse, se3_log
from cluster_slam.io.session import open_truth
from cluster_slam.localisation import Localisation, Localiser
from cluster_slam.localisation.following import Follower
from cluster_slam.localisation.landmarks import landmarks
from cluster_slam.localisation.merging import merged_points
from cluster_slam.localisation.motion import motion_of
from cluster_slam.localisation.scene import make_look
from cluster_slam.pipeline.localise import localise
from cluster_slam.simulate import simulate_session
from cluster_slam.simulate.config import MODERATE

pytestmark = pytest.mark.nightly
N_FRAMES, N_PAIRS, N_SINGLE, N_WINDOWS = 3000, 1000, 300, 300
N_PLANTS, N_FIELD = 5000, 200
N_SEEDS = 30
DATA = Path(os.environ.get("CLUSTER_SLAM_DATA", "/nowhere"))


def rows_of(name: str, found: Array, add_row: Tables) -> None:
    """One row of the table for each number of clusters in view."""
    for k in np.unique(found[:, CLUSTERS]):
        here = found[:, CLUSTERS] == k
        sure = here & (found[:, LOCATED] > 0)
        bound = {"bound": found[here, BOUND].mean()} if found.shape[1] > BOUND else {}
        add_row(
            name,
            clusters=int(k),
            trials=int(here.sum()),
            identities_right=(found[here, RIGHT] > 0.6).mean(),
            located=found[here, LOCATED].mean(),
            wrong=int((found[sure, RIGHT] <= 0.6).sum()),
            within_1cm_1deg=found[here, NEAR].mean(),
            nees_over_6=np.nanmean(found[here, NEES]) / 6.0,
            **bound,
        )


def n_wrong(found: Array) -> int:
    """Located with wrong identities."""
    return int(((found[:, LOCATED] > 0) & (found[:, RIGHT] <= 0.6)).sum())


def test_kidnapped_frames(add_row: Tables) -> None:
    found = frames(N_FRAMES, (3, 4, 5, 6, 8))
    rows_of("kidnapped", found, add_row)
    assert (found[:, RIGHT] > 0.6).mean() >= 0.99
    assert n_wrong(found) == 0
    assert 0.8 < np.nanmean(found[:, NEES]) / 6.0 < 1.25
    near, bound = found[:, NEAR].mean(), found[:, BOUND].mean()
    assert near > bound - 0.02  # nothing is lost against an estimator that is told who is who


def test_two_clusters_are_located_only_when_true(add_row: Tables) -> None:
    found = frames(N_PAIRS, (2,))
    rows_of("two_clusters", found, add_row)
    assert n_wrong(found) == 0


def test_other_maps_and_single_clusters_are_lost(add_row: Tables) -> None:
    other, single = frames(N_PAIRS, (2, 3, 5, 8), other_map=True), frames(N_SINGLE, (1,))
    add_row(
        "lost",
        other_map=len(other),
        other_map_located=int(other[:, LOCATED].sum()),
        single_cluster=len(single),
        single_cluster_located=int(single[:, LOCATED].sum()),
    )
    assert not other[:, LOCATED].any()
    assert not single[:, LOCATED].any()


def test_windows_of_ten_frames(add_row: Tables) -> None:
    found = windows(N_WINDOWS, (3, 4, 6))
    rows_of("windows", found, add_row)
    assert n_wrong(found) == 0
    assert found[:, NEAR].mean() >= 0.98


def test_a_field_of_thousands_of_plants(add_row: Tables) -> None:
    """Windows with six clusters or more in view, kidnapped in 100,000 clusters."""
    plants = [plant_of(seed + 20_000) for seed in range(N_PLANTS)]
    localiser = Localiser([map_of(p, str(k)) for k, p in enumerate(plants)], point_sigma_m=0.002)
    rows = []
    for k in range(N_FIELD):
        at = int(np.random.default_rng([k, 3]).integers(N_PLANTS))
        made = window(plants[at], Trial(6), rng=np.random.default_rng([k, 4]), n_least=True)
        begin = process_time()
        T, plant = _in_field(localiser, made)
        seconds = process_time() - begin
        near = T is not None and bool(is_near(T[None], made.T_map_camera[-1:])[0])
        rows.append((plant == str(at), near, seconds, plant not in ("", str(at))))
    right, near_all, seconds_all, wrong = np.array(rows, dtype=float).T
    add_row(
        "field",
        plants=N_PLANTS,
        windows=N_FIELD,
        right=right.mean(),
        within_1cm_1deg=near_all.mean(),
        median_s=np.median(seconds_all),
        wrong=int(wrong.sum()),
    )
    assert right.mean() >= 0.98
    assert not wrong.any()
    assert np.median(seconds_all) <= 5.0


def _in_field(localiser: Localiser, made: Window) -> tuple[Array | None, str]:
    """Pose of the last frame and plant, where that is sure."""
    o, motion, scale = made.session.observations, motion_of(made.session), localiser.errors
    n = made.session.n_frames
    looks = [make_look(o.points[o.frame == k], o.covs[o.frame == k], scale) for k in range(n)]
    steps = np.stack([motion.camera_step(n - 1, k, None) for k in range(n)])
    among = localiser.likely_plants(merged_points(looks, steps, scale.sway_m))

    def search(k: int) -> Localisation:
        return localiser.locate_points(looks[k].points, looks[k].covs / scale.flower_variance, among=among)

    follower = Follower(localiser, motion, scale, search, localiser.config.sway_time_s)
    place = [follower.step(k, looks[k]) for k in range(n)][-1]
    return (place.T_map_camera, place.plant) if place.reason == "" else (None, "")


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
    marks = landmarks(truth.rest_positions, truth.rest_cluster_ids, plant="mrclam6")
    found = localise(session, [marks])

    def share(T: Array) -> float:
        xi = se3_log(inverse(T) @ truth.T_world_camera)
        turned, away = (
            np.linalg.norm(xi[:, :3], axis=1),
            np.linalg.norm(T[:, :3, 3] - truth.T_world_camera[:, :3, 3], axis=1),
        )
        return float(np.mean((away < 0.15) & (turned < np.radians(3.0))))

    told = share(told_filter(session, truth))
    ours = share(found.T_map_camera)
    add_row(
        "vehicles",
        session=name,
        odometry=share(session.T_world_camera),
        particles=share(particle_filter(session, marks)),
        told=told,
        ours=ours,
        ours_over_told=ours / told,
        located=found.is_located.mean(),
    )
    assert ours > share(session.T_world_camera)
