"""A vehicle on a floor among landmarks on that floor: where it is follows over many frames, each shows hardly anything.

Particles over place, heading and which way up the map is seen (a map has two sides; only motion tells which), and over
what ranges are wrong by: a gain and an offset that stay, as the map holds true lengths. They begin everywhere that the
first point allows. Each point may be any landmark, or none; errors have heavy tails.
Thrun, Burgard, Fox, "Probabilistic Robotics" (2005), chapters 4 and 8; static parameters move a little, as Gordon,
Salmond and Smith (1993) proposed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, se3_log
from cluster_slam.localisation.landmarks import Landmarks
from cluster_slam.localisation.motion import Motion
from cluster_slam.localisation.planar import Flat
from cluster_slam.records import CLUTTER, IntArray, LostReason
from tracking.assignment import assign

_N_MOST, _N_LEAST = 30_000, 3_000  # particles while all is open, and when all but one place is out
_STEP_SCALE, _STEP_DOF = 1.5, 4.0  # odometry slips: its steps err by Student's t, wider than stated
_WIDE, _WIDE_SHARE = 4.0, 0.1  # points may also err so many times more, this share of them
_FALSE_SHARE = 0.03  # of the points
_NEAR = (2.0, 0.7)  # over the landmarks' usual spacing, and rad, about a mode: one place
_SURE = 0.99  # of the particles in one place
_LOST_POINTS, _LOST_SHARE = 15, 0.7  # of the last points no landmark's: all is open again
_GAIN, _OFFSET = 0.03, 0.05  # one sigma of what ranges err by for good: a share, and m ...
_WANDER = 0.02  # ... and how far they move with each frame, of that


@dataclass(frozen=True, slots=True, eq=False)
class FlatPlace:
    """Where a frame is."""

    reason: LostReason
    probability: float
    T_map_camera: Array  # (4, 4)
    cov: Array  # (6, 6)
    flower_ids: IntArray
    cluster_ids: IntArray


class FlatFollower:
    """A particle filter; frames in their order."""

    def __init__(self, flat: Flat, marks: Landmarks, motion: Motion, rng: np.random.Generator) -> None:
        self.flat, self.marks, self.motion, self.rng = flat, marks, motion, rng
        self.places = (marks.positions - flat.origin) @ flat.map[:, :2]
        apart = np.linalg.norm(self.places[:, None] - self.places, axis=2) + 1e9 * np.eye(len(marks))
        self.spacing = float(np.median(apart.min(0)))
        self.area = float(np.prod(np.ptp(self.places, axis=0) + 2.0 * self.spacing))
        self.state = np.zeros((0, 5))  # x, y, heading, gain and offset of ranges
        self.side = np.zeros(0)  # 1 or -1: which way up
        self.log_weight = np.zeros(0)
        self.frame = 0
        self._misses: list[float] = []

    def step(self, frame: int, points: Array, covs: Array, news: Array) -> FlatPlace:
        """The next frame, with points (n, 3), covariances (n, 3, 3), and what each counts for (n,)."""
        q = points @ self.flat.camera[:, :2]
        S = self.flat.camera[:, :2].T @ covs @ self.flat.camera[:, :2]
        if len(self.state) == 0 or (len(self._misses) >= _LOST_POINTS and np.mean(self._misses) > _LOST_SHARE):
            if len(q):
                self._begin(q[0], S[0])
        elif frame > self.frame:
            self._move(frame)
        self.frame = frame
        for k in range(len(q)):
            self._see(q[k], S[k], float(news[k]))
        if len(q):
            self._resample()
        return self._place(q, S)

    def _begin(self, q: Array, S: Array) -> None:
        """Everywhere that one point allows."""
        n, rng = _N_MOST, self.rng
        heading = rng.uniform(-np.pi, np.pi, n)
        side = rng.choice([-1.0, 1.0], n)
        ranging = rng.normal(size=(n, 2)) * [_GAIN, _OFFSET]
        seen = _ranged(q, ranging) + rng.normal(size=(n, 2)) @ np.linalg.cholesky(S).T
        mark = self.places[rng.integers(len(self.places), size=n)] * np.column_stack([np.ones(n), side])
        self.state = np.column_stack([mark - _turned(heading, seen), heading, ranging])
        self.side, self.log_weight, self._misses = side, np.zeros(n), []

    def _move(self, frame: int) -> None:
        step = self.motion.camera_step(self.frame, frame, None)
        cov = self.motion.step_cov(self.frame, frame)
        C, n = self.flat.camera, len(self.state)
        shift = C[:, :2].T @ step[:3, 3]
        turn = float(C[:, 2] @ se3_log(step)[:3])
        var = np.array([*np.diag(C[:, :2].T @ cov[3:, 3:] @ C[:, :2]), C[:, 2] @ cov[:3, :3] @ C[:, 2]])
        slip = 1.0 / np.sqrt(self.rng.chisquare(_STEP_DOF, (n, 2)) / _STEP_DOF)
        error = self.rng.normal(size=(n, 3)) * np.sqrt(var) * _STEP_SCALE * slip[:, [0, 0, 1]]
        self.state[:, :2] += _turned(self.state[:, 2], shift + error[:, :2])
        self.state[:, 2] += turn + error[:, 2]
        keep = np.sqrt(1.0 - _WANDER**2)
        self.state[:, 3:] = keep * self.state[:, 3:] + _WANDER * self.rng.normal(size=(n, 2)) * [_GAIN, _OFFSET]

    def _see(self, q: Array, S: Array, news: float) -> None:
        """Weigh all particles by one point, which counts as so much of an independent one."""
        close, total = self._densities(q, S)
        false = _FALSE_SHARE / self.area
        self.log_weight = self.log_weight + news * np.log((1.0 - _FALSE_SHARE) * total + false)
        w = self._weights()
        self._misses = [*self._misses[-(_LOST_POINTS - 1) :], float(w @ (close < 0.01))]

    def _densities(self, q: Array, S: Array) -> tuple[Array, Array]:
        """Of the point: the best landmark's fit (n,) in 0 to 1, and the density (n,) over all landmarks."""
        mirrored = self.places * np.array([1.0, -1.0])
        seen = self.state[:, :2] + _turned(self.state[:, 2], _ranged(q, self.state[:, 3:]))
        off = np.where(self.side[:, None, None] > 0, self.places, mirrored) - seen[:, None]
        c, s = np.cos(self.state[:, 2])[:, None], np.sin(self.state[:, 2])[:, None]
        x, y = c * off[..., 0] + s * off[..., 1], c * off[..., 1] - s * off[..., 0]
        L = np.linalg.cholesky(S)
        first = x / L[0, 0]
        d2 = (first**2 + ((y - L[1, 0] * first) / L[1, 1]) ** 2).astype(np.float32)
        peak = 1.0 / (2.0 * np.pi * L[0, 0] * L[1, 1])
        narrow, wide = np.exp(-0.5 * d2), np.exp(-0.5 * d2 / _WIDE**2)
        density = peak * ((1.0 - _WIDE_SHARE) * narrow.sum(1) + _WIDE_SHARE / _WIDE**2 * wide.sum(1)) / len(self.places)
        return wide.max(1), density

    def _weights(self) -> Array:
        w = np.exp(self.log_weight - self.log_weight.max())
        out: Array = w / w.sum()
        return out

    def _resample(self) -> None:
        w = self._weights()
        n = self._wanted(w)
        if 1.0 / (w @ w) > 0.5 * len(w) and n > 0.6 * len(w):
            return
        at = (self.rng.random() + np.arange(n)) / n
        pick = np.minimum(np.searchsorted(np.cumsum(w), at), len(w) - 1)
        self.state, self.side, self.log_weight = self.state[pick], self.side[pick], np.zeros(n)

    def _cells(self, size: float) -> IntArray:
        """Where each particle is (n, 4): cells of so many spacings and 0.3 rad, and the side."""
        place = np.floor(self.state[:, :3] / [size * self.spacing, size * self.spacing, 0.3])
        return np.column_stack([place, self.side]).astype(np.int64)

    def _wanted(self, w: Array) -> int:
        """How many particles are needed: by how many places are left."""
        left = len(np.unique(self._cells(0.3)[w > 0.01 / len(w)], axis=0))
        return int(np.clip(60 * left, _N_LEAST, _N_MOST))

    def _place(self, q: Array, S: Array) -> FlatPlace:
        none = np.full(len(q), CLUTTER)
        if len(self.state) == 0:
            return FlatPlace("too_few", 0.0, np.eye(4), np.eye(6), none, none.copy())
        w = self._weights()
        here = self._mode(w)
        share = float(w[here].sum())
        w = np.where(here, w, 0.0) / max(share, 1e-300)
        mean = w @ self.state
        mean[2] = np.angle(w @ np.exp(1j * self.state[:, 2]))
        off = (self.state - mean)[:, :3]
        off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
        side = 1.0 if w @ self.side > 0 else -1.0
        T, cov = self.flat.pose(mean[:3], side, (off * w[:, None]).T @ off)
        rows, marks = self._matches(q, S, mean, side)
        flowers, clusters = none, none.copy()
        flowers[rows], clusters[rows] = self.marks.flower_ids[marks], self.marks.cluster_ids[marks]
        reason: LostReason = "" if share >= _SURE else "ambiguous"
        return FlatPlace(reason, share, T, cov, flowers, clusters)

    def _mode(self, w: Array) -> Array:
        """Which particles (n,) are in the place where most are."""
        _, cell = np.unique(self._cells(0.5), axis=0, return_inverse=True)
        best = np.bincount(cell.ravel(), w).argmax()
        inside = cell.ravel() == best
        centre = np.average(self.state[inside, :2], axis=0, weights=w[inside] + 1e-300)
        heading = np.angle(np.exp(1j * self.state[inside, 2]) @ w[inside])
        near = np.linalg.norm(self.state[:, :2] - centre, axis=1) < _NEAR[0] * self.spacing
        turned = np.abs(np.angle(np.exp(1j * (self.state[:, 2] - heading)))) < _NEAR[1]
        out: Array = near & turned & (self.side == self.side[inside][0])
        return out

    def _matches(self, q: Array, S: Array, mean: Array, side: float) -> tuple[IntArray, IntArray]:
        seen = mean[:2] + _turned(np.full(len(q), mean[2]), _ranged(q, mean[3:]))
        off = seen[:, None] - self.places * np.array([1.0, side])
        sigma = np.sqrt(np.trace(S, axis1=1, axis2=2) / 2.0) if len(q) else np.zeros(0)
        return assign(np.linalg.norm(off, axis=2) / np.maximum(sigma[:, None], 1e-12), 5.0)


def _turned(heading: Array, q: Array) -> Array:
    """Vectors q (n, 2) or (2,) turned by the headings (n,)."""
    c, s = np.cos(heading), np.sin(heading)
    return np.stack([c * q[..., 0] - s * q[..., 1], s * q[..., 0] + c * q[..., 1]], axis=-1)


def _ranged(q: Array, ranging: Array) -> Array:
    """Points q (2,) or (n, 2) where they are, if ranges are wrong by gain and offset (..., 2)."""
    r = np.maximum(np.linalg.norm(q, axis=-1), 1e-9)
    true = (r - ranging[..., 1]) / np.exp(ranging[..., 0])
    return np.asarray(q * (np.maximum(true, 0.05 * r) / r)[..., None])
