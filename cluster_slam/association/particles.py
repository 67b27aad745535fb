"""Association with poses that drift: many hypotheses, each with a map of its own (Rao-Blackwellised particles).

Dead reckoning cannot be trusted for longer than a few seconds, so an observation is compared with where the landmarks
are as seen from an *estimated* pose. Which landmark it is stays a matter of chance while it is uncertain: every
particle draws its own association, and the particles whose choice later observations contradict die out.
Montemerlo et al., "FastSLAM 2.0" (2003): poses are drawn from their posterior given the frame's observations,
associations by their likelihood (section 4 of the thesis of Montemerlo, 2003).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.frames import Frames, chi2_and_log_det, information
from cluster_slam.config import ParticleConfig
from cluster_slam.geometry import Array, inverse, rotate_cov, se3_exp, skew, transform
from cluster_slam.records import IntArray


@dataclass(frozen=True, slots=True, eq=False)
class SequentialMap:
    """Of the best particle: camera poses (n, 4, 4), landmark of each observation (m,), and places (l, 3)."""

    T: Array
    landmark: IntArray
    places: Array


class _Particles:
    """p particles: poses (p, 4, 4), maps (p, l, 3) with (p, l, 3, 3), and what each decided so far."""

    def __init__(self, n: int, T: Array, n_observations: int, n_frames: int) -> None:
        self.T = np.tile(T, (n, 1, 1))
        self.places = np.zeros((n, 0, 3))
        self.covs = np.zeros((n, 0, 3, 3))
        self.exists = np.zeros((n, 0), dtype=bool)
        self.log_weight = np.zeros(n)
        self.labels = np.full((n, n_observations), -1, dtype=np.int32)
        self.path = np.zeros((n, n_frames, 4, 4))

    def __len__(self) -> int:
        return len(self.T)

    def resample(self, rng: np.random.Generator, least_share: float) -> None:
        """Systematic resampling when fewer than a share of the particles carry weight."""
        w = np.exp(self.log_weight - self.log_weight.max())
        w /= w.sum()
        if 1.0 / (w * w).sum() > least_share * len(w):
            return
        ends = np.minimum(np.cumsum(w), 1.0)
        kept = np.searchsorted(ends, (np.arange(len(w)) + rng.random()) / len(w)).clip(max=len(w) - 1)
        for name in ("T", "places", "covs", "exists", "labels", "path"):
            setattr(self, name, getattr(self, name)[kept])
        self.log_weight = np.zeros(len(w))

    def room_for(self, slot: IntArray) -> None:
        """Make sure that landmark slots up to the largest asked for exist."""
        missing = int(slot.max(initial=-1)) + 1 - self.places.shape[1]
        if missing > 0:
            p = len(self)
            self.places = np.concatenate([self.places, np.zeros((p, missing, 3))], axis=1)
            self.covs = np.concatenate([self.covs, np.tile(np.eye(3), (p, missing, 1, 1))], axis=1)
            self.exists = np.concatenate([self.exists, np.zeros((p, missing), dtype=bool)], axis=1)


def map_with_particles(
    frames: Frames, given: Array, cov_step: Array, config: ParticleConfig, *, rng: np.random.Generator
) -> SequentialMap:
    """Go through the session once with many hypotheses.

    Parameters
    ----------
    frames : Frames
    given : (n, 4, 4) camera poses by odometry; the first defines the world.
    cov_step : (n - 1, 6, 6) of each step, tangent at its end.
    config : options.
    rng : for the draws.
    """
    particles = _Particles(config.n_particles, given[0], len(frames), frames.n_frames)
    for i in range(frames.n_frames):
        mean, cov = particles.T, np.tile(1e-12 * np.eye(6), (len(particles), 1, 1))
        if i:
            mean = mean @ (inverse(given[i - 1]) @ given[i])
            factor = rng.choice(config.odometry_factors, size=len(particles), p=config.odometry_shares)
            cov = cov_step[i - 1] * factor[:, None, None] ** 2
        _observe(particles, frames, i, mean, cov, config, rng)
        particles.path[:, i] = particles.T
        particles.resample(rng, config.least_share)
    best = int(particles.log_weight.argmax())
    return SequentialMap(
        particles.path[best], particles.labels[best].astype(np.int64), particles.places[best, particles.exists[best]]
    )


def _observe(
    particles: _Particles,
    frames: Frames,
    i: int,
    mean: Array,
    cov: Array,
    config: ParticleConfig,
    rng: np.random.Generator,
) -> None:
    """Associate the frame's points in every particle, draw the pose from its posterior, and update the maps."""
    here = frames.of(i)
    c, C = frames.points[here], frames.covs[here]
    p = len(particles)
    chosen = np.full((p, len(c)), -1)
    taken = np.zeros((p, particles.places.shape[1]), dtype=bool)
    for k in range(len(c)):
        slot, log_likelihood, mean, cov = _draw_association(particles, mean, cov, c[k], C[k], taken, config, rng)
        particles.log_weight += log_likelihood
        chosen[:, k] = slot
        known = slot >= 0
        taken[np.flatnonzero(known), slot[known]] = True
    root = np.linalg.cholesky(cov + 1e-18 * np.eye(6))
    particles.T = mean @ se3_exp((root @ rng.standard_normal((p, 6, 1)))[..., 0])
    for k in range(len(c)):
        _update_maps(particles, chosen[:, k], c[k], C[k], here.start + k)


