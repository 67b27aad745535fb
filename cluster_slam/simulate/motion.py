"""How the clusters move: sway after touches, a little at all times, slow growth."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, so3_exp
from cluster_slam.simulate.config import SimulateConfig
from cluster_slam.simulate.plant import Plant

_AMBIENT_TIME_S = 0.3  # correlation time of the small sway
_BEFORE_S = 3.0  # touches from so long before the first frame may still be felt
_ALONG_STEM = 0.2  # how much of a push along the stem gets through


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Displacement of each cluster's centroid from rest, and its turn about it."""

    displacements: Array  # (n, c, 3) m, world
    rotations: Array | None  # (n, c, 3) rotation vectors, world; None: no cluster turns


@dataclass(frozen=True, slots=True, eq=False)
class _Oscillators:
    omega: Array  # (c,) damped angular frequency, rad/s
    decay: Array  # (c,) 1/s
    peak: Array  # (c,) largest value of exp(-decay t) sin(omega t)


def move(config: SimulateConfig, plant: Plant, times: Array, *, rng: np.random.Generator) -> Motion:
    """Displacements of all clusters at the given times (n,), seconds from the start."""
    touch_rng, ambient_rng, growth_rng = rng.spawn(3)
    sway = _sway(config, plant, times, touch_rng)
    rotations = None
    if config.sway_rotation_rad > 0.0 and config.sway_m > 0.0:
        rotations = _turn(plant, sway) * (config.sway_rotation_rad / config.sway_m)
    ambient = _ambient(config, len(plant.centroids), times, ambient_rng)
    growth = growth_rng.normal([0.0, 0.0, 0.7], 0.5, (len(plant.centroids), 3)) * config.growth_m_per_s
    return Motion(sway + ambient + times[:, None, None] * growth, rotations)


def flower_positions(plant: Plant, motion: Motion) -> Array:
    """Flowers (n, f, 3) in the world at each time."""
    cluster = plant.flower_cluster
    offsets = plant.flowers - plant.centroids[cluster]
    moved = plant.flowers + motion.displacements[:, cluster]
    if motion.rotations is None:
        return moved
    R = so3_exp(motion.rotations)
    turned: Array = moved - offsets + (R[:, cluster] @ offsets[:, :, None])[..., 0]
    return turned


def _sway(config: SimulateConfig, plant: Plant, times: Array, rng: np.random.Generator) -> Array:
    """Sum of damped oscillations, one a touch and cluster; its norm never exceeds ``sway_m``."""
    oscillators = _oscillators(config, plant, rng)
    sway = np.zeros((len(times), len(plant.centroids), 3))
    envelope = np.zeros(len(plant.centroids))  # bound of what earlier touches left, at the time of the last
    before = -_BEFORE_S
    for start in _touch_times(config, rng):
        envelope = envelope * np.exp(-oscillators.decay * (start - before))
        push = _push(config, plant, rng)
        size = np.linalg.norm(push, axis=1)
        allowed = np.minimum(size, np.maximum(config.sway_m - envelope, 0.0))
        push *= (allowed / np.maximum(size, 1e-12))[:, None]
        sway += _ring(oscillators, times - start)[..., None] * push
        envelope = envelope + allowed / oscillators.peak
        before = start
    return sway


def _touch_times(config: SimulateConfig, rng: np.random.Generator) -> Array:
    """Poisson times of touches, s, from a little before the first frame: a plant need not be calm at the start."""
    span = config.duration_s + _BEFORE_S
    return np.sort(rng.uniform(-_BEFORE_S, config.duration_s, rng.poisson(config.touches_per_minute * span / 60.0)))


def _oscillators(config: SimulateConfig, plant: Plant, rng: np.random.Generator) -> _Oscillators:
    """Clusters on one stem have like frequencies; no two have the same."""
    low, high = config.sway_frequency_min_hz, config.sway_frequency_max_hz
    stem_hz = rng.uniform(low, high, len(plant.stems))
    n = len(plant.centroids)
    omega_0 = 2 * np.pi * np.clip(stem_hz[plant.stem_ids] * rng.uniform(0.8, 1.25, n), low, high)
    zeta = rng.uniform(config.damping_min, config.damping_max, n)
    omega = omega_0 * np.sqrt(1 - zeta**2)
    decay = zeta * omega_0
    t_peak = np.arctan2(omega, decay) / omega
    return _Oscillators(omega, decay, np.exp(-decay * t_peak) * np.sin(omega * t_peak))


def _ring(oscillators: _Oscillators, since: Array) -> Array:
    """Answer (n, c) to a velocity impulse at since = 0, with peak 1."""
    t = np.maximum(since, 0.0)[:, None]
    answer: Array = np.exp(-oscillators.decay * t) * np.sin(oscillators.omega * t) / oscillators.peak
    return answer


def _push(config: SimulateConfig, plant: Plant, rng: np.random.Generator) -> Array:
    """Peak displacements (c, 3) that one touch gives: largest where it strikes, mostly across the stem."""
    n = len(plant.centroids)
    place = plant.centroids[rng.integers(n)] + rng.normal(0.0, 0.05 * config.scale, 3)
    away = np.linalg.norm(plant.centroids - place, axis=1) / (config.touch_reach_m * config.scale)
    size = config.sway_m * rng.uniform(0.6, 1.0) * np.exp(-0.5 * away**2) * rng.uniform(0.7, 1.0, n)
    direction = rng.normal(size=3)
    direction = direction / np.linalg.norm(direction) + rng.normal(0.0, 0.2, (n, 3))
    direction -= (1 - _ALONG_STEM) * (direction * plant.tangents).sum(1, keepdims=True) * plant.tangents
    push: Array = size[:, None] * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    return push


def _turn(plant: Plant, sway: Array) -> Array:
    """Axis of the turn times the displacement: the cluster tips over in the direction of its sway."""
    out = plant.centroids - plant.attachments
    out = out / np.linalg.norm(out, axis=1, keepdims=True)
    turn: Array = np.cross(out, sway)
    return turn


def _ambient(config: SimulateConfig, n: int, times: Array, rng: np.random.Generator) -> Array:
    """Ornstein-Uhlenbeck process (len(times), n, 3), stationary, sampled exactly."""
    keep = np.exp(-np.diff(times, prepend=times[0] - 1e9) / _AMBIENT_TIME_S)
    steps: Array = rng.normal(size=(len(times), n, 3)) * (config.ambient_sway_m * np.sqrt(1 - keep**2))[:, None, None]
    for i in range(1, len(times)):
        steps[i] += keep[i] * steps[i - 1]
    return steps
