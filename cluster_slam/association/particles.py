"""A stretch of a session with poses that drift, gone through with many hypotheses (Rao-Blackwellised particles).

Which landmark a point is stays a matter of chance while it is uncertain: every particle draws its own association, and
those that later points contradict die out. Poses are drawn from their posterior given the frame's points (Montemerlo
et al., "FastSLAM 2.0", 2003), associations by their likelihood, odometry errors from Student's t. They all
start at one smoothed estimate, so that they need to last for a stretch only.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.association.drift_smoother import Steps
from cluster_slam.association.frames import Frames, chi2_and_log_det, information
from cluster_slam.config import ParticleConfig
from cluster_slam.geometry import Array, rotate_cov, se3_exp, skew, transform
from cluster_slam.records import IntArray

_LOG_2PI_3 = 1.5 * np.log(2.0 * np.pi)
_ROOM = 6  # landmark slots that are added at a time


@dataclass(frozen=True, slots=True, eq=False)
class Stretch:
    """Of the best particle: poses (k, 4, 4), landmark of each point (q,), and all places (l, 3), new ones last."""

    T: Array
    label: IntArray
    places: Array


class _Particles:
    """p particles: poses (p, 4, 4), maps (p, l, 3) with (p, l, 3, 3), and how sure each landmark's existence is."""

    def __init__(self, n: int, T: Array, places: Array, covs: Array) -> None:
        self.T = np.tile(T, (n, 1, 1))
        self.places, self.covs = np.tile(places, (n, 1, 1)), np.tile(covs, (n, 1, 1, 1))
        self.existence = np.ones((n, len(places)))
        self.count = np.full(n, len(places))
        self.log_weight = np.zeros(n)
        self.make_room()

    def make_room(self) -> None:
        n = len(self.T)
        self.places = np.concatenate([self.places, np.zeros((n, _ROOM, 3))], axis=1)
        self.covs = np.concatenate([self.covs, np.tile(np.eye(3), (n, _ROOM, 1, 1))], axis=1)
        self.existence = np.concatenate([self.existence, np.zeros((n, _ROOM))], axis=1)

    def resample(self, rng: np.random.Generator) -> IntArray:
        """Systematic resampling when fewer than half of the particles carry weight; the parents (p,)."""
        n = len(self.T)
        w = np.exp(self.log_weight - self.log_weight.max())
        w /= w.sum()
        if 1.0 / (w * w).sum() >= 0.5 * n:
            return np.arange(n)
        ends = np.minimum(np.cumsum(w), 1.0)
        kept = np.searchsorted(ends, (np.arange(n) + rng.random()) / n).clip(max=n - 1)
        for name in ("T", "places", "covs", "existence", "count"):
            setattr(self, name, getattr(self, name)[kept])
        self.log_weight = np.zeros(n)
        return kept


def view_cells(frames: Frames) -> float:
    """The space (m^3) in which points are seen; across a direction in which all agree, as wide as their noise."""
    low, high = np.quantile(frames.points, [0.01, 0.99], axis=0)
    noise = np.sqrt(2.0 * np.pi * np.median(np.einsum("nii->ni", frames.covs), axis=0))
    return float(np.prod(np.maximum(high - low, noise)))


def trace_stretch(
    frames: Frames,
    steps: Steps,
    span: tuple[int, int],
    start: Array,
    places: Array,
    covs: Array,
    n_particles: int,
    config: ParticleConfig,
    *,
    rng: np.random.Generator,
) -> Stretch:
    """Associate the frames ``span`` (from, to), starting at the pose (4, 4) of the frame before (or of frame 0).

    ``places`` (l, 3) with ``covs`` (l, 3, 3) are the landmarks known so far.
    """
    from scipy.stats import chi2

    first, end = span
    particles = _Particles(n_particles, start, places, covs)
    background = np.log((config.clutter_share + config.new_share) / view_cells(frames))
    d = steps.basis.shape[1]
    grid = (np.arange(n_particles) + 0.5) / n_particles
    quantiles: dict[float, Array] = {}
    parents, paths, choices = [], [], []
    for i in range(first, end):
        mean, cov = particles.T, np.tile(1e-12 * np.eye(d), (n_particles, 1, 1))
        if i:
            dof = float(steps.dof[i - 1])
            if dof not in quantiles:
                quantiles[dof] = dof / chi2.ppf(grid, dof)
            factor = rng.permutation(quantiles[dof])
            mean, cov = mean @ steps.motion[i - 1], steps.cov[i - 1] * factor[:, None, None]
        choices.append(_observe(particles, frames, i, mean, cov, steps.basis, background, config, rng))
        paths.append(particles.T)
        parents.append(particles.resample(rng))
    best = int(particles.log_weight.argmax())
    found = particles.places[best, : particles.count[best]]
    T = np.empty((end - first, 4, 4))
    labels = []
    for k in range(end - first - 1, -1, -1):
        best = int(parents[k][best])
        T[k] = paths[k][best]
        labels.append(choices[k][best])
    label = np.concatenate(labels[::-1]) if labels else np.empty(0, dtype=np.int64)
    return Stretch(T, label, found)


