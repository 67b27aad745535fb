"""A vehicle on a floor among landmarks on that floor: where it is follows over many frames, each shows hardly anything.

A map has two sides, and only motion tells from which it is seen. Beliefs begin everywhere that the first point allows.
Each point may be any landmark, or none; errors have heavy tails, and odometry slips.
Thrun, Burgard, Fox, "Probabilistic Robotics" (2005), chapters 4 and 8.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, se3_log
from cluster_slam.localisation.beliefs import Beliefs, everywhere, unranged
from cluster_slam.localisation.landmarks import Landmarks
from cluster_slam.localisation.motion import Motion
from cluster_slam.localisation.planar import Flat
from cluster_slam.records import CLUTTER, BoolArray, IntArray, LostReason
from tracking.assignment import assign

_N_MOST, _N_LEAST, _N_EACH = 6_000, 400, 12  # beliefs while all is open, when all but one place is out, and of a place
_STEP_SCALE, _STEP_DOF = 1.5, 4.0  # odometry slips: its steps err by Student's t, wider than stated
_NEAR = (2.0, 0.7)  # over the landmarks' usual spacing, and rad, about a mode: one place ...
_GATE, _N_ROUNDS = 11.3, 3  # ... and chi-square, three degrees of freedom (0.99), from how it is stated
_N_MODES = 4  # cells that are looked at for the likeliest place
_ROUGH = 0.1  # one sigma of a place over the extent of the landmarks: who knows it no better is not there
_SURE = 0.99  # of the beliefs in one place
_LOST_POINTS, _LOST_SHARE = 15, 0.25  # of the last points no landmark's: all is begun anew, beside
_NEWS, _TRUST = 0.5, float(np.log(1e4))  # points that count for so much tell whether the map is of this place; at most
_LOYAL = float(np.log(100.0))  # log odds that what was believed is right all the same
_PATIENCE = 5  # frames that may pass until a point follows another


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
        self.beliefs: Beliefs | None = None
        self.frame = 0
        self._misses: list[float] = []
        self._waited = 0
        self.rival: Beliefs | None = None  # begun later
        self.lead = np.inf  # log odds against it
        self.trust = 0.0  # log odds that what is seen is in the map

    def step(self, frame: int, points: Array, covs: Array, news: Array) -> FlatPlace:
        """The next frame, with points (n, 3), covariances (n, 3, 3), and what each counts for (n,)."""
        q = points @ self.flat.camera[:, :2]
        S = self.flat.camera[:, :2].T @ covs @ self.flat.camera[:, :2]
        for beliefs in (self.beliefs, self.rival):
            if beliefs is not None and frame > self.frame:
                self._move(beliefs, frame)
        self.frame = frame
        first = self._beginning(news) if self._begins() else -1
        if first >= 0 and self.beliefs is not None:
            self.rival, self.lead = everywhere(q[first], S[first], self.places), _LOYAL
        elif first >= 0:
            self.beliefs = everywhere(q[first], S[first], self.places)
        if self.beliefs is None:
            none = np.full(len(q), CLUTTER)
            return FlatPlace("too_few", 0.0, np.eye(4), np.eye(6), none, none.copy())
        for k in range(len(q)):
            self._see(self.beliefs, q[k], S[k], float(news[k]), is_first=k == first)
        if len(q):
            self._contest()
            self.beliefs = self._resampled(self.beliefs)
        return self._place(self.beliefs, q, S)

    def _begins(self) -> bool:
        """Whether all is begun anew: at first, and beside what is believed where that explains too few points."""
        if self.beliefs is None:
            return True
        few = len(self._misses) >= _LOST_POINTS and float(np.mean(self._misses)) > _LOST_SHARE
        return self.rival is None and few

    def _beginning(self, news: Array) -> int:
        """The point from which all is begun: one that follows another, as false ones hardly do; -1: none yet.

        Where points never follow each other it is the next one.
        """
        if len(news) == 0:
            return -1
        self._waited += 1
        if news.min() < 1.0 or self._waited > _PATIENCE:
            self._waited = 0
            return int(news.argmin())
        return -1

    def _contest(self) -> None:
        """What was begun anew replaces what was believed, or is given up, by the evidence since."""
        if self.rival is None:
            return
        if self.lead < 0.0:
            self.beliefs, self.rival, self._misses, self.trust = self.rival, None, [], 0.0
        elif self.lead > 2.0 * _LOYAL:
            self.rival, self._misses = None, []
        else:
            self.rival = self._resampled(self.rival)

    def _move(self, beliefs: Beliefs, frame: int) -> None:
        step = self.motion.camera_step(self.frame, frame, None)
        cov = self.motion.step_cov(self.frame, frame)
        C, n = self.flat.camera, len(beliefs)
        var = np.array([*np.diag(C[:, :2].T @ cov[3:, 3:] @ C[:, :2]), C[:, 2] @ cov[:3, :3] @ C[:, 2]])
        slip = _STEP_SCALE / np.sqrt(self.rng.chisquare(_STEP_DOF, (n, 2)) / _STEP_DOF)
        beliefs.move(C[:, :2].T @ step[:3, 3], float(C[:, 2] @ se3_log(step)[:3]), var, slip)

    def _see(self, beliefs: Beliefs, q: Array, S: Array, news: float, *, is_first: bool) -> None:
        """Take a point in; all anew begins with the first, which says as much as a point that may be anywhere."""
        anywhere = -news * float(np.log(self.area))
        gain = anywhere
        if self.rival is not None or not is_first:
            none, gain = beliefs.see(q, S, news, self.places, self.area, self.rng)
            if news >= _NEWS:  # unknown landmarks would be seen anywhere
                self.trust = min(self.trust + gain - anywhere, _TRUST)
            self._misses = [*self._misses[-(_LOST_POINTS - 1) :], float(beliefs.weights @ none)]
        if self.rival is not None:
            other = anywhere if is_first else self.rival.see(q, S, news, self.places, self.area, self.rng)[1]
            self.lead += gain - other

    def _resampled(self, beliefs: Beliefs) -> Beliefs:
        """Beliefs drawn by their weights, where these have become unequal or fewer will do."""
        w = beliefs.weights
        n = self._wanted(beliefs, w)
        if 1.0 / (w @ w) > 0.5 * len(w) and n > 0.6 * len(w):
            return beliefs
        at = (self.rng.random() + np.arange(n)) / n
        return beliefs.picked(np.minimum(np.searchsorted(np.cumsum(w), at), len(w) - 1))

    def _cells(self, beliefs: Beliefs, size: float) -> IntArray:
        """Where each belief is (n, 4): cells of so many spacings and 0.3 rad, and the side."""
        place = np.floor(beliefs.mean[:, :3] / [size * self.spacing, size * self.spacing, 0.3])
        return np.column_stack([place, beliefs.side]).astype(np.int64)

    def _wanted(self, beliefs: Beliefs, w: Array) -> int:
        """How many beliefs are needed: by how many places are left."""
        left = len(np.unique(self._cells(beliefs, 0.3)[w > 0.01 / len(w)], axis=0))
        return int(np.clip(_N_EACH * left, _N_LEAST, _N_MOST))

    def _place(self, beliefs: Beliefs, q: Array, S: Array) -> FlatPlace:
        none = np.full(len(q), CLUTTER)
        w = beliefs.weights
        here = self._mode(beliefs, w)
        share = float(w[here].sum()) / (1.0 + float(np.exp(-self.trust)))
        if self.rival is not None:
            share /= 1.0 + float(np.exp(-self.lead))
        w = np.where(here, w, 0.0)
        mean, cov = _moments(beliefs, w)
        side = 1.0 if w @ beliefs.side > 0 else -1.0
        T, cov = self.flat.pose(mean[:3], side, cov)
        rows, marks = self._matches(q, S, mean, side)
        flowers, clusters = none, none.copy()
        flowers[rows], clusters[rows] = self.marks.flower_ids[marks], self.marks.cluster_ids[marks]
        roughly = np.trace(cov[3:, 3:]) > _ROUGH**2 * self.area
        reason: LostReason = "ambiguous" if share < _SURE else "too_few" if roughly else ""
        return FlatPlace(reason, share, T, cov, flowers, clusters)

    def _mode(self, beliefs: Beliefs, w: Array) -> BoolArray:
        """Which beliefs (n,) are in the place where most are."""
        cell = np.unique(self._cells(beliefs, 0.5), axis=0, return_inverse=True)[1].ravel()
        share = np.bincount(cell, w)
        likeliest = np.argsort(-share, kind="stable")[:_N_MODES]
        places: list[BoolArray] = [self._about(beliefs, w, cell == k) for k in likeliest if share[k] > 0.0]
        best = int(np.argmax([w[here].sum() for here in places]))
        return places[best]

    def _about(self, beliefs: Beliefs, w: Array, inside: BoolArray) -> BoolArray:
        """Which beliefs (n,) are in one place with some of them (n,).

        Where it is known but roughly, a place is as wide as the normal distribution that is stated for it.
        """
        upright = beliefs.side == beliefs.side[inside][0]
        off = _off(beliefs, _moments(beliefs, np.where(inside, w, 0.0))[0])
        close = np.linalg.norm(off[:, :2], axis=1) < _NEAR[0] * self.spacing
        close &= upright & (np.abs(off[:, 2]) < _NEAR[1])
        here: BoolArray = close
        for _ in range(_N_ROUNDS):
            mean, cov = _moments(beliefs, np.where(here, w, 0.0))
            off = _off(beliefs, mean)
            here = close | (upright & ((off * np.linalg.solve(cov, off.T).T).sum(1) < _GATE))
        return here

    def _matches(self, q: Array, S: Array, mean: Array, side: float) -> tuple[IntArray, IntArray]:
        c, s = np.cos(mean[2]), np.sin(mean[2])
        seen = mean[:2] + unranged(q, mean) @ np.array([[c, s], [-s, c]])
        off = seen[:, None] - self.places * np.array([1.0, side])
        sigma = np.sqrt(np.trace(S, axis1=1, axis2=2) / 2.0) if len(q) else np.zeros(0)
        return assign(np.linalg.norm(off, axis=2) / np.maximum(sigma[:, None], 1e-12), 5.0)


def _moments(beliefs: Beliefs, w: Array) -> tuple[Array, Array]:
    """Mean (5,) and covariance (3, 3) of place and heading, of beliefs with weights (n,)."""
    w = w / max(float(w.sum()), 1e-300)
    mean = w @ beliefs.mean
    mean[2] = np.angle(w @ np.exp(1j * beliefs.mean[:, 2]))
    off = _off(beliefs, mean)
    return mean, (off * w[:, None]).T @ off + np.einsum("n,nij->ij", w, beliefs.cov[:, :3, :3])


def _off(beliefs: Beliefs, mean: Array) -> Array:
    """Places and headings (n, 3) from a mean (5,)."""
    off = (beliefs.mean - mean)[:, :3]
    off[:, 2] = np.angle(np.exp(1j * off[:, 2]))
    return off
