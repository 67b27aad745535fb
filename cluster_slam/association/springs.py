"""State of clusters that sway: displacement from rest and velocity, a noisy spring each."""

from __future__ import annotations

import numpy as np

from cluster_slam.association.frames import information
from cluster_slam.config import TemplateConfig
from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, IntArray

REST_SIGMA_M = 0.001  # how far a cluster at rest may be from it


class Springs:
    """Displacement and velocity ``x`` (s, 6) with ``P`` (s, 6, 6) of all clusters in all lanes, lane by lane."""

    def __init__(self, n_lanes: int, n_clusters: int, config: TemplateConfig) -> None:
        self.config, self.n_clusters = config, n_clusters
        n = n_lanes * n_clusters
        self.x = np.zeros((n, 6))
        self.P = np.zeros((n, 6, 6))
        self.unseen_s = np.zeros(n)
        self.reset(np.ones(n, dtype=bool))

    def reset(self, which: BoolArray) -> None:
        """Back to rest."""
        sigma = np.repeat([REST_SIGMA_M, REST_SIGMA_M * 2 * np.pi * self.config.sway_hz], 3)
        self.x[which] = 0.0
        self.P[which] = np.diag(sigma**2)

    def predict(self, dt: Array) -> None:
        """On by a time (lanes,) of each lane's own, s."""
        c = self.config
        omega = 2 * np.pi * c.sway_hz
        cos, sin = np.cos(omega * dt), np.sin(omega * dt)
        F = _blocks(cos, sin / omega, -omega * sin, cos)
        Q = _blocks(dt**4 / 4, dt**3 / 2, dt**3 / 2, dt**2)
        shape = (len(dt), self.n_clusters)
        x, P = self.x.reshape(*shape, 6), self.P.reshape(*shape, 6, 6)
        amplitude = np.sqrt((x[..., :3] ** 2).sum(-1) + (x[..., 3:] ** 2).sum(-1) / omega**2)
        accel_var = (c.rest_accel + c.sway_spread * omega**2 * amplitude) ** 2
        x = x @ np.swapaxes(F, -1, -2)
        P = F[:, None] @ P @ np.swapaxes(F, -1, -2)[:, None] + accel_var[..., None, None] * Q[:, None]
        cap = np.maximum(amplitude, c.jump_sigma_m)[..., None] * np.repeat([1.0, omega], 3)
        shrink = np.minimum(1.0, cap / np.sqrt(np.diagonal(P, axis1=-2, axis2=-1)))
        P *= shrink[..., :, None] * shrink[..., None, :]
        self.x, self.P = x.reshape(-1, 6), P.reshape(-1, 6, 6)
        self.unseen_s += np.repeat(dt, self.n_clusters)

    def update(self, rows: IntArray, mean: Array, cov: Array) -> None:
        """Measured displacements (q, 3) with (q, 3, 3) of clusters ``rows``."""
        P = self.P[rows]
        gain = P[:, :, :3] @ information(P[:, :3, :3] + cov)
        self.x[rows] += (gain @ (mean - self.x[rows, :3])[..., None])[..., 0]
        P = P - gain @ P[:, :3, :]
        self.P[rows] = 0.5 * (P + np.swapaxes(P, -1, -2))

    def jump(self, rows: IntArray, d: Array, cov: Array) -> None:
        """Clusters ``rows`` are elsewhere than predicted: displacements (q, 3) with (q, 3, 3), velocities unknown."""
        self.x[rows, :3], self.x[rows, 3:] = d, 0.0
        self.P[rows] = 0.0
        self.P[rows, :3, :3] = cov
        self.P[rows, 3:, 3:] = self.config.jump_speed**2 * np.eye(3)


def _blocks(a: Array, b: Array, c: Array, d: Array) -> Array:
    """Matrices (lanes, 6, 6) of four blocks, each a multiple (lanes,) of the 3 x 3 identity."""
    M = np.stack([np.stack([a, b], axis=-1), np.stack([c, d], axis=-1)], axis=-2)
    return np.asarray(np.einsum("lij,ab->liajb", M, np.eye(3)).reshape(len(a), 6, 6))
