"""Matching of constellations: poses from nothing, their covariance, planes, and what must not be believed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from map_help import SMALL

from cluster_slam.config import GrowthConfig, MapConfig
from cluster_slam.constellation.fit import Pairs, fit, pose_covariance, variance_factors
from cluster_slam.constellation.growth import DAY_S, at
from cluster_slam.constellation.identify import nobody
from cluster_slam.constellation.match import match
from cluster_slam.constellation.plane import plane_frame, spaces
from cluster_slam.constellation.search import candidates_of
from cluster_slam.constellation.similarity import align
from cluster_slam.geometry import Array, inverse, se3_exp, se3_log, so3_exp, transform
from cluster_slam.records import Constellation, PlantMap
from cluster_slam.remember.decide import Refusal, decide
from cluster_slam.remember.tables import aligned, empty_plant
from cluster_slam.remember.update import update
from cluster_slam.simulate.config import SimulateConfig
from cluster_slam.simulate.season import HARD_SEASON, SEASON, SeasonPlant

CONFIG = MapConfig()


def plant_of(session: Constellation, name: str = "p") -> PlantMap:
    """The plant that a session founds."""
    where = aligned(session, np.eye(4), 1.0)
    empty = empty_plant(name, CONFIG.growth)
    return update(empty, session, where, nobody(session), np.zeros(0, dtype=bool), CONFIG, 0, 0).plant


def session_of(points: Array, clusters: Array, start: float = 0.0, sigma: float = 0.001) -> Constellation:
    n = int(clusters.max()) + 1
    covs = np.tile(sigma**2 * np.eye(3), (len(points), 1, 1))
    none = np.zeros((n, 2)), np.zeros((n, 2, 2))
    return Constellation(
        "s", start, start, np.arange(len(points)), clusters.astype(np.int64), points, covs, np.arange(n), *none
    )


@given(st.integers(0, 40), st.sampled_from([2, 3]))
def test_alignment_of_exact_points(seed: int, d: int) -> None:
    rng = np.random.default_rng(seed)
    R = so3_exp(rng.normal(size=3)) if d == 3 else so3_exp(rng.normal() * np.array([0.0, 0.0, 1.0]))[:2, :2]
    a = rng.normal(size=(1, 5, d))
    found = align(a, 1.05 * a @ R.T + 0.3, (0.9, 1.1))
    np.testing.assert_allclose(found.R[0], R, atol=1e-9)
    np.testing.assert_allclose(found.scale[0], 1.05, atol=1e-9)
    np.testing.assert_allclose(align(a, a @ R.T, (1.0, 1.0)).scale, 1.0)


def test_the_fit_is_the_generalised_least_squares_one() -> None:
    """Against Gauss-Newton's normal equations with the full covariance of flowers that share offsets."""
    rng = np.random.default_rng(3)
    unit = np.repeat(np.arange(4), 3)
    a = rng.normal(0.0, 0.3, (12, 3))
    b = a + rng.normal(0.0, 0.02, (4, 3))[unit] + rng.normal(0.0, 0.003, (12, 3))
    pairs = Pairs(a, b, np.full(12, 0.003**2), unit, np.full(4, 0.02**2))
    pose = fit(pairs, (1.0, 1.0))
    C = 0.003**2 * np.eye(12) + 0.02**2 * (unit[:, None] == unit)
    W = np.kron(np.linalg.inv(C), np.eye(3))
    residual = (b - pose.apply(a)[0]).ravel()
    J = np.concatenate(
        [np.concatenate([np.cross(np.eye(3)[k], a @ pose.R[0].T)[None] for k in range(3)]), np.zeros((3, 12, 3))]
    )
    J[3:] = np.eye(3)[:, None]
    gradient = J.reshape(6, -1) @ W @ residual
    scale = np.sqrt(np.diag(J.reshape(6, -1) @ W @ J.reshape(6, -1).T))
    assert np.abs(gradient / scale).max() < 1e-6


