"""The simulated plant keeps its spacings, sways as it should, and the arm sweeps past it as an arm does."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cluster_slam.config import override
from cluster_slam.errors import ConfigError
from cluster_slam.geometry import inverse, se3_log
from cluster_slam.simulate import PRESETS, SimulateConfig
from cluster_slam.simulate.camera_path import camera_path, measured_poses, mount_camera
from cluster_slam.simulate.motion import flower_positions, move
from cluster_slam.simulate.plant import Plant, grow_plant

MODERATE, HARD = PRESETS["moderate"], PRESETS["hard"]


def _nearest(points: np.ndarray) -> np.ndarray:
    distance = np.linalg.norm(points[:, None] - points, axis=2)
    return (distance + np.diag(np.full(len(points), np.inf))).min(1)


def _plant(config: SimulateConfig, seed: int = 0) -> Plant:
    return grow_plant(config, rng=np.random.default_rng(seed))


@settings(max_examples=25, deadline=None)
@given(
    seed=st.integers(0, 2**32),
    n=st.integers(1, 100),
    spacing=st.sampled_from([0.06, 0.08]),
    most=st.integers(3, 8),
    scale=st.sampled_from([0.5, 1.0, 3.0]),
)
def test_a_plant_keeps_its_spacings_and_sizes(seed: int, n: int, spacing: float, most: int, scale: float) -> None:
    config = replace(MODERATE, n_clusters=n, cluster_spacing_m=spacing, flowers_max=most, scale=scale)
    plant = _plant(config, seed)
    counts = np.bincount(plant.flower_cluster)
    assert ((counts[:n] >= 3) & (counts[:n] <= most)).all()
    assert (counts[n:] == 1).all()
    assert abs(len(counts[n:]) / counts.sum() - config.loose_share) <= 0.51 / counts[:n].sum() + 0.01
    assert (_nearest(plant.centroids) >= spacing * scale - 1e-12).all()
    assert (_nearest(plant.flowers) >= 0.012 * scale - 1e-12).all()
    for j in range(len(counts)):
        members = plant.flowers[plant.flower_cluster == j]
        np.testing.assert_allclose(members.mean(0), plant.centroids[j], atol=1e-12)
        radius = np.linalg.norm(members - plant.centroids[j], axis=1).max() / scale
        assert radius < 1e-12 if counts[j] == 1 else 0.02 - 1e-12 <= radius <= 0.05 + 1e-12


def test_scale_multiplies_the_plant_exactly() -> None:
    one, three = _plant(HARD), _plant(replace(HARD, scale=3.0))
    np.testing.assert_allclose(three.flowers, 3.0 * one.flowers, rtol=1e-14)
    np.testing.assert_allclose(three.attachments, 3.0 * one.attachments, rtol=1e-14)


def test_hard_clusters_crowd_and_overlap() -> None:
    shares = []
    for seed in range(5):
        plant = _plant(HARD, seed)
        assert np.median(_nearest(plant.centroids)) < 1.3 * HARD.cluster_spacing_m
        distance = np.linalg.norm(plant.flowers[:, None] - plant.flowers, axis=2)
        same = plant.flower_cluster[:, None] == plant.flower_cluster
        shares.append((np.where(same, np.inf, distance).min(1) < np.where(same, distance, 0.0).max(1)).mean())
    assert np.mean(shares) > 0.08  # flowers to whom a stranger is nearer than their own farthest


def test_what_does_not_fit_is_refused_with_numbers() -> None:
    with pytest.raises(ConfigError, match=r"only \d+ of \d+ clusters fit at cluster_spacing_m = 0\.3"):
        _plant(replace(MODERATE, n_clusters=100, cluster_spacing_m=0.3))
    with pytest.raises(ConfigError, match="8 flowers do not fit within"):
        _plant(replace(MODERATE, flowers_min=8, flowers_max=8, flower_spacing_m=0.04))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"miss_rate": 1.5}, "miss_rate must lie within 0 and 1"),
        ({"fps": 0.0}, "fps must be greater than 0"),
        ({"flowers_min": 7}, "flowers_min = 7 must not exceed flowers_max = 6"),
        ({"sway_m": -0.1}, "sway_m wants a number from 0"),
        ({"duration_s": float("nan")}, "duration_s wants a finite number"),
        ({"pose_frame": "T_world_gripper"}, "pose_frame must be one of"),
        ({"level": 4}, "level must be one of"),
        ({"n_clusters": 0}, "n_clusters must be greater than 0"),
    ],
)
def test_options_out_of_range_are_refused(change: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        override(MODERATE, change)


def _ringing() -> SimulateConfig:
    """One cluster, 1 Hz, damping 0.1, nothing else moves."""
    return replace(
        MODERATE,
        n_clusters=1,
        loose_share=0.0,
        ambient_sway_m=0.0,
        touches_per_minute=3.0,
        duration_s=60.0,
        sway_frequency_min_hz=1.0,
        sway_frequency_max_hz=1.0,
        damping_min=0.1,
        damping_max=0.1,
    )


def test_a_touch_rings_down_as_a_damped_oscillator() -> None:
    config = _ringing()
    times = np.arange(60_000) / 1000.0
    s = move(config, _plant(config), times, rng=np.random.default_rng(5)).displacements[:, 0]
    size = np.linalg.norm(s, axis=1)
    peaks = np.flatnonzero((size[1:-1] > size[:-2]) & (size[1:-1] >= size[2:])) + 1
    steps = np.diff(peaks) / 1000.0
    half_period = 0.5 / np.sqrt(1 - 0.1**2)  # |s| peaks twice a period
    regular = np.abs(steps - half_period) < 0.002
    assert regular.sum() > 20
    ratio = size[peaks[1:]] / size[peaks[:-1]]
    decay = np.exp(-np.pi * 0.1 / np.sqrt(1 - 0.1**2))
    assert np.median(ratio[regular]) == pytest.approx(decay, rel=1e-3)
    assert 0.6 * config.sway_m * 0.7 * 0.9 <= size.max() <= config.sway_m


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32), touches=st.sampled_from([20.0, 200.0, 1000.0]))
def test_sway_never_exceeds_its_bound(seed: int, touches: float) -> None:
    config = replace(MODERATE, ambient_sway_m=0.0, touches_per_minute=touches, duration_s=10.0)
    motion = move(config, _plant(config, 3), np.arange(1000) / 100.0, rng=np.random.default_rng(seed))
    assert np.linalg.norm(motion.displacements, axis=2).max() <= config.sway_m * (1 + 1e-12)


def test_sway_is_across_the_stem_and_neighbours_sway_together() -> None:
    config = replace(HARD, ambient_sway_m=0.0)
    plant = _plant(config, 2)
    s = move(config, plant, np.arange(3600) / 60.0, rng=np.random.default_rng(2)).displacements
    along = np.abs((s * plant.tangents).sum(2)).sum() / np.linalg.norm(s, axis=2).sum()
    assert along < 0.2  # a free direction has 0.5
    size = np.linalg.norm(s, axis=2)
    like = np.corrcoef(size.T)
    distance = np.linalg.norm(plant.centroids[:, None] - plant.centroids, axis=2)
    near, far = (distance < 0.1) & (distance > 0), distance > 0.6
    assert np.median(like[near]) > 0.5 > 0.2 > np.median(like[far])
    assert like[near].max() < 0.999  # together, not alike


def test_members_share_the_displacement_and_turn_as_a_rigid_body() -> None:
    plain = replace(HARD, duration_s=20.0)
    turning = replace(plain, sway_rotation_rad=0.3)
    plant = _plant(plain)
    times = np.arange(600) / 30.0
    still = move(plain, plant, times, rng=np.random.default_rng(1))
    turned = move(turning, plant, times, rng=np.random.default_rng(1))
    np.testing.assert_array_equal(still.displacements, turned.displacements)
    offsets = flower_positions(plant, still) - plant.flowers - still.displacements[:, plant.flower_cluster]
    np.testing.assert_allclose(offsets, 0.0, atol=1e-12)
    assert turned.rotations is not None
    angles = np.linalg.norm(turned.rotations, axis=2)
    assert 0.1 < angles.max() <= 0.3 * (1 + 1e-12)
    members = np.flatnonzero(plant.flower_cluster == angles.max(0).argmax())
    moved = flower_positions(plant, turned)[:, members]
    gaps = np.linalg.norm(moved[:, :, None] - moved[:, None], axis=3)
    np.testing.assert_allclose(gaps, np.broadcast_to(gaps[0], gaps.shape), atol=1e-12)
    cluster = plant.flower_cluster[members[0]]
    centroid = plant.centroids[cluster] + turned.displacements[:, cluster]
    np.testing.assert_allclose(moved.mean(1), centroid, atol=1e-12)


def test_ambient_sway_and_growth_are_as_configured() -> None:
    config = replace(MODERATE, touches_per_minute=0.0, n_clusters=12, growth_m_per_s=0.0)
    plant = _plant(config)
    times = np.arange(40_000) / 20.0
    s = move(config, plant, times, rng=np.random.default_rng(0)).displacements
    n_free = s.size * (1 - np.exp(-2 * 0.05 / 0.3)) / 2  # correlated samples count for less
    assert s.std() == pytest.approx(3e-4, rel=4 / np.sqrt(2 * n_free))
    lag = (s[1:] * s[:-1]).mean() / (s**2).mean()
    assert lag == pytest.approx(np.exp(-0.05 / 0.3), abs=0.01)
    growing = replace(config, growth_m_per_s=1e-4, ambient_sway_m=0.0)
    g = move(growing, plant, np.array([0.0, 10.0, 20.0]), rng=np.random.default_rng(0)).displacements
    np.testing.assert_allclose(g[0], 0.0)
    np.testing.assert_allclose(g[2], 2 * g[1])
    assert 3e-4 < np.linalg.norm(g[1], axis=1).mean() < 3e-3


@pytest.mark.parametrize("name", ["moderate", "hard", "moderate-small", "moderate-large", "moderate-translation"])
def test_the_camera_sweeps_slowly_and_looks_at_the_plant(name: str) -> None:
    config = PRESETS[name]
    times = np.arange(config.n_frames) / config.fps
    for seed in range(4):
        plant = _plant(config, seed)
        T = camera_path(config, plant, times, rng=np.random.default_rng(seed))
        assert np.abs(T[:, :3, :3] @ np.swapaxes(T[:, :3, :3], 1, 2) - np.eye(3)).max() < 1e-12
        np.testing.assert_allclose(np.linalg.det(T[:, :3, :3]), 1.0)
        speed = np.linalg.norm(np.diff(T[:, :3, 3], axis=0), axis=1) * config.fps
        assert 0.05 < speed.mean() < speed.max() <= 0.5
        assert (plant.centroids[:, 1].mean() - T[:, 1, 3] > 0.2 * config.scale).all()  # the arm's side of the row
        rays = plant.centroids - T[:, None, :3, 3]
        off_axis = np.arccos((rays @ T[:, :3, 2, None])[..., 0] / np.linalg.norm(rays, axis=2)).min(1)
        assert np.rad2deg(np.median(off_axis)) < 20 < np.rad2deg(off_axis.max()) + 20 < 80  # a cluster ahead
        turned = np.linalg.norm(se3_log(inverse(T[:1]) @ T)[:, :3], axis=1).max()
        assert turned > 0.5 if config.turn_rad else turned < 1e-9


@settings(max_examples=20, deadline=None)
@given(seed=st.integers(0, 2**32))
def test_the_hand_eye_error_has_exactly_its_norms(seed: int) -> None:
    hand_eye = mount_camera(MODERATE, rng=np.random.default_rng(seed))
    assert np.linalg.norm(hand_eye.measured[:3, 3] - hand_eye.true[:3, 3]) == pytest.approx(0.004)
    error = se3_log(inverse(hand_eye.true) @ hand_eye.measured)
    assert np.rad2deg(np.linalg.norm(error[:3])) == pytest.approx(0.5)


def test_the_noise_of_the_poses_is_as_configured() -> None:
    config = replace(MODERATE, duration_s=300.0)
    plant = _plant(config)
    T = camera_path(config, plant, np.arange(config.n_frames) / config.fps, rng=np.random.default_rng(0))
    hand_eye = mount_camera(config, rng=np.random.default_rng(1))
    flange = measured_poses(config, T, hand_eye, rng=np.random.default_rng(2))
    error = se3_log(inverse(T @ inverse(hand_eye.true)) @ flange)
    tolerance = 4 / np.sqrt(2 * 3 * len(T))
    assert error[:, :3].std() == pytest.approx(0.002, rel=tolerance)
    assert error[:, 3:].std() == pytest.approx(0.001, rel=tolerance)
    assert abs((error[1:] * error[:-1]).mean(0) / error.var(0)).max() < 4 / np.sqrt(len(T))  # white


def test_odometry_starts_true_and_its_steps_err_with_the_way() -> None:
    config = replace(PRESETS["moderate-odometry"], duration_s=300.0, odometry_translation=0.2)
    plant = _plant(config)
    T = camera_path(config, plant, np.arange(config.n_frames) / config.fps, rng=np.random.default_rng(0))
    hand_eye = mount_camera(config, rng=np.random.default_rng(1))
    drifted = measured_poses(config, T, hand_eye, rng=np.random.default_rng(2))
    np.testing.assert_array_equal(drifted[0], T[0])
    true, given = inverse(T[:-1]) @ T[1:], inverse(drifted[:-1]) @ drifted[1:]
    error = se3_log(inverse(true) @ given)
    way = np.linalg.norm(true[:, :3, 3], axis=1)
    sigma = np.sqrt(0.0005**2 + (0.2 * way) ** 2)
    assert (error[:, 3:] / sigma[:, None]).std() == pytest.approx(1.0, rel=4 / np.sqrt(6 * len(way)))
    assert np.linalg.norm(drifted[-1, :3, 3] - T[-1, :3, 3]) > 10 * 0.0005
