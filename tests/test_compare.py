"""The comparison of descriptors: its statistics by hand, its population, the bound, and that the default wins."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest

from cluster_slam.cli.app import run
from cluster_slam.compare import compare_descriptors
from cluster_slam.compare.bound import TrueRatio
from cluster_slam.compare.comparison_page import case_words
from cluster_slam.compare.contenders import AXES, DEFAULT, GEOMETRY, PAPER, PAPER_EXACT, contenders
from cluster_slam.compare.population import Case, Population, all_pairs, observe
from cluster_slam.compare.recordings import neighbour_groups, plant_rows
from cluster_slam.compare.statistics import equal_error_rate, false_match_rate, rank_1
from cluster_slam.compare.trial import Size, run_case
from cluster_slam.descriptors import Background
from cluster_slam.errors import OutputError


def test_rates_by_hand() -> None:
    genuine, impostor = np.arange(1.0, 101.0), np.array([50.0, 90.0, 200.0, np.inf])
    assert false_match_rate(genuine, impostor) == 0.5
    assert false_match_rate(genuine, impostor, recall=0.4) == 0.0
    assert false_match_rate(np.full(5, np.inf), impostor) == 1.0
    assert equal_error_rate(np.array([1.0, 2.0]), np.array([3.0, 4.0])) == 0.0
    assert equal_error_rate(np.array([1.0, 3.0]), np.array([2.0, 4.0])) == pytest.approx(0.5)
    table = np.array([[1.0, 5.0, np.inf], [2.0, 4.0, np.inf], [3.0, 9.0, np.inf]])
    assert rank_1(table) == pytest.approx(2 / 3)  # the third is a tie of nothing with nothing


def test_the_population_is_what_it_says() -> None:
    rng = np.random.default_rng(0)
    points = Population().draw(5, 500, rng=rng)
    radius = np.linalg.norm(points, axis=-1).max(-1)
    assert radius.max() < 0.08
    gaps = np.linalg.norm(points[:, :, None] - points[:, None], axis=-1) + np.eye(5)
    assert gaps.min() >= 0.012
    case = Case(0.002, 5, n_missing=1, n_new=1)
    pairs = observe(case, points, rng=rng)
    assert (case.n_observed, pairs.observed.shape[1]) == (5, 5)
    near = np.linalg.norm(pairs.observed[:, :, None] - points[:, None], axis=-1).min(1) < 0.008
    assert 4.0 <= near.sum(1).mean() < 4.6  # four of the five are seen again


def test_the_default_wins_where_it_must() -> None:
    """2 mm, four flowers: at most 0.5 %, the paper's 4 to 7 %."""
    out = {o.name: o for o in run_case(Case(0.002, 4), contenders(), Size(60, 500, 800), rng=np.random.default_rng(1))}
    assert out[DEFAULT].false_match_rate <= 0.005
    assert out[GEOMETRY].false_match_rate <= 0.006
    assert 0.03 < out[PAPER].false_match_rate < 0.09
    assert 0.005 < out[AXES].false_match_rate < 0.03
    assert out[DEFAULT].rank_1 > 0.9 > 0.6 > out[PAPER].rank_1
    assert 0.75 < out[PAPER].coverage < 0.85
    assert 0.93 < out[PAPER_EXACT].coverage < 0.98


@pytest.mark.nightly
@pytest.mark.parametrize(
    ("case", "limit", "paper"),
    [
        (Case(0.002, 5), 0.005, (0.03, 0.08)),
        (Case(0.002, 6), 0.005, (0.03, 0.08)),
        (Case(0.005, 6), 0.07, (0.17, 0.25)),
        (Case(0.005, 6, n_missing=1), 0.18, (0.27, 0.40)),
    ],
)
def test_false_matches_of_the_default(case: Case, limit: float, paper: tuple[float, float]) -> None:
    out = {o.name: o for o in run_case(case, contenders(), Size(), rng=np.random.default_rng(2))}
    assert out[DEFAULT].false_match_rate <= limit
    assert paper[0] < out[PAPER].false_match_rate < paper[1]