def test_the_covariance_of_the_pose_is_true() -> None:
    """Normalised errors of fits with simulated drift: 6 on average."""
    rng = np.random.default_rng(4)
    unit = np.repeat(np.arange(8), 4)
    a = rng.normal(0.0, 0.3, (8, 3))[unit] + rng.normal(0.0, 0.03, (32, 3))
    T = se3_exp(rng.normal(size=6))
    squared = []
    for _ in range(300):
        moved = a + rng.normal(0.0, 0.01, (8, 3))[unit] + rng.normal(0.0, 0.002, (32, 3))
        pairs = Pairs(a, transform(T, moved), np.full(32, 0.002**2), unit, np.full(8, 0.01**2))
        pose = fit(pairs, (1.0, 1.0))
        found = np.eye(4)
        found[:3, :3], found[:3, 3] = pose.R[0], pose.t[0]
        error = se3_log(inverse(T) @ found)
        squared.append(error @ np.linalg.solve(pose_covariance(pairs, 1.0, with_scale=False), error))
    assert abs(np.mean(squared) - 6.0) < 4 * np.sqrt(2 * 6 / 300)


def test_residuals_say_what_the_variances_are() -> None:
    """Errors within clusters twice, drift half as large as said: factors of 4 and 1/4, within a few of their sigmas."""
    rng = np.random.default_rng(6)
    unit = np.repeat(np.arange(40), 4)
    a = rng.normal(0.0, 0.3, (40, 3))[unit] + rng.normal(0.0, 0.03, (160, 3))
    b = a + rng.normal(0.0, 0.005, (40, 3))[unit] + rng.normal(0.0, 0.002, (160, 3))
    pairs = Pairs(a, b, np.full(160, 0.001**2), unit, np.full(40, 0.01**2))
    within, between = variance_factors(pairs, fit(pairs, (1.0, 1.0)))
    assert abs(within / 4.0 - 1.0) < 4 * np.sqrt(2 / 360) + 12 / 372
    assert abs(np.log2(between / 0.25)) < 4 * np.sqrt(2 / 114) / np.log(2)


def test_a_plant_at_another_time() -> None:
    """Position variance after t days without a look: v t^2 / 3 for a drift that keeps its direction."""
    plant = plant_of(SeasonPlant(SMALL, seed=0).rest().constellation)
    growth = GrowthConfig(walk_m_per_sqrt_day=0.0, setting_m=0.0, memory_days=1e6)
    plant = replace(plant, walk_rate=0.0)
    moved = at(plant, plant.last_session + 4 * DAY_S, growth)
    days = (plant.last_session + 4 * DAY_S - plant.cluster_time[0]) / DAY_S
    np.testing.assert_allclose(moved.cluster_covs[0, 0, 0], (0.003 * days) ** 2 / 3, rtol=1e-3)
    np.testing.assert_array_equal(at(plant, float("nan"), growth).clusters, plant.clusters)
    size = np.linalg.norm(moved.flowers - moved.clusters[moved.flower_rows], axis=1)
    before = np.linalg.norm(plant.flowers - plant.clusters[plant.flower_rows], axis=1)
    np.testing.assert_allclose(size, before * np.exp(0.01 * days), rtol=1e-9, atol=1e-12)


def test_drift_forgets_its_direction() -> None:
    """After many memories the velocity is worth nothing, and its variance is the prior again."""
    plant = plant_of(SeasonPlant(SMALL, seed=0).rest().constellation)
    known = replace(plant, velocities=plant.velocities + 0.002 / DAY_S, velocity_covs=plant.velocity_covs * 1e-6)
    moved = at(known, plant.cluster_time[0] + 1000 * DAY_S, GrowthConfig(memory_days=30.0))
    np.testing.assert_allclose(moved.velocity_covs, plant.velocity_covs, rtol=1e-6)
    np.testing.assert_allclose(moved.clusters - plant.clusters, 0.002 * 30.0, rtol=1e-6)  # speed times memory


