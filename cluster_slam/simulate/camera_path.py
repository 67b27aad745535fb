"""The camera's path, and what the robot says about it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, inverse, se3_exp, se3_log, so3_exp
from cluster_slam.simulate.config import SimulateConfig
from cluster_slam.simulate.plant import Plant

_SWEEP_HZ = 0.07  # slowest part of the sweep: one pass over the row and back in 14 s
_MARGIN_M = 0.05  # the view wanders at least this far about the clusters


@dataclass(frozen=True, slots=True, eq=False)
class HandEye:
    """Where the camera is on the flange, and where it is said to be."""

    true: Array  # (4, 4)
    measured: Array  # (4, 4)


def camera_path(config: SimulateConfig, plant: Plant, times: Array, *, rng: np.random.Generator) -> Array:
    """True ``T_world_camera`` (n, 4, 4): a smooth sweep that looks at the plant and turns, slower than the limit."""
    phases = rng.uniform(0.0, 2 * np.pi, (7, 3))
    fine = np.arange(0.0, max(times[-1], 1.0), 0.02)
    positions = _poses(config, plant, fine, phases)[:, :3, 3]
    speed = np.linalg.norm(np.diff(positions, axis=0), axis=1).max() / 0.02
    return _poses(config, plant, times * min(1.0, 0.98 * config.max_speed_m_per_s / speed), phases)


def _poses(config: SimulateConfig, plant: Plant, times: Array, phases: Array) -> Array:
    waves = _waves(times, phases)
    low, high = plant.centroids.min(0), plant.centroids.max(0)
    reach = np.maximum((high - low) / 2, _MARGIN_M * config.scale) * [1.15, 0.3, 1.0]
    target = (low + high) / 2 + waves[:, :3] * reach
    azimuth, elevation = config.turn_rad * waves[:, 3], 0.15 + 0.6 * config.turn_rad * waves[:, 4]
    distance = (config.distance_min_m + (0.5 + 0.5 * waves[:, 5]) * _span(config)) * config.scale
    back = np.stack(
        [np.sin(azimuth) * np.cos(elevation), -np.cos(azimuth) * np.cos(elevation), np.sin(elevation)], axis=1
    )
    return _look(target + distance[:, None] * back, -back, config.turn_rad * waves[:, 6])


def _span(config: SimulateConfig) -> float:
    return config.distance_max_m - config.distance_min_m


def _waves(times: Array, phases: Array) -> Array:
    """Seven smooth signals (n, 7) within -1 and 1: sums of three sines that never repeat together."""
    hz = _SWEEP_HZ * np.array([1.0, 1.618, 2.718]) * np.linspace(0.9, 1.3, 7)[:, None]
    sines = np.sin(2 * np.pi * hz * times[:, None, None] + phases)
    waves: Array = sines @ np.array([0.6, 0.25, 0.15])
    return waves


def _look(positions: Array, forward: Array, roll: Array) -> Array:
    """Camera poses (n, 4, 4) at positions, looking forward, rolled about the optical axis from upright."""
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (len(positions), 1, 1))
    upright = np.stack([right, np.cross(forward, right), forward], axis=2)
    T[:, :3, :3] = upright @ so3_exp(roll[:, None] * np.array([0.0, 0.0, 1.0]))
    T[:, :3, 3] = positions
    return T


def mount_camera(config: SimulateConfig, *, rng: np.random.Generator) -> HandEye:
    """A camera on a bracket, and its transform measured with an error of exactly the configured norms."""
    true = se3_exp(np.concatenate([rng.normal([0.0, 0.0, np.pi / 2], 0.1), rng.normal([0.0, -0.06, 0.04], 0.01)]))
    error = rng.normal(size=(2, 3))
    error /= np.linalg.norm(error, axis=1, keepdims=True)
    measured = true.copy()
    measured[:3, :3] = true[:3, :3] @ so3_exp(config.hand_eye_rotation * error[0])
    measured[:3, 3] += config.hand_eye_translation * error[1]
    return HandEye(true, measured)


def measured_poses(
    config: SimulateConfig, T_world_camera: Array, hand_eye: HandEye, *, rng: np.random.Generator
) -> Array:
    """The poses (n, 4, 4) that are written: of the flange or of the camera, with their errors."""
    is_flange = config.pose_frame == "T_world_flange"
    poses = T_world_camera @ inverse(hand_eye.true) if is_flange else T_world_camera
    normal = rng.normal(size=(len(poses), 6))
    if config.pose_error == "odometry":
        return _odometry(config, poses, normal)
    sigma = np.repeat([config.pose_rotation, config.pose_translation], 3)
    noisy: Array = poses @ se3_exp(normal * sigma)
    return noisy


def _odometry(config: SimulateConfig, poses: Array, normal: Array) -> Array:
    """Poses whose steps err: a part that is always there and one that grows with the way, in quadrature."""
    steps = inverse(poses[:-1]) @ poses[1:]
    way = se3_log(steps).reshape(-1, 2, 3)
    turned, travelled = np.linalg.norm(way, axis=2).T
    sigma_r = np.hypot(config.pose_rotation, config.odometry_rotation * turned)
    sigma_t = np.hypot(config.pose_translation, config.odometry_translation * travelled)
    steps = steps @ se3_exp(normal[1:] * np.repeat(np.stack([sigma_r, sigma_t], axis=1), 3, axis=1))
    out = poses.copy()
    for i, step in enumerate(steps):
        out[i + 1] = out[i] @ step
    return out
