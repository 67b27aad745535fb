"""One cluster followed by its own unscented filter: at rest, swaying or growing, by the evidence.

The measured quantity is where the centroid of all its flowers stands (from the seen ones, each minus its offset), and
the descriptor of the seen ones, which tells the scale.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.online.shape import Shape, measured_by
from cluster_slam.records import IntArray, State
from tracking.motion import MotionConfig, MotionKind, advance, amplitude, process_noise, state_at_rest, touch_noise
from tracking.ukf import Innovation, UnscentedFilter

_EYE = np.eye(3)
_LONG_S = 0.5  # a prediction over longer knows no phase
_NAP_S = 0.5  # a cluster at rest is put through its filter this often
WAKE_M = 0.004  # how far a cluster is from rest that begins to move, one sigma
_TOUCHED = 0.005  # probability that a cluster at rest is touched between two measurements
_CALMED = 0.03  # that one that sways has come to rest
_NOTICED = 2.0  # intervals of frames after which a touch is noticed
_SURE = 3.0  # log odds at which the motion is switched
_MOST = 8.0  # log-likelihood ratio that one measurement may have: gates let wrong ones through
_LEAN_S = 5.0  # over which the mean displacement at rest is taken
_LEANING = 4.0  # times the trembling
_UNSEEN_M = 0.002  # a cluster that is not looked at may have been moved so far, one sigma ...
_UNSEEN_S = 5.0  # ... after so long
_SWUNG_M = 0.015  # how far from rest is taken for rest of what was first seen in a swing, one sigma an axis ...
_SHAPE = 3  # flowers that cannot be taken for others
_SETTLED_S = 0.3  # ... until it has been seen to hang still for so long
_LEARN = 0.1  # how quickly the unrest follows the innovations ...
_MOST_UNREST = 10.0  # ... and how far


class ClusterTrack:
    """The state of one cluster. ``anchor`` (3,) is its centroid at rest as the map has it, m.

    A cluster at rest needs no filter from frame to frame: what it does is known in closed form. Its filter is stepped
    while it moves, and now and then while it rests and is seen (for its scale).
    """

    def __init__(self, cluster_id: int, stamp: float, config: MotionConfig) -> None:
        self.id, self.config = cluster_id, config
        self.first = self.last = self.stamp = stamp
        self.n = 0  # observations
        self.state: State = "tentative"
        self.kind, self.why = MotionKind.REST, "new"
        self.log_odds = -_SURE  # of sway against rest
        self.anchor: Array | None = None
        self.flowers: IntArray = np.zeros(0, dtype=np.int64)  # whose centroid that is
        self.anchor_cov: Array = 1e-6 * np.eye(3)
        self.filter: UnscentedFilter | None = None
        self.trembling: tuple[Array, Array] | None = None  # at rest: displacement and covariance when last seen
        self.unrest = 1.0  # times that accelerations are larger than usual, by the innovations
        self.last_nis = float("nan")
        self.last_shape = -np.inf
        self.rested_s = 0.0  # how long it has been seen at rest
        self.lean, self.lean_s = np.zeros(3), 0.0  # mean displacement while at rest, and over how long

    @property
    def is_moving(self) -> bool:
        return self.kind is not MotionKind.REST and self.filter is not None

    def place(self, anchor: Array, flowers: IntArray) -> None:
        """The centroid at rest of these flowers (k,) ids is there by now.

        With other flowers the centroid that is followed is another one. One that moves, and of which the map has moved
        the place at rest, still is where it was seen: it is displaced otherwise.
        """
        is_seen_moving = self.is_moving and np.array_equal(flowers, self.flowers)
        if self.anchor is not None and self.filter is not None and not is_seen_moving:
            x = self.filter.x.copy()
            x[:3] += anchor - self.anchor
            self.filter.reset(x, self.filter.P)
        self.anchor, self.flowers = anchor, flowers

    def awaken(self, stamp: float) -> None:
        """Begin to follow it (it has been confirmed)."""
        if self.filter is None and self.anchor is not None:
            self.filter = UnscentedFilter(*state_at_rest(self.anchor, self.config))
            self.stamp = stamp

    def displacement(self, stamp: float) -> tuple[Array, Array]:
        """Displacement from rest (3,) and covariance (3, 3), predicted for now (a moving one: at its filter's time)."""
        if self.is_moving and self.filter is not None and self.anchor is not None:
            return self.filter.x[:3] - self.anchor, self.filter.P[:3, :3]
        var = self.config.tremble_m**2 + unseen_var(max(stamp - self.last, 0.0))
        return np.zeros(3), np.asarray(var * _EYE)

    @property
    def scale(self) -> float:
        return 1.0 if self.filter is None else float(np.exp(self.filter.x[6]))

    @property
    def velocity(self) -> Array:
        """Velocity (3,) m/s."""
        return self.filter.x[3:6] if self.is_moving and self.filter is not None else np.zeros(3)

    @property
    def reach(self) -> float:
        """How far from rest it swings at present, m, and how far rest may be from where it is taken to be."""
        if not self.is_moving or self.filter is None or self.anchor is None:
            return self.config.tremble_m
        unknown = float(np.trace(self.filter.P[8:11, 8:11]))
        return max(float(np.hypot(amplitude(self.filter.x, self.anchor), np.sqrt(unknown))), self.config.tremble_m)

    @property
    def doubt(self) -> float:
        """How far from rest, m, one sigma an axis, it may be taken to rest, as it was hardly seen to hang still."""
        return float(_SWUNG_M * np.exp(-0.5 * self.rested_s / _SETTLED_S))

    def now(self, stamp: float) -> tuple[Array, Array, Array]:
        """Centroid (3,), velocity (3,), and their covariance (6, 6), the map's own with it; predicted if not seen."""
        anchor = np.zeros(3) if self.anchor is None else self.anchor
        cov = np.zeros((6, 6))
        f, dt = self.filter, stamp - self.stamp
        if self.is_moving and f is not None:
            x, P = f.x, f.P
            if dt > 0.0 and self.kind is MotionKind.SWAY:
                x, P, _ = self._far(f, anchor, dt)
            elif dt > 0.0:
                P = P + process_noise(x, dt, anchor, self.kind, self.config)
                x = advance(x, dt, anchor, self.kind, self.config)
            position, velocity = x[:3], x[3:6]
            cov[:] = P[:6, :6]
        else:
            is_fresh = self.trembling is not None and stamp <= self.last
            d, P = self.trembling if self.trembling is not None and is_fresh else self.displacement(stamp)
            position, velocity = anchor + d, np.zeros(3)
            cov[:3, :3], cov[3:, 3:] = P, (self.config.tremble_m / self.config.tremble_s) ** 2 * np.eye(3)
        cov[:3, :3] += self.anchor_cov
        return position, velocity, cov

    def predict(self, stamp: float) -> None:
        """Bring the filter to this time."""
        f, anchor, dt = self.filter, self.anchor, stamp - self.stamp
        if dt <= 0.0 or f is None or anchor is None:
            return
        kind, config = self.kind, self.config
        if dt > _LONG_S and kind is not MotionKind.GROWTH:
            self._predict_far(f, anchor, dt)
        else:
            Q = process_noise(f.x, dt, anchor, kind, config, self.unrest)
            f.predict(lambda s: advance(s, dt, anchor, kind, config), Q)
        self.stamp = stamp

    def _predict_far(self, f: UnscentedFilter, anchor: Array, dt: float) -> None:
        x, P, left = self._far(f, anchor, dt)
        if self.is_moving and left < self.config.tremble_m:
            self._switch(MotionKind.REST, "its sway has died away unseen")
        f.reset(x, P)

    def _far(self, f: UnscentedFilter, anchor: Array, dt: float) -> tuple[Array, Array, float]:
        """State (11,) and covariance after a long time: no phase of a sway is known; how far it still swings."""
        x, P = state_at_rest(anchor, self.config)
        omega = np.exp(f.x[7])
        left = self.reach * np.exp(-self.config.damping * omega * dt) if self.is_moving else 0.0
        moved = unseen_var(dt)
        P[:3, :3] += (left**2 + moved) * np.eye(3)
        P[3:6, 3:6] += (left**2 + moved) * omega**2 * np.eye(3)
        P[6, 6] = f.P[6, 6] + self.config.scale_walk**2 * dt
        P[7, 7] = min(f.P[7, 7] + self.config.frequency_walk**2 * dt, self.config.sway_log_sigma**2)
        x[6:] = f.x[6:]
        x[:3] += x[8:11]
        P[8:11, 8:11] = f.P[8:11, 8:11]
        P[:3, :3] += P[8:11, 8:11]
        P[:3, 8:11] = P[8:11, :3] = P[8:11, 8:11]
        return x, P, float(left)

    def weigh(self, at_rest: float, waking: float, shift: Array, cov: Array, dt: float) -> None:
        """Weigh the evidence for sway against rest; switch when it is clear, before any update is made.

        ``at_rest`` and ``waking`` are the log-likelihoods of where it was seen if it rests and if it begins to move;
        ``shift`` (3,) from where it was predicted, with ``cov`` (3, 3), ``dt`` s after it was last seen.
        """
        f = self.filter
        if f is None or self.anchor is None:
            return
        moving, is_pushed = waking, False
        if self.is_moving:
            S = f.P[:3, :3] + cov
            self.last_nis, moving = _nis_and_log_likelihood(shift, S)
            _, pushed = _nis_and_log_likelihood(shift, S + touch_noise(dt, self.config)[:3, :3])
            is_pushed = pushed - moving > np.log(1.0 / _TOUCHED - 1.0)
            moving = max(moving, pushed) if is_pushed else moving
        p = 1.0 / (1.0 + np.exp(-min(max(self.log_odds, -30.0), 30.0)))
        p = p * (1.0 - _CALMED) + (1.0 - p) * _TOUCHED
        self.log_odds = float(np.log(p / (1.0 - p))) + min(max(moving - at_rest, -_MOST), _MOST)
        if not self.is_moving and self.log_odds > _SURE:
            f.reset(*self._hanging(f, self.anchor))
            self._switch(MotionKind.SWAY, f"it stands {1e3 * float(np.linalg.norm(shift)):.1f} mm from rest")
            self._loosen(f, _NOTICED * dt)
        elif self.is_moving and self.log_odds < -_SURE:
            self._switch(MotionKind.REST, "it has come to rest")
            f.reset(*self._hanging(f, self.anchor))
        elif is_pushed:
            self.why = "it was pushed again"
            self._loosen(f, dt)
        elif self.is_moving:
            surprise = min(self.last_nis / 3.0 - 1.0, 2.0)
            self.unrest = float(np.clip(self.unrest * np.exp(_LEARN * surprise), 1.0, _MOST_UNREST))

    def _hanging(self, f: UnscentedFilter, anchor: Array) -> tuple[Array, Array]:
        """State (11,) and covariance (11, 11) at rest, with the scale and the frequency that are known by now.

        The place at rest is as well known as the map says, if it has been seen at rest for a while: what was only seen
        in a swing may hang centimetres from there. Of fewer flowers than make a shape this is not believed: that they
        were taken for others is likelier.
        """
        x, P = state_at_rest(anchor, self.config)
        x[6:8], P[6, 6], P[7, 7] = f.x[6:8], f.P[6, 6], f.P[7, 7]
        if len(self.flowers) >= _SHAPE:
            P[8:11, 8:11] += self.anchor_cov + self.doubt**2 * _EYE
        return x, P

    def _loosen(self, f: UnscentedFilter, dt: float) -> None:
        """Something touched it within the last ``dt`` seconds."""
        P = f.P.copy()
        P[:6, :6] += touch_noise(dt, self.config)
        f.reset(f.x, P)

    def rest(self, u: Array, dt: float, stamp: float) -> None:
        """At rest it was seen displaced by u (3,): one that leans away for long, and not by trembling, is growing."""
        weight = min(dt, _LONG_S) / _LEAN_S
        self.rested_s += min(dt, _LONG_S)
        self.lean, self.lean_s = self.lean + weight * (u - self.lean), self.lean_s + dt
        distance = float(np.linalg.norm(self.lean))
        f = self.filter
        if (
            f is None
            or self.anchor is None
            or self.lean_s < 2.0 * _LEAN_S
            or distance < _LEANING * self.config.tremble_m
        ):
            return
        x, P = self._hanging(f, self.anchor)
        x[:3] += self.lean
        x[3:6] = self.lean / self.lean_s
        P[3:6, 3:6] = (distance / self.lean_s) ** 2 * np.eye(3)
        f.reset(x, P)
        self.stamp, self.lean_s = stamp, 0.0
        self._switch(MotionKind.GROWTH, f"for long it has stood {1e3 * distance:.1f} mm from where it was")

    def wants_filter(self, stamp: float) -> bool:
        """Whether its filter should take this measurement: it moves, or has rested for a while."""
        return self.filter is not None and (self.is_moving or stamp - self.stamp >= _NAP_S)

    def wants_shape(self, stamp: float) -> bool:
        """Whether it is time to look at its scale again, which changes slowly."""
        return stamp - self.last_shape >= _NAP_S

    def update(self, seen_at: Array, cov: Array, shape: Shape | None, stamp: float) -> Innovation | None:
        """Take in where it was seen: its centroid at ``seen_at`` (3,), covariance (3, 3)."""
        f = self.filter
        if f is None or self.anchor is None:
            return None
        self.predict(stamp)
        if shape is None:
            innovation = f.update(seen_at, cov, lambda s: s[:, :3])
        else:
            self.last_shape = stamp
            R = np.zeros((5, 5))
            R[:3, :3], R[3:, 3:] = cov, shape.cov
            innovation = f.update(np.concatenate([seen_at, shape.seen]), R, measured_by(shape.at_rest))
        if abs(f.x[6]) > _WIDEST or not _SLOWEST < f.x[7] < _FASTEST:
            x = f.x.copy()
            x[6], x[7] = np.clip(x[6], -_WIDEST, _WIDEST), np.clip(x[7], _SLOWEST, _FASTEST)
            f.reset(x, f.P)
        return innovation

    def jump(self, d: Array, cov: Array, speed: float, velocity: Array | None, reason: str, stamp: float) -> None:
        """It was found displaced by d (3,), covariance (3, 3), and may move at any speed up to about ``speed`` m/s."""
        f = self.filter
        if f is None or self.anchor is None:
            return
        x, P = self._hanging(f, self.anchor)
        anew, anew_P = state_at_rest(self.anchor, self.config)
        x[7], P[7, 7] = anew[7], anew_P[7, 7]  # if it followed others until now, it learned their swing
        x[:3] += d
        if velocity is not None:
            x[3:6] = velocity
        P[:3, :3] = cov
        P[3:6, 3:6] = speed**2 * np.eye(3)
        f.reset(x, P)
        self.stamp = stamp
        self._switch(MotionKind.SWAY, reason)

    def _switch(self, kind: MotionKind, reason: str) -> None:
        self.kind, self.why, self.trembling, self.unrest = kind, reason, None, 1.0
        self.log_odds = _SURE if kind is MotionKind.SWAY else -_SURE


def unseen_var(unseen_s: Any) -> Any:
    """Variance, m^2, of how far a cluster at rest may have been moved while nobody looked, for so many seconds."""
    return _UNSEEN_M**2 * (1.0 - np.exp(-unseen_s / _UNSEEN_S))


def _nis_and_log_likelihood(shift: Array, S: Array) -> tuple[float, float]:
    """Squared Mahalanobis length of an innovation (3,) with covariance (3, 3) and log-likelihood.

    By the adjugate in plain numbers: it is asked for every cluster in every frame.
    """
    (a, b, c), (_, d, e), (_, _, f) = S.tolist()
    x, y, z = shift.tolist()
    xx, xy, xz = d * f - e * e, c * e - b * f, b * e - c * d
    det = a * xx + b * xy + c * xz
    square = x * (xx * x + 2.0 * (xy * y + xz * z)) + (a * f - c * c) * y * y + (a * d - b * b) * z * z
    nis = (square + 2.0 * (b * c - a * e) * y * z) / det
    return nis, -0.5 * (nis + float(np.log(det)))


_WIDEST = 0.7  # log scale
_SLOWEST, _FASTEST = 0.5, 4.5  # log angular frequency