@pytest.mark.parametrize(("gap", "changes"), [(1.0, {}), (7.0, {}), (3.0, {"visited_share": 0.6, "unseen_share": 0.2})])
def test_a_moved_base(gap: float, changes: dict[str, float]) -> None:
    config = replace(SEASON, session=SimulateConfig(n_clusters=14), **changes)  # type: ignore[arg-type]
    plant = SeasonPlant(config, seed=4)
    first = plant.rest()
    plant.grow_to(gap)
    later = plant.rest()
    known = at(plant_of(first.constellation), later.constellation.start)
    found = match(later.constellation, known).found
    assert found is not None
    T = inverse(first.T_map_world) @ later.T_map_world
    error = se3_log(inverse(T) @ found.T_map_world)
    cov = pose_covariance(found.pairs, 1.0, with_scale=False)
    assert error @ np.linalg.solve(cov, error) < 22.5  # 99.9 % of a chi-square with 6 degrees of freedom


def test_another_plant() -> None:
    """Thirty other plants: none accepted."""
    plants = [SeasonPlant(SMALL, seed=100 + k).rest().constellation for k in range(31)]
    known = plant_of(plants[0])
    for k, other in enumerate(plants[1:]):
        moved = replace(other, start=known.last_session + (1, 7, 14)[k % 3] * DAY_S)
        assert decide(moved, [known], CONFIG).refusal is not Refusal.NONE


def test_a_mirrored_plant_is_told_from_a_plant() -> None:
    """A left-handed frame: three flowers of a cluster fit their image, the plant as a whole does not."""
    for seed in range(3):
        plant = SeasonPlant(SMALL, seed=seed)
        known = plant_of(plant.rest().constellation)
        plant.grow_to(1.0)
        later = plant.rest().constellation
        decision = decide(replace(later, flowers=later.flowers * [1.0, 1.0, -1.0]), [known], CONFIG)
        assert decision.accepted is None
        assert "left-handed" in decision.reason
        assert decide(later, [known], CONFIG).accepted is not None


def test_half_of_a_flat_scene_is_clutter() -> None:
    """Eleven of sixteen are eleven of the map's twenty, and that is enough; sixteen anywhere are not."""
    rng = np.random.default_rng(5)
    known = np.column_stack([rng.uniform(-0.5, 0.5, (20, 2)), np.ones(20)])
    view = np.zeros(3)
    plant = replace(plant_of(session_of(known, np.arange(20), sigma=0.008)), viewpoint=view)
    seen = known[:11] + rng.normal(0.0, 0.006, (11, 3)) * [1.0, 1.0, 0.0]
    others = np.column_stack([rng.uniform(-0.5, 0.5, (16, 2)), np.ones(16)])
    turn = se3_exp(np.array([0.0, 0.0, 0.1, 0.05, 0.02, 0.0]))
    for points, is_known in ((np.concatenate([seen, others[:5]]), True), (others, False)):
        session = replace(session_of(transform(turn, points), np.arange(16), 8 * DAY_S, 0.008), viewpoint=view)
        assert (decide(session, [plant], CONFIG, similarity=True).accepted is not None) == is_known


def test_few_in_common_are_searched_for_longer() -> None:
    """16 of 46 flowers are known ones: no triple of the first look is of three of them."""
    config = replace(HARD_SEASON, session=SimulateConfig(n_clusters=20))
    plant = SeasonPlant(config, seed=6009)
    plant.grow_to(0.0)
    first = plant.rest()
    plant.grow_to(1.0)
    later = plant.rest()
    decision = decide(later.constellation, [plant_of(first.constellation)], CONFIG)
    assert decision.accepted is not None
    assert decision.accepted.found is not None
    T = inverse(first.T_map_world) @ later.T_map_world
    assert np.abs(se3_log(inverse(T) @ decision.accepted.found.T_map_world)).max() < 0.02


def lattice(seed: int, *, same: bool) -> tuple[Array, Array]:
    """Clusters planted on a grid of 4 x 3 x 2, of one shape or each of its own."""
    rng = np.random.default_rng(seed)
    corners = np.stack(np.meshgrid(*(np.arange(n) for n in (4, 3, 2)), indexing="ij"), -1).reshape(-1, 3) * 0.15
    shape = rng.normal(0.0, 0.02, (4, 3))
    points = [c + (shape if same else rng.normal(0.0, 0.02, (4, 3))) for c in corners]
    return np.concatenate(points), np.repeat(np.arange(24), 4)


