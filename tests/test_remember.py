"""What the map predicts and how sure it says to be of a plant's frame: by hand, by enumeration, by simulation."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
from map_help import map_of, rest_incoming
from test_constellation import plant_of

from cluster_slam.config import MapConfig
from cluster_slam.constellation.fit import Pairs, pose_covariance
from cluster_slam.constellation.growth import DAY_S, at, memory_days
from cluster_slam.constellation.identify import Identities
from cluster_slam.io.map import open_map
from cluster_slam.io.map.store import MapStore
from cluster_slam.pipeline.remember import add
from cluster_slam.records import Sightings
from cluster_slam.remember.gauge import frame_covariance
from cluster_slam.remember.history import hidden_looks, history_of
from cluster_slam.remember.hold import Seen, holding
from cluster_slam.remember.predict import membership_cov
from cluster_slam.remember.seen import PRIOR_SURPRISES, Habits, habits_of, learned_seen_share, scattered
from cluster_slam.remember.tables import aligned
from cluster_slam.remember.update import update
from cluster_slam.simulate.config import SimulateConfig
from cluster_slam.simulate.season import SEASON, SeasonPlant


def enumerated(offsets: np.ndarray, share: np.ndarray) -> np.ndarray:
    """Covariance of the centroid of those that are seen, over all ways of being seen but none."""
    total, weight = np.zeros((3, 3)), 0.0
    for seen in product((False, True), repeat=len(share)):
        if any(seen):
            p = float(np.prod(np.where(seen, share, 1.0 - share)))
            mean = offsets[list(seen)].mean(axis=0)
            total, weight = total + p * np.outer(mean, mean), weight + p
    return total / weight


def test_centroids_of_the_flowers_that_are_seen() -> None:
    """Against all subsets, of two clusters at once; equal shares make the closed form exact."""
    rng = np.random.default_rng(0)
    offsets, row = rng.normal(0.0, 0.02, (7, 3)), np.array([0, 0, 0, 1, 1, 1, 1])
    share = np.array([0.8] * 3 + [0.6] * 4)
    for c in (0, 1):
        offsets[row == c] -= offsets[row == c].mean(axis=0)
    found = membership_cov(offsets, share, row, np.zeros(2), np.zeros(2))
    for c in (0, 1):
        np.testing.assert_allclose(found[c], enumerated(offsets[row == c], share[row == c]), rtol=1e-4, atol=1e-9)


def test_all_seen_and_nothing_new_moves_no_centroid() -> None:
    offsets = np.array([[0.01, 0.0, 0.0], [-0.01, 0.0, 0.0]])
    assert np.abs(membership_cov(offsets, np.ones(2), np.zeros(2, int), np.zeros(1), np.ones(1))).max() < 1e-9


def test_an_unknown_flower_beside_one() -> None:
    """One flower that is always seen and m ~ Poisson(0.3) others of variance 1: E[m / (1 + m)^2] = 0.0677."""
    m = np.arange(20)
    poisson = np.exp(-0.3) * 0.3**m / np.cumprod(np.maximum(m, 1))
    found = membership_cov(np.zeros((1, 3)), np.ones(1), np.zeros(1, int), np.array([0.3]), np.ones(1))
    np.testing.assert_allclose(found[0], float(poisson @ (m / (1.0 + m) ** 2)) * np.eye(3), rtol=1e-4)


def test_ellipsoids_hold_what_a_gaussian_would_not() -> None:
    """Jumps in a tenth of the draws: the 95 % ellipsoid reaches their middle, one in fifty is left out, none counts."""
    n = 4
    smooth = np.tile(1e-6 * np.eye(3), (n, 1, 1))
    unknown, spread = np.array([-np.log(0.9), -np.log(0.98), 0.0, 0.0]), np.full(n, 0.02**2)
    offsets = np.array([[0.0, 0.0, 0.0]] * 3 + [[0.03, 0.0, 0.0], [-0.03, 0.0, 0.0]])
    seen = Seen(offsets, np.array([1.0, 1.0, 1.0, 0.5, 0.5]), np.array([0, 1, 2, 3, 3]), unknown, spread, np.zeros(n))
    sure = Habits(0.9999, 1e9, 1.0, 1.0, 1e9)
    covs = smooth + membership_cov(offsets, seen.share, seen.row, unknown, spread)
    held = holding(covs, smooth, seen, sure)
    radius = np.sqrt(7.815 * np.array([np.diag(c).min() for c in held]))
    # one more flower puts the centroid at half of its offset, 0.01 an axis: its norm is beyond 1.54 sigma in a half
    assert 0.011 < radius[0] < 0.020
    assert radius[1] < 0.004
    np.testing.assert_allclose(radius[2], 0.0028, rtol=0.1)
    assert np.sqrt(7.815 * held[3][0, 0]) > 0.03  # either of two is seen in two thirds


def learned(store: MapStore) -> tuple[float, float]:
    plant = store.plant("row3")
    return learned_seen_share(plant, history_of(plant), MapConfig())


def test_the_share_of_flowers_that_are_seen_is_learned(tmp_path: Path) -> None:
    """Half of the flowers are hidden the second time: from a prior of 0.85 towards a half."""
    config = replace(SEASON, session=SimulateConfig(n_clusters=12))
    plant = SeasonPlant(config, seed=3)
    with map_of(tmp_path, plant) as store:
        assert learned(store) == (0.85, 10.0)
    hidden = SeasonPlant(replace(config, unseen_share=0.5), seed=3)
    hidden.grow_to(0.0)
    second = rest_incoming(hidden).constellation
    second = replace(second, session="second", start=second.start + DAY_S, end=second.end + DAY_S)
    with open_map(tmp_path / "row3.map") as store:
        assert add(store, replace(rest_incoming(plant), constellation=second)).session is not None
        assert 0.45 < learned(store)[0] < 0.75


def test_looks_in_vain_are_counted_as_often_as_there_were_any() -> None:
    """Three of a cluster, five sessions: who was seen, beside whom, and how many looks a lost one was hidden in."""
    plant = plant_of(SeasonPlant(replace(SEASON, session=SimulateConfig(n_clusters=12)), seed=3).rest().constellation)
    mine = np.flatnonzero(plant.flower_rows == 1)[:3]
    assert len(mine) == 3
    looks = {0: (0, 1, 3, 4), 1: (0,), 2: (1, 2)}  # of each flower the sessions; the third session saw one alone
    told = [(int(plant.flower_ids[mine[k]]), s) for k, seen in looks.items() for s in seen]
    ids, sessions = np.array(told).T
    times = 1e9 + DAY_S * np.array([0.0, 1.0, 2.0, 4.0, np.nan])  # that one has no date changes nothing
    history = history_of(replace(plant, sightings=Sightings(ids, sessions, times)))
    np.testing.assert_array_equal(history.counts[1], [2, 2, 1, 1, 1])
    np.testing.assert_array_equal(history.newcomers[1], [2, 1, 0, 0, 0])
    np.testing.assert_array_equal(history.first[mine], [0, 0, 1])
    np.testing.assert_array_equal(history.last[mine], [4, 0, 2])
    np.testing.assert_array_equal(history.beside[mine[0]], [True, True, True, False, False])
    np.testing.assert_array_equal(history.days, [0.0, 1.0, 2.0, 4.0, 4.0])
    found = hidden_looks(history, np.full(len(plant.flower_ids), 0.9), 0.8, 0.1)[mine]
    # the second: looks after 1, 2, 4 and 4 days; lost in between, or hidden each time
    there = 0.9 * np.array([1.0, 0.2 * 0.9, 0.2**2 * 0.9**2, 0.2**3 * 0.9**4, 0.2**4 * 0.9**4])
    lost = 0.9 * np.array([0.1, 0.2 * 0.9 * 0.1, 0.2**2 * (0.9**2 - 0.9**4), 0.0])
    expected = (lost @ np.arange(4) + 4 * there[4]) / (0.1 + lost.sum() + there[4])
    np.testing.assert_allclose(found[:2], [0.0, expected], rtol=1e-12)


def test_a_map_tells_all_sightings(tmp_path: Path) -> None:
    """As many as were stored, and habits learned from all of them: nobody hidden in three sessions."""
    plant = SeasonPlant(replace(SEASON, session=SimulateConfig(n_clusters=12)), seed=3)
    with map_of(tmp_path, plant) as store:
        for day in (1.0, 3.0):
            plant.grow_to(day)
            assert add(store, rest_incoming(plant)).session is not None
        known = store.plant("row3")
        told = known.sightings
        assert told is not None
        n = store.read("SELECT session_id, count(*) FROM flower_observations GROUP BY session_id ORDER BY session_id")
        np.testing.assert_array_equal(np.bincount(told.sessions), [count for _, count in n])
        np.testing.assert_array_equal(told.session_times, [s.start for s in store.sessions()])
        assert learned(store)[0] > 0.97
        assert learned_seen_share(known, history_of(replace(known, sightings=None)), MapConfig())[0] > 0.95


def test_flowers_that_come_with_time_are_told_from_those_that_come_at_once(tmp_path: Path) -> None:
    """Nobody hidden, none false, but three times as many new ones as expected: after a long gap more are expected."""
    config = replace(SEASON, new_per_day=0.09, lost_per_day=0.0, session=SimulateConfig(n_clusters=30))
    plant, options = SeasonPlant(config, seed=3), MapConfig()
    with map_of(tmp_path, plant) as store:
        before = habits_of(store.plant("row3"), options)
        for day in (4.0, 8.0):
            plant.grow_to(day)
            assert add(store, rest_incoming(plant)).session is not None
        after = habits_of(store.plant("row3"), options)
    assert (before.at_once, before.since) == (1.0, 1.0)
    assert 1.8 < after.since < 3.3
    assert after.share > 0.97


def test_where_flowers_come_is_learned() -> None:
    """One of three flowers came later, three sigma along each axis from the middle of the other two: 9 / 1.5."""
    config = replace(SEASON, session=SimulateConfig(n_clusters=12))
    plant = plant_of(SeasonPlant(config, seed=3).rest().constellation)
    time, flowers = plant.flower_first_seen.copy(), plant.flowers.copy()
    assert scattered(plant, np.ones(len(plant.cluster_ids))) == 1.0  # nobody came later
    mine = np.flatnonzero(plant.flower_rows == 1)[:3]
    others = np.flatnonzero(plant.flower_rows == 1)[3:]
    time[others] = time[mine[2]] = time[0] + DAY_S
    flowers[mine[2]] = flowers[others] = flowers[mine[:2]].mean(axis=0) + 3.0
    found = scattered(replace(plant, flower_first_seen=time, flowers=flowers), np.ones(len(plant.cluster_ids)))
    n = 1 + len(others)
    np.testing.assert_allclose(found, (PRIOR_SURPRISES + n * 9.0 / 1.5) / (PRIOR_SURPRISES + n))


def test_a_plant_that_drifts_steadily_is_predicted_better(tmp_path: Path) -> None:
    """After three gaps without a walk the plant is known to be steady, and one that walks to be none."""
    rates, sigmas = [], []
    for walk in (0.0, 0.002):
        config = replace(SEASON, walk_m_per_sqrt_day=walk, session=SimulateConfig(n_clusters=30))
        plant, options = SeasonPlant(config, seed=5), MapConfig()
        folder = tmp_path / str(walk)
        folder.mkdir()
        with map_of(folder, plant) as store:
            for day in (1.0, 3.0, 7.0):
                plant.grow_to(day)
                assert add(store, rest_incoming(plant)).session is not None
            known = store.plant("row3")
        week = at(known, known.last_session + 7 * DAY_S, options.growth)
        rates.append(memory_days(known, options.growth))
        sigmas.append(float(np.sqrt(np.trace(week.cluster_covs, axis1=1, axis2=2).mean() / 3.0)))
    assert rates[0] > 120.0 > 60.0 > rates[1]
    assert sigmas[0] < 0.0035 < 0.006 < sigmas[1]


def test_the_frame_is_as_sure_as_the_mean_drift(tmp_path: Path) -> None:
    """12 clusters that drift 3 mm a day, seen without an error: the mean of 10 days, 30 / sqrt(3 * 12) mm an axis."""
    with map_of(tmp_path, SeasonPlant(replace(SEASON, session=SimulateConfig(n_clusters=12)), seed=1)) as store:
        plant, sessions = replace(store.plant("row3"), walk_rate=0.0), store.sessions("row3")
    n = len(plant.cluster_ids)
    a = np.random.default_rng(0).normal(0.0, 0.5, (n, 3))
    a -= a.mean(axis=0)
    pairs = Pairs(a, a, np.full(n, 1e-12), np.arange(n), np.zeros(n))
    cov = frame_covariance(pairs, 1.0, plant, sessions, sessions[0].start + 10 * DAY_S, 1e6, with_scale=False)
    np.testing.assert_allclose(np.diag(cov)[3:], 0.03**2 / 3.0 / n, rtol=1e-3)
    # a later session whose clusters have known velocities: flowers within clusters no longer help to turn it
    b = np.repeat(a, 2, axis=0) + np.tile([[0.02, 0.0, 0.01], [-0.02, 0.0, -0.01]], (n, 1))
    two = Pairs(b, b, np.full(2 * n, 1e-6), np.repeat(np.arange(n), 2), np.zeros(n))
    later = sessions[0].start + 10 * DAY_S
    second = [sessions[0], replace(sessions[0], start=sessions[0].start + DAY_S)]
    grown = frame_covariance(two, 1.0, plant, second, later, 1e6, with_scale=False)
    wide = replace(two, var_offset=np.full(n, 0.03**2 / 3.0), variance=two.variance * 100.0)
    np.testing.assert_allclose(grown, pose_covariance(wide, 1.0, with_scale=False), rtol=1e-3, atol=1e-12)
    assert (
        np.diag(grown)[:3]
        > 1.05 * np.diag(frame_covariance(two, 1.0, plant, sessions, later, 1e6, with_scale=False))[:3]
    ).all()


def test_a_cluster_whose_flowers_all_changed(tmp_path: Path) -> None:
    """It is seen, not missed, and stands where it was expected at the later time."""
    plant = SeasonPlant(replace(SEASON, session=SimulateConfig(n_clusters=12)), seed=2)
    with map_of(tmp_path, plant) as store:
        known = store.plant("row3")
    first = rest_incoming(plant).constellation
    later = replace(first, start=first.start + DAY_S, end=first.end + DAY_S)
    rows = np.arange(len(first.flowers))
    other = first.flower_cluster_ids == 2
    n = len(first.cluster_ids)
    who = Identities(np.arange(n), np.ones(n), np.where(other, -1, rows), np.ones(len(rows)))
    where = aligned(later, np.eye(4), 1.0)
    after = update(known, later, where, who, np.ones(len(rows), dtype=bool), MapConfig(), 100, 1000)
    assert len(after.missed) == 0
    assert after.cluster_map_ids.tolist() == known.cluster_ids.tolist()
    assert after.flower_map_ids[other].min() == 1000
    np.testing.assert_array_equal(after.plant.cluster_time, later.start)
    np.testing.assert_array_equal(after.plant.cluster_last_seen, later.start)
    grown = np.trace(after.plant.cluster_covs[2] - known.cluster_covs[2])
    assert 0.9 * 0.003**2 < grown < 2.0 * 0.003**2  # a day's drift is in its covariance
    assert after.plant.flower_presence[: len(rows)][known.flower_cluster_ids == known.cluster_ids[2]].max() < 1.0