def _observe(
    particles: _Particles,
    frames: Frames,
    i: int,
    mean: Array,
    cov: Array,
    basis: Array,
    background: float,
    config: ParticleConfig,
    rng: np.random.Generator,
) -> IntArray:
    """Associate the frame's points (p, q) in every particle, draw the pose from its posterior, update the maps."""
    here = frames.of(i)
    c, C = frames.points[here], frames.covs[here]
    p = len(particles.T)
    chosen, wide = np.full((p, len(c)), -1), np.zeros((p, len(c)), dtype=bool)
    taken = np.zeros(particles.existence.shape, dtype=bool)
    for k in range(len(c)):
        slot, wide[:, k], mean, cov = _draw(particles, mean, cov, basis, c[k], C[k], taken, background, config, rng)
        chosen[:, k] = slot
        known = np.flatnonzero(slot >= 0)
        taken[known, slot[known]] = True
    root = np.linalg.cholesky(cov + 1e-14 * np.eye(cov.shape[1]))
    drawn = (root @ rng.standard_normal((p, cov.shape[1], 1)))[..., 0]
    particles.T = mean @ se3_exp(drawn @ basis.T)
    for k in range(len(c)):
        factor = np.where(wide[:, k], config.wide**2, 1.0)
        chosen[:, k] = _update_maps(particles, chosen[:, k], c[k], C[k], factor, config)
    return chosen


def _draw(
    particles: _Particles,
    mean: Array,
    cov: Array,
    basis: Array,
    c: Array,
    C: Array,
    taken: Array,
    background: float,
    config: ParticleConfig,
    rng: np.random.Generator,
) -> tuple[IntArray, Array, Array, Array]:
    """Landmark of one point in each particle (-1 none), whether it fits badly, and the poses' updated mean and cov.

    The options are: each landmark, with the stated noise or with ``wide`` times that, and clutter or a new landmark.
    """
    p, n = particles.existence.shape
    R, t = mean[:, :3, :3], mean[:, :3, 3]
    h = (particles.places - t[:, None]) @ R
    error = c - h
    reach_sq = 36.0 * (
        4.0 * np.trace(C) + (np.einsum("pii->p", cov) * (1.0 + c @ c))[:, None] + np.einsum("plii->pl", particles.covs)
    )
    r, j = np.nonzero((particles.existence > 0) & np.logical_not(taken) & ((error * error).sum(-1) < reach_sq))
    eye = np.broadcast_to(np.eye(3), (len(r), 3, 3))
    J = np.concatenate([skew(h[r, j]), -eye], axis=-1) @ basis
    own = J @ cov[r] @ np.swapaxes(J, 1, 2) + rotate_cov(np.swapaxes(R[r], 1, 2), particles.covs[r, j])
    log_p = np.full((p, 2 * n + 1), -np.inf)
    S = np.stack([own + C, own + config.wide**2 * C])
    for column, share, cov_innovation in ((0, 1.0 - config.wide_share, S[0]), (n, config.wide_share, S[1])):
        chi2, log_det = chi2_and_log_det(error[r, j], cov_innovation)
        log_p[r, column + j] = np.log(share * particles.existence[r, j]) - 0.5 * (chi2 + log_det) - _LOG_2PI_3
    log_p[:, -1] = background
    top = log_p.max(axis=1, keepdims=True)
    sums = np.cumsum(np.exp(log_p - top), axis=1)
    particles.log_weight = particles.log_weight + (top + np.log(sums[:, -1:]))[:, 0]
    option = (sums < rng.random((p, 1)) * sums[:, -1:]).sum(axis=1)
    wide = (option >= n) & (option < 2 * n)
    slot = np.where(option < 2 * n, option % n, -1)
    rows = np.flatnonzero(slot >= 0)
    if len(rows):
        index = np.full((p, n), -1)
        index[r, j] = np.arange(len(r))
        q = index[rows, slot[rows]]
        gain = cov[rows] @ np.swapaxes(J[q], 1, 2) @ information(S[wide[rows].astype(int), q])
        mean, cov = mean.copy(), cov.copy()
        moved = (gain @ error[rows, slot[rows]][..., None])[..., 0]
        mean[rows] = mean[rows] @ se3_exp(moved @ basis.T)
        reduced = cov[rows] - gain @ J[q] @ cov[rows]
        cov[rows] = 0.5 * (reduced + np.swapaxes(reduced, 1, 2))
    return slot, wide, mean, cov


def _update_maps(
    particles: _Particles, slot: IntArray, c: Array, C: Array, factor: Array, config: ParticleConfig
) -> IntArray:
    """Kalman update of the chosen landmark in each particle, its pose taken as known; -1 founds one. Slots (p,)."""
    rows = np.arange(len(slot))
    new = slot < 0
    if new.any() and particles.count.max() + 1 >= particles.existence.shape[1]:
        particles.make_room()
    slot = np.where(new, particles.count, slot)
    w = transform(particles.T, np.broadcast_to(c, (len(rows), 3)))
    W = rotate_cov(particles.T[:, :3, :3], C)
    P, place = particles.covs[rows, slot], particles.places[rows, slot]
    gain = P @ information(P + W * factor[:, None, None])
    updated = P - gain @ P
    particles.places[rows, slot] = np.where(new[:, None], w, place + (gain @ (w - place)[..., None])[..., 0])
    particles.covs[rows, slot] = np.where(new[:, None, None], W, 0.5 * (updated + np.swapaxes(updated, 1, 2)))
    existence = config.new_share / (config.new_share + config.clutter_share)
    particles.existence[rows, slot] = np.where(new, existence, 1.0)
    particles.count = particles.count + new
    return slot
