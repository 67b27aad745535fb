"""The map over many seasons, other plants, and moments at which the program is killed; and the real recordings."""

from __future__ import annotations

import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from season_runs import Season, run_season
from tables import Tables
from test_constellation import plant_of
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
    return out


def row(add_row: Tables, name: str, found: Season) -> None:
    inside = float((np.array(found.prediction_nees) < 7.815).mean())
    words = {"cluster_F1": found.clusters.f1, "flower_F1": found.flowers.f1, "clusters": _words(found.clusters)}
    words |= {"flowers": _words(found.flowers), "NEES": float(np.mean(found.nees)) / 6, "prediction_95": inside}
    add_row("seasons", season=name, refused=found.n_refused, **words)


def _words(c: Confusion) -> str:
    return f"{c.right} right, {c.wrong} wrong, {c.missed} missed, {c.joined} joined, {c.new} new"


def test_seasons(tmp_path: Path, add_row: Tables) -> None:
    found = pooled(tmp_path, SEASON, MapConfig(), 300)
    row(add_row, "clean", found)
    assert found.clusters.f1 >= 0.99
    assert found.flowers.f1 >= 0.97
    assert found.clusters.wrong_share <= 0.005
    inside = (np.array(found.prediction_nees) < 7.815).mean()
    assert 0.9 <= inside <= 0.985


def test_hard_seasons(tmp_path: Path, add_row: Tables) -> None:
    found = pooled(tmp_path, HARD_SEASON, MapConfig(), 400)
    row(add_row, "60 % visited, 20 % unseen, ghosts", found)
    assert found.clusters.f1 >= 0.97
    assert found.flowers.f1 >= 0.95


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


def test_kill_during_add_often(tmp_path: Path) -> None:
    kill_during_add(tmp_path, N_KILLS, 2)
