"""How a group of points that hangs on something moves: at rest, swaying, or growing away. States and their noise.

The state is ``[c (3), v (3), g, w, e (3)]``: where the centroid is (m), its velocity (m/s), the log of the group's
scale relative to its rest shape, the logarithm of the angular frequency (rad/s) at which it sways, and how far (m) the
place about which it sways is from ``anchor`` (3,): a map says where it hangs, but what it learned of a group that it
has seen little of, and swinging, may be centimetres off. All functions take stacks of states (..., 11).
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum

import numpy as np

from tracking.gaussian import Array

N_STATES = 11


class MotionKind(Enum):
    """What a group is taken to be doing."""

    REST = "rest"  # trembles about its place
    SWAY = "sway"  # a damped oscillation about its place
    GROWTH = "growth"  # goes away from its place slowly and steadily


@dataclass(frozen=True, slots=True)
class MotionConfig:
    """Constants of the three models, each with its reason."""

    tremble_m: float = 0.0004  # one sigma an axis of a group at rest: air is never still
    tremble_s: float = 0.3  # time over which the trembling forgets
    sway_hz: float = 1.3  # centre of the natural frequencies of stems (0.5 to 3 Hz)
    sway_log_sigma: float = 0.5  # one sigma of its logarithm: the range above within two
    damping: float = 0.1  # share of critical damping, usual for plants in leaf
    sway_spread: float = 0.05  # share of the spring's acceleration that is unknown: damping wrong by half ...
    sway_accel: float = 0.05  # m/s^2, ... and gusts on a group that hardly moves; ``unrest`` makes both larger
    touch_speed: float = 0.25  # m/s, one sigma an axis of what a touch adds to the velocity
    growth_accel: float = 1e-5  # m/s^2, how quickly growth changes
    scale_walk: float = 0.002  # per sqrt(s), of the logarithm of scale
    frequency_walk: float = 0.05  # per sqrt(s), of the logarithm of frequency


def advance(x: Array, dt: float, anchor: Array, kind: MotionKind, config: MotionConfig) -> Array:
    """States (..., 11) after ``dt`` seconds, without noise.

    Sway is the exact solution of the damped oscillator d'' = -w0^2 d - 2 zeta w0 d' about anchor + e; rest forgets its
    displacement from the anchor within ``tremble_s``; growth goes straight on.
    """
    out = x.copy()
    if kind is MotionKind.GROWTH:
        out[..., :3] += x[..., 3:6] * dt
        return out
    v = x[..., 3:6]
    if kind is MotionKind.REST:
        out[..., :3] = anchor + (x[..., :3] - anchor) * np.exp(-dt / config.tremble_s)
        out[..., 3:6] = 0.0
        return out
    about = anchor + x[..., 8:11]
    d = x[..., :3] - about
    omega = np.exp(np.clip(x[..., 7:8], -3.0, 5.0))
    zeta = config.damping
    damped = omega * np.sqrt(1.0 - zeta * zeta)
    decay, sin, cos = np.exp(-zeta * omega * dt), np.sin(damped * dt), np.cos(damped * dt)
    lean = zeta * omega / damped * sin
    out[..., :3] = about + decay * ((cos + lean) * d + sin / damped * v)
    out[..., 3:6] = decay * ((cos - lean) * v - omega * omega / damped * sin * d)
    return out


def process_noise(
    x: Array, dt: float, anchor: Array, kind: MotionKind, config: MotionConfig, unrest: float = 1.0
) -> Array:
    """Covariance (11, 11) of what ``advance`` does not know, for one state (11,).

    ``unrest``: how many times larger than usual the unknown accelerations of sway have proved to be.
    """
    Q = np.zeros((N_STATES, N_STATES))
    Q[6, 6] = config.scale_walk**2 * dt
    Q[7, 7] = config.frequency_walk**2 * dt
    axes = np.arange(3)
    if kind is MotionKind.REST:
        Q[axes, axes] = config.tremble_m**2 * (1.0 - np.exp(-2.0 * dt / config.tremble_s))
        Q[axes + 3, axes + 3] = (config.tremble_m / config.tremble_s) ** 2
        return Q
    accel = config.growth_accel
    if kind is MotionKind.SWAY:
        accel = unrest * np.hypot(config.sway_accel, config.sway_spread * np.exp(2.0 * x[7]) * amplitude(x, anchor))
    q = accel * accel
    Q[axes, axes] = q * dt**4 / 3.0
    Q[axes, axes + 3] = Q[axes + 3, axes] = q * dt**3 / 2.0
    Q[axes + 3, axes + 3] = q * dt**2
    return Q


def touch_noise(dt: float, config: MotionConfig) -> Array:
    """Covariance (6, 6) that a touch within the last ``dt`` seconds adds to position and velocity.

    A velocity v ~ N(0, touch_speed^2) for a time t, uniform in (0, dt): E[t^2] = dt^2 / 3, E[t] = dt / 2.
    """
    cov = np.zeros((6, 6))
    axes, var = np.arange(3), config.touch_speed**2
    cov[axes, axes] = dt * dt / 3.0 * var
    cov[axes, axes + 3] = cov[axes + 3, axes] = dt / 2.0 * var
    cov[axes + 3, axes + 3] = var
    return cov


def amplitude(x: Array, anchor: Array) -> float:
    """How far (m) a state (11,) will swing: sqrt(|d|^2 + |v|^2 / w^2)."""
    d, v, omega = x[:3] - anchor - x[8:11], x[3:6], np.exp(x[7])
    return float(np.sqrt(d @ d + (v @ v) / (omega * omega)))


def state_at_rest(anchor: Array, config: MotionConfig) -> tuple[Array, Array]:
    """State (11,) and covariance (11, 11) of a group of which nothing is known but that it hangs at ``anchor``."""
    x = np.zeros(N_STATES)
    x[:3] = anchor
    x[7] = np.log(2.0 * np.pi * config.sway_hz)
    speed = config.tremble_m / config.tremble_s
    sigma = [config.tremble_m] * 3 + [speed] * 3 + [0.02, config.sway_log_sigma] + [config.tremble_m] * 3
    return x, np.diag(np.square(sigma))