def test_a_likelihood_ratio_averages_to_one_over_chance() -> None:
    """E[p(X, Y) / p(X) p(Y)] = 1 under p(X) p(Y), summed over the n! maps; with 2 flowers there is one map twice."""
    rng = np.random.default_rng(3)
    background, sigma = Background(0.03, 0.25), 0.012
    n_pairs = 20_000
    scale = 0.03 * np.exp(0.25 * rng.standard_normal((2, n_pairs, 1, 1)))
    x, y = scale * rng.standard_normal((2, n_pairs, 2, 3)) + sigma * rng.standard_normal((2, n_pairs, 2, 3))
    ratios = [np.exp(background.log_likelihood_ratio(x, other, sigma, sigma)) for other in (y, y[:, ::-1])]
    total = ratios[0] + ratios[1]
    assert total.mean() == pytest.approx(1.0, abs=5 * total.std() / np.sqrt(n_pairs) + 0.15)  # Laplace's error


def test_the_bound_is_a_likelihood_ratio_too() -> None:
    rng = np.random.default_rng(4)
    population, case = Population(), Case(0.004, 3)
    ratio = TrueRatio(population, 3, case.sigma_m, rng=rng)
    pairs = observe(case, population.draw(3, 120, rng=rng), rng=rng)
    i, j = all_pairs(120)
    value = np.exp(ratio(pairs, i, j))
    assert value[i != j].mean() == pytest.approx(1.0, rel=0.35)
    assert np.median(value[i == j]) > 5.0


def test_groups_of_neighbours() -> None:
    line = np.array([[0.0, 0, 0], [0.1, 0, 0], [0.2, 0, 0], [5.0, 0, 0]])
    groups = neighbour_groups([line, line[:2]], 3)
    assert sorted(g[:, 0].tolist() for g in groups) == [[0.0, 0.1, 0.2], [0.1, 0.2, 5.0]]


def test_plants_are_told_apart_with_missing_and_false_flowers() -> None:
    rng = np.random.default_rng(5)
    plants = [0.25 * rng.standard_normal((8, 3)) for _ in range(3)]
    seen = [np.vstack([p[[5, 1, 4, 0, 7]] + 1.0, rng.standard_normal((1, 3))]) for p in plants]
    rows = plant_rows(plants, [s + 0.006 * rng.standard_normal(s.shape) for s in seen])
    assert [row.best_plant for row in rows] == [1, 2, 3]
    assert all(row.n_matched == 5 and row.gain > row.next_gain + 10 for row in rows)


def test_the_folder(tmp_path: Path) -> None:
    cases = (Case(0.002, 3), Case(0.005, 4, n_missing=1))
    stages: list[str] = []
    done = compare_descriptors(
        tmp_path / "out",
        seed=7,
        recordings=tmp_path,  # holds none
        progress=lambda stage, fraction: stages.append(stage),
        cases=cases,
        size=Size(12, 60, 50),
    )
    with (tmp_path / "out" / "descriptors.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == len(done.outcomes) == 7 + 6  # the bound only where nothing is missing
    assert {"descriptor", "false_match_rate", "rank_1", "coverage", "us_per_pair"} <= set(rows[0])
    assert stages[-1] == "done"
    page = (tmp_path / "out" / "index.html").read_text()
    assert "No recordings were given" in page
    assert case_words(cases[1]) in page
    again = compare_descriptors(tmp_path / "out", seed=7, cases=cases, size=Size(12, 60, 50))  # replaces its own
    assert [o.false_match_rate for o in again.outcomes] == [o.false_match_rate for o in done.outcomes]
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "notes.txt").write_text("keep me")
    with pytest.raises(OutputError, match=r"notes\.txt"):
        compare_descriptors(tmp_path / "other")


def test_recordings_that_are_not_there_are_said_to_be_missing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Before the two minutes that the comparison takes, and not by leaving them out."""
    assert run(["compare-descriptors", "-o", str(tmp_path / "out"), "--recordings", str(tmp_path / "no")]) == 2
    assert "no: missing, expected a folder of recordings" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