def test_another_planted_grid_is_ambiguous() -> None:
    points, clusters = lattice(1, same=False)
    others, _ = lattice(2, same=False)
    decision = decide(session_of(others, clusters, DAY_S), [plant_of(session_of(points, clusters))], CONFIG)
    assert decision.refusal is Refusal.AMBIGUOUS
    assert "ambiguous" in decision.reason


def test_a_part_of_equal_clusters_on_a_grid_is_ambiguous() -> None:
    points, clusters = lattice(1, same=True)
    part = clusters < 12
    known = plant_of(session_of(points, clusters))
    decision = decide(session_of(points[part], clusters[part], DAY_S), [known], CONFIG)
    assert decision.refusal is Refusal.AMBIGUOUS


def test_flat_scenes_are_matched_in_their_plane() -> None:
    """Fruits of a picture, the camera put back askew with another scale: found; mirrored ones: not."""
    rng = np.random.default_rng(8)
    points = np.column_stack([rng.uniform(-0.4, 0.4, (12, 2)), np.ones(12)])
    view = np.zeros(3)
    known = replace(plant_of(session_of(points, np.arange(12), sigma=0.008)), viewpoint=view)
    turn = se3_exp(np.array([0.0, 0.0, 0.2, 0.05, 0.1, 0.0]))
    moved = transform(turn, points) * [1.05, 1.05, 1.0] + rng.normal(0.0, 0.004, (12, 3)) * [1.0, 1.0, 0.0]
    session = replace(session_of(moved, np.arange(12), 3 * DAY_S, 0.008), viewpoint=view)
    decision = decide(session, [known], CONFIG, similarity=True)
    assert decision.accepted is not None
    found = decision.accepted.found
    assert found is not None
    assert abs(found.scale - 1 / 1.05) < 0.02
    np.testing.assert_allclose(transform(found.T_map_world, found.scale * moved)[:, :2], points[:, :2], atol=0.02)
    mirrored = replace(session, flowers=moved * [-1.0, 1.0, 1.0])
    assert decide(mirrored, [known], CONFIG, similarity=True).accepted is None


def test_a_pose_counts_for_both_ways_of_drifting() -> None:
    """Clusters as a whole or flowers one by one, each as likely beforehand: of six single ones both say the same."""
    rng = np.random.default_rng(3)
    points = np.hstack([rng.uniform(-0.5, 0.5, (6, 2)), np.zeros((6, 1))])
    known = plant_of(session_of(points, np.arange(6)))
    moved = points + np.hstack([rng.normal(0.0, 0.004, (6, 2)), np.zeros((6, 1))])
    session = session_of(moved, np.arange(6), DAY_S)
    later = at(known, DAY_S)
    candidates, _ = candidates_of(session, later, MapConfig().match, GrowthConfig(), similarity=True)
    each = [max(c.evidence for c in candidates if c.single == single) for single in (False, True)]
    found = match(session, later, similarity=True)
    np.testing.assert_allclose(found.evidence, np.log(0.5 * np.exp(each[0]) + 0.5 * np.exp(each[1])), rtol=1e-9)


def test_the_side_of_a_plane() -> None:
    points = np.column_stack([np.random.default_rng(0).normal(size=(6, 2)), np.full(6, 2.0)])
    front, back = plane_frame(points, np.zeros(3)), plane_frame(points, np.array([0.0, 0.0, 9.0]))
    assert transform(front, np.zeros(3))[2] > 0
    assert transform(back, np.array([0.0, 0.0, 9.0]))[2] > 0
    assert len(spaces(points, points, 0.01, None, np.zeros(3))) == 2  # a side is not known: mirrored as well
    assert len(spaces(points, points, 0.01, np.zeros(3), np.zeros(3))) == 1


def test_too_few_flowers() -> None:
    session = SeasonPlant(SMALL, seed=0).rest().constellation
    decision = decide(session_of(np.eye(3)[:2], np.arange(2)), [plant_of(session)], CONFIG)
    assert decision.refusal is Refusal.TOO_FEW
