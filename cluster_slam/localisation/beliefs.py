"""Where a vehicle on a floor may be: many normal distributions, each with its own story of who was who.

Each belief is an extended Kalman filter over place, heading, and what ranges are wrong by (a gain and an offset, that
stay; the map holds true lengths). Which landmark a point is, and whether odometry slipped, is drawn for each of them,
as in Rao-Blackwellised particle filters (Murphy and Russell 2001; Montemerlo, "FastSLAM", 2003): what can be computed
is not drawn, so hundreds do where particles over everything would be too few for sharp points.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import IntArray

WIDE, WIDE_SHARE = 4.0, 0.1  # points may also err so many times more, this share of them
FALSE_SHARE = 0.03  # of the points
_GAIN, _OFFSET = 0.03, 0.05  # one sigma of what ranges err by for good: a share, and m ...
_WANDER = 0.02  # ... and how far they move with each frame, of that
_N_HEADINGS = 72  # at first, evenly around
_ANYWHERE_M = 1e3
_MOST_PAIRS = 60_000  # of beliefs and landmarks, at once


@dataclass(slots=True, eq=False)
class Beliefs:
    """n of them, in the plane of the map."""

    mean: Array  # (n, 5) x, y, heading, gain and offset of ranges
    cov: Array  # (n, 5, 5)
    side: Array  # (n,) 1 or -1: which way up the map is seen
    log_weight: Array  # (n,)

    def __len__(self) -> int:
        return len(self.mean)

    @property
    def weights(self) -> Array:
        w = np.exp(self.log_weight - self.log_weight.max())
        out: Array = w / w.sum()
        return out

    def picked(self, pick: IntArray) -> Beliefs:
        """Those with numbers ``pick`` (m,), equally likely."""
        return Beliefs(self.mean[pick], self.cov[pick], self.side[pick], np.zeros(len(pick)))

    def move(self, shift: Array, turn: float, var: Array, slip: Array) -> None:
        """Odometry: a shift (2,) along the vehicle's axes and a turn, variances (3,), slips (n, 2) times sigmas."""
        R, dR = _turns(self.mean[:, 2])
        F = np.tile(np.eye(5), (len(self), 1, 1))
        F[:, :2, 2] = dR @ shift
        F[:, [3, 4], [3, 4]] = keep = np.sqrt(1.0 - _WANDER**2)
        self.mean[:, :2] += R @ shift
        self.mean[:, 2] += turn
        self.mean[:, 3:] *= keep
        Q = np.zeros_like(self.cov)
        Q[:, :2, :2] = R @ (var[:2] * slip[:, :1, None] ** 2 * np.eye(2)) @ np.swapaxes(R, 1, 2)
        Q[:, 2, 2] = var[2] * slip[:, 1] ** 2
        Q[:, [3, 4], [3, 4]] = (_WANDER * np.array([_GAIN, _OFFSET])) ** 2
        self.cov = F @ self.cov @ np.swapaxes(F, 1, 2) + Q

    def see(
        self, q: Array, S: Array, news: float, places: Array, area: float, rng: np.random.Generator
    ) -> tuple[Array, float]:
        """Take a point q (2,) with covariance S (2, 2) in, which counts as so much of an independent one.

        Each belief draws which landmark (k, 2) it is, or none. Returns the probability of none (n,) for each belief,
        and the log likelihood of the point under all of them.
        """
        none, before = np.empty(len(self)), self._log_total()
        for rows in np.array_split(np.arange(len(self)), 1 + len(self) * len(places) // _MOST_PAIRS):
            none[rows] = self._see(rows, q, S, news, places, area, rng)
        return none, self._log_total() - before

    def _log_total(self) -> float:
        most = float(self.log_weight.max())
        return most + float(np.log(np.exp(self.log_weight - most).sum()))

    def _see(
        self, rows: IntArray, q: Array, S: Array, news: float, places: Array, area: float, rng: np.random.Generator
    ) -> Array:
        mirrored = np.stack([np.ones(len(rows)), self.side[rows]], axis=1)
        off, H, HPH = self.views(rows, q, places * mirrored[:, None])
        n, k = off.shape[:2]
        narrow = (1.0 - WIDE_SHARE) * _density(off, HPH + S)
        wide = WIDE_SHARE * _density(off, HPH + WIDE**2 * S)
        each = np.concatenate([narrow, wide], axis=1) * (1.0 - FALSE_SHARE) / k
        total = each.sum(1) + FALSE_SHARE / area
        self.log_weight[rows] += news * np.log(total)
        draw = (np.cumsum(each, axis=1) < rng.random((n, 1)) * total[:, None]).sum(1)
        seen = np.flatnonzero(draw < 2 * k)
        mark = draw[seen] % k
        factor = np.where(draw[seen] < k, 1.0, WIDE**2) / news
        self._update(rows[seen], off[seen, mark], H[seen, mark], HPH[seen, mark] + factor[:, None, None] * S)
        return np.asarray(FALSE_SHARE / area / total)

    def _update(self, rows: IntArray, off: Array, H: Array, innovation_cov: Array) -> None:
        PH = self.cov[rows] @ np.swapaxes(H, 1, 2)
        K = np.swapaxes(np.linalg.solve(innovation_cov, np.swapaxes(PH, 1, 2)), 1, 2)
        self.mean[rows] += (K @ off[..., None])[..., 0]
        cov = self.cov[rows] - K @ np.swapaxes(PH, 1, 2)
        self.cov[rows] = 0.5 * (cov + np.swapaxes(cov, 1, 2))

    def views(self, rows: IntArray, q: Array, marks: Array) -> tuple[Array, Array, Array]:
        """Point q (2,) minus where beliefs ``rows`` (n,) expect landmarks (n, k, 2).

        With it the Jacobian H (n, k, 2, 5) of what is expected, and H P H' (n, k, 2, 2).
        """
        mean = self.mean[rows]
        R, dR = _turns(mean[:, 2])
        away = marks - mean[:, None, :2]
        v = away @ R  # along the vehicle's axes: R' away
        r = np.maximum(np.linalg.norm(v, axis=-1, keepdims=True), 1e-6)
        gain, offset = np.exp(mean[:, 3])[:, None, None], mean[:, 4][:, None, None]
        u = v / r
        by_v = (gain + offset / r)[..., None] * np.eye(2) - (offset / r)[..., None] * u[..., :, None] * u[..., None, :]
        H = np.empty((*v.shape, 5))
        H[..., :2] = -by_v @ np.swapaxes(R, 1, 2)[:, None]
        H[..., 2] = (by_v @ (away @ dR)[..., None])[..., 0]
        H[..., 3], H[..., 4] = gain * v, u
        HP = (H.reshape(len(rows), -1, 5) @ self.cov[rows]).reshape(H.shape)
        return q - (gain * v + offset * u), H, np.einsum("nkia,nkja->nkij", HP, H)


def everywhere(q: Array, S: Array, places: Array) -> Beliefs:
    """All that one point q (2,) with covariance S (2, 2) allows: any landmark (k, 2), heading, and side of the map."""
    heading = (np.arange(_N_HEADINGS) + 0.5) * 2.0 * np.pi / _N_HEADINGS - np.pi
    n = 2 * len(places) * _N_HEADINGS
    mark = np.arange(len(places)).repeat(2 * _N_HEADINGS)
    side = np.tile(np.array([1.0, -1.0]).repeat(_N_HEADINGS), len(places))
    h = np.tile(heading, 2 * len(places))
    mean, target = np.zeros((n, 5)), places[mark] * np.column_stack([np.ones(n), side])
    mean[:, 2] = h
    mean[:, :2] = target - _turns(h)[0] @ q
    spread = np.array([_ANYWHERE_M, _ANYWHERE_M, np.pi / _N_HEADINGS, _GAIN, _OFFSET])
    out = Beliefs(mean, np.tile(np.diag(spread**2), (n, 1, 1)), side, np.zeros(n))
    off, H, HPH = out.views(np.arange(n), q, target[:, None])
    out._update(np.arange(n), off[:, 0], H[:, 0], HPH[:, 0] + S)
    return out


def unranged(q: Array, mean: Array) -> Array:
    """Points q (n, 2) where they are, if ranges are wrong as a belief's mean (5,) says."""
    r = np.maximum(np.linalg.norm(q, axis=-1), 1e-9)
    true = (r - mean[4]) / np.exp(mean[3])
    return np.asarray(q * (np.maximum(true, 0.05 * r) / r)[..., None])


def _turns(heading: Array) -> tuple[Array, Array]:
    """Rotations (n, 2, 2) by headings (n,), and their derivatives."""
    c, s = np.cos(heading), np.sin(heading)
    return np.moveaxis(np.array([[c, -s], [s, c]]), -1, 0), np.moveaxis(np.array([[-s, -c], [c, -s]]), -1, 0)


def _density(off: Array, S: Array) -> Array:
    """Normal densities (...) of vectors (..., 2) with covariances (..., 2, 2)."""
    a, b, d = S[..., 0, 0], S[..., 0, 1], S[..., 1, 1]
    det = a * d - b * b
    x, y = off[..., 0], off[..., 1]
    d2 = (d * x * x - 2.0 * b * x * y + a * y * y) / det
    return np.asarray(np.exp(-0.5 * d2) / (2.0 * np.pi * np.sqrt(det)))
