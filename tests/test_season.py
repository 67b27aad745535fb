"""Simulated seasons through a map: re-identification with its full confusion, alignment, prediction, presence."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from season_runs import Season, run_season

from cluster_slam.cli.app import run
from cluster_slam.config import GrowthConfig, MapConfig
from cluster_slam.errors import ConfigError
from cluster_slam.remember.score import Confusion, confusion
from cluster_slam.simulate.config import SimulateConfig
from cluster_slam.simulate.season import HARD_SEASON, SEASON, SeasonPlant

FIFTEEN = SimulateConfig(n_clusters=15)


@pytest.fixture(scope="module")
def season(tmp_path_factory: pytest.TempPathFactory) -> Season:
    return run_season(tmp_path_factory.mktemp("s"), replace(SEASON, session=FIFTEEN), MapConfig(), seed=31)


def test_a_season(season: Season) -> None:
    assert season.clusters.f1 >= 0.99
    assert season.flowers.f1 >= 0.97
    assert season.clusters.wrong_share <= 0.005


def test_alignment_is_as_good_as_it_says(season: Season) -> None:
    """Four sessions that share one mean drift: no more than one of them counts, 6 degrees of freedom."""
    assert 0.1 * 6 < np.mean(season.nees) < 3.8 * 6


def test_predictions_hold_the_next_session(season: Season) -> None:
    inside = float((np.array(season.prediction_nees) < 7.815).mean())
    assert 0.87 < inside <= 1.0  # 60 clusters: 0.95 less three standard deviations


def test_a_hard_season(tmp_path: Path) -> None:
    found = run_season(tmp_path, replace(HARD_SEASON, session=FIFTEEN), MapConfig(), seed=32)
    assert found.clusters.f1 >= 0.95
    assert found.flowers.f1 >= 0.9
    assert found.clusters.wrong_share <= 0.02
    assert found.problems == []


@pytest.mark.parametrize("factor", [0.5, 2.0])
def test_the_growth_prior_may_be_wrong(tmp_path: Path, factor: float) -> None:
    config = MapConfig(growth=GrowthConfig(drift_m_per_day=0.003 * factor, size_per_day=0.01 * factor))
    found = run_season(tmp_path, replace(SEASON, session=FIFTEEN, days="0 1 4"), config, seed=33)
    assert found.clusters.f1 >= 0.97


def test_what_was_not_looked_at_keeps_its_presence(tmp_path: Path) -> None:
    found = run_season(tmp_path, replace(HARD_SEASON, session=FIFTEEN, days="0 1"), MapConfig(), seed=34)
    assert found.unvisited_presence
    assert min(found.unvisited_presence) == 1.0


def test_the_confusion_leaves_nothing_out() -> None:
    known = {10: 1, 11: 2, 12: 3}
    true = np.array([1, 2, 3, 7, 8, -1])
    called = np.array([10, 12, 20, 21, 11, 11])
    found = confusion(true, called, np.array([False, False, True, True, False, False]), known)
    assert found == Confusion(right=1, wrong=1, missed=1, joined=2, new=1)
    # claimed 4, possible 3
    assert found.f1 == pytest.approx(2 / 7)
    assert found.wrong_share == pytest.approx(3 / 6)
    assert known[20] == 3
    assert known[21] == 7


def test_days_pass() -> None:
    plant = SeasonPlant(replace(SEASON, session=SimulateConfig(n_clusters=40, cluster_spacing_m=0.09)), seed=1)
    before, n = plant.centroids.copy(), len(plant.ids)
    spread = np.linalg.norm(plant.offsets, axis=1).mean()
    kept = set(plant.ids.tolist())
    plant.grow_to(10.0)
    moved = np.linalg.norm(plant.centroids - before, axis=1)
    assert 0.7 * 0.03 < np.sqrt((moved**2).mean()) < 1.3 * 0.03
    still = len(kept & set(plant.ids.tolist())) / n
    assert abs(still - 0.98**10) < 4 * np.sqrt(0.18 * 0.82 / n)
    assert len(set(plant.ids.tolist())) == len(plant.ids)
    assert np.linalg.norm(plant.offsets, axis=1).mean() > 1.02 * spread


def test_a_season_is_written(tmp_path: Path) -> None:
    short = ["--set", "days='0 2'", "--set", "session.n_clusters=4", "--set", "session.duration_s=1.0"]
    assert run(["simulate", str(tmp_path / "season"), "--preset", "season", "--quiet", *short]) == 0
    assert sorted(p.name for p in (tmp_path / "season").iterdir()) == ["day-00", "day-02"]
    assert run(["check", str(tmp_path / "season" / "day-02"), "--quiet"]) == 0
    with pytest.raises(ConfigError, match="numbers that increase"):
        _ = replace(SEASON, days="3 1").day_list
