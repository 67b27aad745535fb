"""One cluster followed by its own unscented filter: at rest, swaying or growing, by the evidence.

The measured quantity is where the centroid of all its flowers stands (from the seen ones, each minus its offset), and
the descriptor of the seen ones, which tells the scale.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.descriptors import inertia_and_mean_distance
from cluster_slam.geometry import Array
from cluster_slam.records import State
from tracking.gaussian import LOG_2PI
from tracking.motion import MotionConfig, MotionKind, advance, amplitude, process_noise, state_at_rest
from tracking.ukf import Innovation, UnscentedFilter

_LONG_S = 0.5  # a prediction over longer knows no phase
_WAKE_M = 0.004  # how far a cluster is from rest that begins to move, one sigma
_SWITCH = 0.02  # probability of a change of motion from one measurement to the next
_SURE = 3.0  # log odds at which the motion is switched
_UNSEEN_M = 0.002  # a cluster that is not looked at may have been moved so far, one sigma ...
_UNSEEN_S = 5.0  # ... after so long
_PUSHED_NIS = 25.0  # of three degrees of freedom: something pushed it again


@dataclass(frozen=True, slots=True, eq=False)
class Shape:
    """Descriptor (2,) of the seen flowers at rest, and as seen with its covariance (2, 2)."""

    at_rest: Array
    seen: Array
    cov: Array


class ClusterTrack:
    """The state of one cluster. ``anchor`` (3,) is its centroid at rest as the map has it, m."""

    def __init__(self, cluster_id: int, stamp: float, config: MotionConfig) -> None:
        self.id, self.config = cluster_id, config
        self.first = self.last = self.stamp = stamp
        self.n = 0  # observations
        self.state: State = "tentative"
        self.kind, self.why = MotionKind.REST, "new"
        self.log_odds = -_SURE  # of sway against rest
        self.anchor: Array | None = None
        self.filter: UnscentedFilter | None = None
        self.last_nis = float("nan")

    def place(self, anchor: Array) -> None:
        """The map has moved the centroid at rest: the displacement stays what it was."""
        if self.anchor is None or self.filter is None:
            self.anchor = anchor
            return
        x = self.filter.x.copy()
        x[:3] += anchor - self.anchor
        self.filter.reset(x, self.filter.P)
        self.anchor = anchor

    def awaken(self, stamp: float) -> None:
        """Begin to follow it (it has been confirmed)."""
        if self.filter is None and self.anchor is not None:
            self.filter = UnscentedFilter(*state_at_rest(self.anchor, self.config))
            self.stamp = stamp

    @property
    def displacement(self) -> tuple[Array, Array]:
        """Displacement from rest (3,) and covariance (3, 3), at the time of the last prediction."""
        if self.filter is None or self.anchor is None:
            return np.zeros(3), self.config.tremble_m**2 * np.eye(3)
        return self.filter.x[:3] - self.anchor, self.filter.P[:3, :3]

    @property
    def scale(self) -> float:
        return 1.0 if self.filter is None else float(np.exp(self.filter.x[6]))

    @property
    def reach(self) -> float:
        """How far from rest it swings at present, m."""
        if self.filter is None or self.anchor is None or self.kind is MotionKind.REST:
            return self.config.tremble_m
        return max(amplitude(self.filter.x, self.anchor), self.config.tremble_m)

    def predict(self, stamp: float) -> None:
        """Bring the state to this time."""
        dt = stamp - self.stamp
        if dt <= 0.0 or self.filter is None or self.anchor is None:
            return
        if dt > _LONG_S:
            self._predict_far(dt)
        else:
            anchor, kind, config = self.anchor, self.kind, self.config
            Q = process_noise(self.filter.x, dt, anchor, kind, config)
            self.filter.predict(lambda s: advance(s, dt, anchor, kind, config), Q)
        self.stamp = stamp

    def _predict_far(self, dt: float) -> None:
        """Over a long time the phase of a sway is lost, and what is left of it may point anywhere."""
        assert_filter, anchor = self.filter, self.anchor
        if assert_filter is None or anchor is None:
            return
        before, x = assert_filter.P, assert_filter.x.copy()
        rest, P = state_at_rest(anchor, self.config)
        omega = np.exp(x[7])
        left = self.reach * np.exp(-self.config.damping * omega * dt) if self.kind is MotionKind.SWAY else 0.0
        moved = _UNSEEN_M**2 * (1.0 - np.exp(-dt / _UNSEEN_S))
        P[:3, :3] += (left**2 + moved) * np.eye(3)
        P[3:6, 3:6] += (left**2 + moved) * omega**2 * np.eye(3)
        P[6, 6] = before[6, 6] + self.config.scale_walk**2 * dt
        P[7, 7] = min(before[7, 7] + self.config.frequency_walk**2 * dt, self.config.sway_log_sigma**2)
        rest[6:] = x[6:]
        if self.kind is MotionKind.SWAY and left < self.config.tremble_m:
            self._switch(MotionKind.REST, "its sway has died away unseen")
        assert_filter.reset(rest, P)

    def update(self, shift: Array, cov: Array, shape: Shape | None, stamp: float) -> Innovation | None:
        """Take in where it was seen: ``shift`` (3,) of its centroid from the prediction, with covariance (3, 3)."""
        if self.filter is None or self.anchor is None:
            return None
        f = self.filter
        z = f.x[:3] + shift
        self._weigh(z, shift, cov)
        if shape is None:
            innovation = f.update(z, cov, lambda s: s[:, :3])
        else:
            R = np.zeros((5, 5))
            R[:3, :3], R[3:, 3:] = cov, shape.cov
            powers = np.array([2.0, 1.0])
            at_rest = shape.at_rest
            innovation = f.update(
                np.concatenate([z, shape.seen]),
                R,
                lambda s: np.concatenate([s[:, :3], at_rest * np.exp(powers * s[:, 6:7])], axis=1),
            )
        if abs(f.x[6]) > 0.7 or not 0.5 < f.x[7] < 4.5:
            x = f.x.copy()
            x[6], x[7] = np.clip(x[6], -0.7, 0.7), np.clip(x[7], 0.5, 4.5)
            f.reset(x, f.P)
        return innovation

    def _weigh(self, z: Array, shift: Array, cov: Array) -> None:
        """Weigh the evidence for sway against rest; switch when it is clear, and before the update is made."""
        f, anchor, c = self.filter, self.anchor, self.config
        if f is None or anchor is None:
            return
        S = f.P[:3, :3] + cov
        self.last_nis = float(shift @ np.linalg.solve(S, shift))
        u, eye = z - anchor, np.eye(3)
        at_rest = _log_normal(u, cov + c.tremble_m**2 * eye)
        if self.kind is MotionKind.SWAY:
            moving = _log_normal(shift, S)
        else:
            moving = _log_normal(u, cov + _WAKE_M**2 * eye)
        p = 1.0 / (1.0 + np.exp(-np.clip(self.log_odds, -30, 30)))
        p = p * (1 - _SWITCH) + (1 - p) * _SWITCH
        self.log_odds = float(np.log(p / (1 - p)) + np.clip(moving - at_rest, -8.0, 8.0))
        if self.kind is MotionKind.REST and self.log_odds > _SURE:
            self._switch(MotionKind.SWAY, f"it stands {1e3 * np.linalg.norm(u):.1f} mm from rest")
            self._loosen()
        elif self.kind is MotionKind.SWAY and self.log_odds < -_SURE:
            self._switch(MotionKind.REST, "it has come to rest")
            x, P = state_at_rest(anchor, c)
            x[6:], P[6, 6] = f.x[6:], f.P[6, 6]
            f.reset(x, P)
        elif self.kind is MotionKind.SWAY and self.last_nis > _PUSHED_NIS:
            self.why = "it was pushed again"
            self._loosen()

    def _loosen(self) -> None:
        """Anything may have happened to its velocity."""
        f = self.filter
        if f is not None:
            P = f.P.copy()
            P[:3, :3] += 1e-6 * np.eye(3)
            P[3:6, 3:6] += 0.15**2 * np.eye(3)
            f.reset(f.x, P)

    def jump(self, d: Array, cov: Array, speed: float, velocity: Array | None, reason: str) -> None:
        """It was found displaced by d (3,), covariance (3, 3), and may move at any speed up to about ``speed`` m/s."""
        if self.filter is None or self.anchor is None:
            return
        x, P = state_at_rest(self.anchor, self.config)
        x[:3] += d
        if velocity is not None:
            x[3:6] = velocity
        P[:3, :3] = cov
        P[3:6, 3:6] = speed**2 * np.eye(3)
        x[6], P[6, 6] = self.filter.x[6], self.filter.P[6, 6]
        self.filter.reset(x, P)
        self._switch(MotionKind.SWAY, reason)

    def _switch(self, kind: MotionKind, reason: str) -> None:
        self.kind, self.why = kind, reason
        self.log_odds = _SURE if kind is MotionKind.SWAY else -_SURE


def _log_normal(v: Array, S: Array) -> float:
    _, log_det = np.linalg.slogdet(S)
    return float(-0.5 * (v @ np.linalg.solve(S, v) + log_det + len(v) * LOG_2PI))


def seen_shape(offsets: Array, points: Array, var: Array) -> Shape | None:
    """Descriptor of the seen flowers: at rest from ``offsets`` (k, 3), as seen from ``points`` (k, 3), noise taken out.

    ``var`` (k,) are the variances of the points along an axis, m^2. To first order in the noise, and its mean to the
    second: E[inertia] has 3 (k - 1) / k sum var more than the truth, each distance r about var / r more.
    """
    k = len(offsets)
    if k < 3:
        return None
    r = points - points.mean(0)
    length = np.sqrt((r * r).sum(1))
    if (length < 1e-9).any():
        return None
    share = 1.0 - 1.0 / k
    inertia, distance = inertia_and_mean_distance(points)
    seen = np.array([inertia - 3.0 * share * var.sum(), distance - share * float((var / length).mean())])
    unit = r / length[:, None]
    slope = np.stack([2.0 * r, (unit - unit.mean(0)) / k])  # (2, k, 3)
    cov = np.einsum("aki,k,bki->ab", slope, var, slope)
    cov[0, 0] += 6.0 * float((var * var).sum())
    cov[1, 1] += float((var * var / length**2).sum()) / k**2
    cov += np.diag(1e-6 * np.diag(cov))
    at_rest = inertia_and_mean_distance(offsets)
    return Shape(np.asarray(at_rest, np.float64), seen, cov)