def _draw_association(
    particles: _Particles,
    mean: Array,
    cov: Array,
    c: Array,
    C: Array,
    taken: Array,
    config: ParticleConfig,
    rng: np.random.Generator,
) -> tuple[IntArray, Array, Array, Array]:
    """Landmark of one point in each particle (-1 new), log-likelihoods (p,), and the poses' updated mean and cov."""
    p, n = particles.places.shape[:2]
    R, t = mean[:, :3, :3], mean[:, :3, 3]
    h = (particles.places - t[:, None]) @ R  # (p, l, 3) in the camera
    J = np.concatenate([skew(h), np.broadcast_to(-np.eye(3), (p, n, 3, 3))], axis=-1)
    own = rotate_cov(np.swapaxes(R, 1, 2)[:, None], particles.covs) + C
    S = J @ cov[:, None] @ np.swapaxes(J, -1, -2) + own
    chi2, log_det = chi2_and_log_det(c - h, S)
    log_p = np.where(particles.exists & ~taken & (chi2 < config.gate_chi2), -0.5 * (chi2 + log_det), -np.inf)
    _, log_det_new = chi2_and_log_det(np.zeros(3), C)
    log_new = np.full((p, 1), -0.5 * (config.new_chi2 + log_det_new))
    all_p = np.concatenate([log_p, log_new], axis=1)
    top = all_p.max(axis=1, keepdims=True)
    weights = np.exp(all_p - top)
    total = weights.sum(axis=1, keepdims=True)
    slot = (np.cumsum(weights, axis=1) < rng.random((p, 1)) * total).sum(axis=1)
    known = slot < n
    slot = np.where(known, slot, -1)
    rows = np.flatnonzero(known)
    if len(rows):
        j = slot[rows]
        Jj, Sj = J[rows, j], S[rows, j]
        gain = cov[rows] @ np.swapaxes(Jj, 1, 2) @ information(Sj)
        mean, cov = mean.copy(), cov.copy()
        mean[rows] = mean[rows] @ se3_exp((gain @ (c - h[rows, j])[..., None])[..., 0])
        reduced = cov[rows] - gain @ Jj @ cov[rows]
        cov[rows] = 0.5 * (reduced + np.swapaxes(reduced, 1, 2))
    return slot, (top + np.log(total))[:, 0], mean, cov


def _update_maps(particles: _Particles, slot: IntArray, c: Array, C: Array, observation: int) -> None:
    """Kalman update of the chosen landmark in each particle, its pose taken as known; -1 founds one."""
    rows = np.arange(len(particles))
    new = slot < 0
    slot = np.where(new, particles.exists.sum(axis=1), slot)
    particles.room_for(slot)
    w = transform(particles.T, np.broadcast_to(c, (len(rows), 3)))
    W = rotate_cov(particles.T[:, :3, :3], C)
    P, place = particles.covs[rows, slot], particles.places[rows, slot]
    gain = P @ information(P + W)
    updated = P - gain @ P
    particles.places[rows, slot] = np.where(new[:, None], w, place + (gain @ (w - place)[..., None])[..., 0])
    particles.covs[rows, slot] = np.where(new[:, None, None], W, 0.5 * (updated + np.swapaxes(updated, 1, 2)))
    particles.exists[rows, slot] = True
    particles.labels[:, observation] = slot
