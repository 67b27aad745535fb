"""The map over many seasons, other plants, and moments at which the program is killed; and the real recordings."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from season_runs import Season, run_season
from tables import Tables
from test_constellation import lattice, plant_of, session_of
from test_map import kill_during_add

from cluster_slam.config import GrowthConfig, MapConfig
from cluster_slam.constellation.growth import DAY_S
from cluster_slam.remember.decide import Refusal, decide
from cluster_slam.remember.score import Confusion
from cluster_slam.simulate.config import SimulateConfig
from cluster_slam.simulate.season import HARD_SEASON, SEASON, SeasonConfig, SeasonPlant

pytestmark = pytest.mark.nightly
N_SEASONS = int(os.environ.get("CLUSTER_SLAM_SEASONS", "4"))
N_OTHERS = int(os.environ.get("CLUSTER_SLAM_OTHERS", "1000"))
N_CLONES = int(os.environ.get("CLUSTER_SLAM_CLONES", "12"))
N_KILLS = int(os.environ.get("CLUSTER_SLAM_KILLS", "200"))
SIZES = ((12, 0.13), (20, 0.13), (30, 0.09), (40, 0.09))  # clusters, least distance in m


def pooled(folder: Path, config: SeasonConfig, options: MapConfig, first_seed: int) -> Season:
    """Seasons of plants of all sizes, pooled."""
    out = Season()
    for k in range(N_SEASONS):
        n, spacing = SIZES[k % len(SIZES)]
        session = SimulateConfig(n_clusters=n, cluster_spacing_m=spacing)
        found = run_season(folder, replace(config, session=session), options, seed=first_seed + k)
        out.clusters, out.flowers = out.clusters + found.clusters, out.flowers + found.flowers
        out.nees += found.nees
        out.prediction_nees += found.prediction_nees
        out.reliability += found.reliability
        out.n_refused += found.n_refused
        out.problems += found.problems
    return out


def inside(found: Season) -> float:
    """Share of the clusters of each next session within their 95 % ellipsoids."""
    return float((np.array(found.prediction_nees) < 7.815).mean())


def nees_band(n_draws: int) -> tuple[float, float]:
    """99 % of the mean of a chi-square over its 6 degrees of freedom; the sessions of a season share their drift."""
    from scipy.stats import chi2

    return tuple(chi2.ppf([0.005, 0.995], 6 * n_draws) / (6 * n_draws))


def row(add_row: Tables, name: str, found: Season) -> None:
    words = {"cluster_F1": found.clusters.f1, "flower_F1": found.flowers.f1, "clusters": _words(found.clusters)}
    words |= {"flowers": _words(found.flowers), "NEES": float(np.mean(found.nees)) / 6, "prediction_95": inside(found)}
    add_row("seasons", season=name, refused=found.n_refused, **words)


def _words(c: Confusion) -> str:
    return f"{c.right} right, {c.wrong} wrong, {c.missed} missed, {c.joined} joined, {c.new} new"


def test_seasons(tmp_path: Path, add_row: Tables) -> None:
    found = pooled(tmp_path, SEASON, MapConfig(), 300)
    row(add_row, "clean", found)
    assert found.clusters.f1 >= 0.99
    assert found.flowers.f1 >= 0.97
    assert found.clusters.wrong_share <= 0.005
    assert found.problems == []
    assert 0.9 <= inside(found) <= 0.99
    assert np.mean(found.nees) / 6 < nees_band(N_SEASONS)[1]  # smaller is a base that is surer than it says


def test_hard_seasons(tmp_path: Path, add_row: Tables) -> None:
    found = pooled(tmp_path, HARD_SEASON, MapConfig(), 400)
    row(add_row, "60 % visited, 20 % unseen, ghosts", found)
    assert found.clusters.f1 >= 0.975
    assert found.flowers.f1 >= 0.95
    assert found.problems == []
    assert inside(found) >= 0.87
    assert np.mean(found.nees) / 6 < nees_band(N_SEASONS)[1]


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_wrong_growth_priors(tmp_path: Path, add_row: Tables, factor: float) -> None:
    growth = GrowthConfig(drift_m_per_day=0.003 * factor, size_per_day=0.01 * factor)
    found = pooled(tmp_path, SEASON, MapConfig(growth=growth), 500)
    row(add_row, f"prior x {factor}", found)
    assert found.clusters.f1 >= 0.97


def test_probabilities_of_matches_are_met(tmp_path: Path, add_row: Tables) -> None:
    """Reliability: of the matches that are said to be sure to p, p are right."""
    found = pooled(tmp_path, HARD_SEASON, MapConfig(), 400)
    said, right = np.array(found.reliability, dtype=float).T
    for low, high in ((0.0, 0.5), (0.5, 0.9), (0.9, 0.99), (0.99, 1.01)):
        use = (said >= low) & (said < high)
        if use.sum() >= 20:
            add_row("reliability", said=float(said[use].mean()), right=float(right[use].mean()), n=int(use.sum()))
    assert abs(said.mean() - right.mean()) < 0.05


def test_other_plants(add_row: Tables) -> None:
    """None of a thousand other plants is accepted."""
    accepted = 0
    known = None
    for k in range(N_OTHERS):
        n, spacing = SIZES[k % len(SIZES)]
        config = replace(SEASON, session=SimulateConfig(n_clusters=n, cluster_spacing_m=spacing))
        rest = SeasonPlant(config, seed=10_000 + k).rest().constellation
        if known is not None:
            start = known.last_session + (1, 3, 7, 14)[(k // 4) % 4] * DAY_S
            accepted += decide(replace(rest, start=start), [known], MapConfig()).refusal is Refusal.NONE
        known = plant_of(rest)
    add_row("other_plants", tried=N_OTHERS - 1, accepted=accepted)
    assert accepted == 0


def test_clones_and_grids_never_join_in_silence(add_row: Tables) -> None:
    """A plant twice in a map, another grid planted alike, a part of a grid of equal clusters: "ambiguous" is said."""
    said = {"clones": 0, "another_grid": 0, "part_of_a_grid": 0}
    for k in range(N_CLONES):
        plant = SeasonPlant(replace(SEASON, session=SimulateConfig(n_clusters=12)), seed=20_000 + k)
        first = plant_of(plant.rest().constellation)
        plant.grow_to((1.0, 3.0, 7.0, 14.0)[k % 4])
        twins = [replace(first, name=name) for name in ("a", "b")]
        said["clones"] += decide(plant.rest().constellation, twins, MapConfig()).refusal is Refusal.AMBIGUOUS
        points, clusters = lattice(3 * k, same=False)
        known, others = plant_of(session_of(points, clusters)), lattice(3 * k + 1, same=False)[0]
        refusal = decide(session_of(others, clusters, DAY_S), [known], MapConfig()).refusal
        said["another_grid"] += refusal is not Refusal.NONE
        points, clusters = lattice(3 * k + 2, same=True)
        part, known = clusters < 12, plant_of(session_of(points, clusters))
        refusal = decide(session_of(points[part], clusters[part], DAY_S), [known], MapConfig()).refusal
        said["part_of_a_grid"] += refusal is Refusal.AMBIGUOUS
    add_row("clones_and_grids", tried=N_CLONES, **said)
    assert set(said.values()) == {N_CLONES}


def test_a_hundred_sessions_of_one_plant(tmp_path: Path, add_row: Tables) -> None:
    """Every day, three and a half months: all are aligned, the map stays whole and small, and adding stays quick."""
    from time import process_time

    days = " ".join(str(d) for d in range(100))
    config = replace(
        SEASON, days=days, drift_m_per_day=0.001, size_per_day=0.003, session=SimulateConfig(n_clusters=15)
    )
    begin = process_time()
    found = run_season(tmp_path, config, MapConfig(), seed=700)
    seconds = process_time() - begin
    size = max(f.stat().st_size for f in tmp_path.iterdir()) / 1e6
    words = {"cluster_F1": found.clusters.f1, "flower_F1": found.flowers.f1, "refused": found.n_refused}
    add_row("hundred_sessions", **words, cpu_s_a_session=seconds / 100, MB=size)
    assert found.n_refused == 0
    assert found.problems == []
    assert found.clusters.f1 >= 0.99


def test_kill_during_add_often(tmp_path: Path) -> None:
    kill_during_add(tmp_path, N_KILLS, 2)
