"""All sessions of a plant in one graph: against dense least squares, and what it does to a map."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from map_help import SMALL, map_of, rest_incoming

from cluster_slam.cli.app import run
from cluster_slam.geometry import inverse, se3_exp, se3_log, transform
from cluster_slam.graph.sessions import Sightings, smooth_sessions
from cluster_slam.io.map.check import problems
from cluster_slam.pipeline.remember import add
from cluster_slam.simulate.season import SeasonPlant


def test_drift_and_bases_are_recovered() -> None:
    """Four sessions of 12 clusters that drift: better than where it began, and as sure as it says."""
    rng = np.random.default_rng(2)
    days, n, rate, sigma = np.array([0.0, 1.0, 3.0, 7.0]), 12, 0.003, 0.001
    squared = []
    for _ in range(10):
        start = rng.uniform(-0.5, 0.5, (n, 3))
        drift = rng.normal(size=(n, 3)) * rate / np.sqrt(3)
        T = se3_exp(np.vstack([np.zeros(6), rng.normal(0.0, 0.5, (3, 6))]))
        local = [transform(inverse(T[s]), start + days[s] * drift) + rng.normal(0.0, sigma, (n, 3)) for s in range(4)]
        sightings = Sightings(
            np.repeat(np.arange(4), n),
            np.tile(np.arange(n), 4),
            np.concatenate(local),
            np.repeat(days, n),
            np.full(4 * n, sigma),
        )
        begin = T @ se3_exp(np.vstack([np.zeros(6), rng.normal(0.0, 0.02, (3, 6))]))
        found = smooth_sessions(sightings, begin, rate, huber=1e6)
        assert found.rms_after < 2.0 < found.rms_before
        for s in range(1, 4):
            error = se3_log(inverse(T[s]) @ found.T_map_world[s])
            squared.append(error @ np.linalg.solve(found.T_covs[s], error))
        np.testing.assert_array_equal(found.T_map_world[0], T[0])
    assert 3.0 < np.mean(squared) < 9.5  # 6 on average; the three of one trial share one mean drift


def test_a_map_is_optimised(tmp_path: Path) -> None:
    plant = SeasonPlant(SMALL, seed=0)
    with map_of(tmp_path, plant) as store:
        for day in (1.0, 3.0, 7.0):
            plant.grow_to(day)
            add(store, rest_incoming(plant))
        assert run(["map", "optimise", str(tmp_path / "row3.map"), "--quiet"]) == 0
        assert problems(store) == []
        after = store.plant("row3")
        plant.grow_to(9.0)
        assert add(store, rest_incoming(plant)).n_known >= 6
    assert len(after.cluster_ids) >= 7
    assert run(["map", "undo", str(tmp_path / "row3.map"), "--quiet"]) == 0
    assert run(["map", "undo", str(tmp_path / "row3.map"), "--quiet"]) == 2  # before it was optimised


@pytest.mark.parametrize("n", [1, 2])
def test_turns_that_few_clusters_leave_open_stay_small(n: int) -> None:
    """One cluster tells no turn, two none about the line between them: a shift of 7 mm becomes no turn beyond it."""
    places = np.array([[0.3, 0.1, 0.8], [-0.2, 0.4, 0.9]])[:n]
    begin = se3_exp(np.array([[0.0] * 6, [0.3, -0.2, 0.5, 0.1, 0.2, -0.1]]))
    seen = transform(inverse(begin[1]), places + 0.004)
    sessions, clusters = np.repeat([0, 1], n), np.tile(np.arange(n), 2)
    local, days = np.concatenate([places, seen]), np.repeat([0.0, 1.0], n)
    found = smooth_sessions(Sightings(sessions, clusters, local, days, np.full(2 * n, 0.001)), begin, 0.003)
    np.testing.assert_allclose(found.T_map_world[:, :3, :3], begin[:, :3, :3], atol=0.007)  # seen from a metre
    np.testing.assert_allclose(transform(found.T_map_world[1], seen), places, atol=1e-4)
