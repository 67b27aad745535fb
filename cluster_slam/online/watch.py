"""What the residuals say of what was taken for known: the points' noise, and the frozen hand-eye transform."""

from __future__ import annotations

from collections import deque

import numpy as np

from cluster_slam.geometry import Array
from tracking.gating import chi2_threshold

_GAIN = 0.1  # of the logarithm of the factor, a frame with many points
_MANY = 20
_HOLDING = 3  # flowers that hold a pose
_WIDEST = 16.0  # a sigma stated four times too small


class NoiseWatch:
    """The factor on the stated variances of points, from squared innovations: their median is known if they are true.

    It only widens: errors that change slowly hide from innovations, and would make it too small.
    """

    def __init__(self) -> None:
        self.factor = 1.0

    def see(self, chi2: Array) -> None:
        """Squared innovations (q,), three degrees of freedom, of points of one frame."""
        if len(chi2):
            ratio = float(np.median(chi2)) / chi2_threshold(3, 0.5)
            step = _GAIN * min(len(chi2) / _MANY, 1.0)
            self.factor = float(np.clip(self.factor * max(ratio, 0.05) ** step, 1.0, _WIDEST))


class AstrayWatch:
    """How far odometry may have led astray, one sigma: flowers that stand nearer to each other cannot be told apart.

    Three known flowers in view hold the way; without them odometry alone does, and its errors add up until three
    flowers come back that were known before.
    """

    def __init__(self) -> None:
        self.sigma_m, self.most_m = 0.0, 0.0
        self._turn_var = self._shift_var = 0.0
        self._held = np.inf  # stamp of the last frame whose place in the map is certain

    def see(self, stamp: float, first: Array, step_cov: Array, depth: float) -> None:
        """A frame saw landmarks (k,) first seen at ``first`` s, after a step with covariance (6, 6)."""
        if not np.isfinite(self._held) and len(first) < _HOLDING:
            return
        if (first <= self._held).sum() >= _HOLDING:
            self._turn_var = self._shift_var = self.sigma_m = 0.0
            self._held = stamp
        elif len(first) < _HOLDING:
            self._turn_var += float(np.trace(step_cov[:3, :3]))
            self._shift_var += float(np.trace(step_cov[3:, 3:]))
            self.sigma_m = float(np.sqrt(self._shift_var + self._turn_var * depth**2))
            self.most_m = max(self.most_m, self.sigma_m)


class MountWatch:
    """Whether the camera still sits where it sat: then the poses' errors, seen from the camera, average out.

    A hand-eye transform that changes is an error common to all frames, in the camera's own axes.
    """

    def __init__(self, cov_pose: Array, window_s: float = 3.0, pause_s: float = 10.0) -> None:
        """``cov_pose`` (6, 6) is how much each single pose errs, in the camera's frame."""
        self._root = np.linalg.cholesky(cov_pose)
        self._window_s, self._pause_s = window_s, pause_s
        self._errors: deque[tuple[float, Array]] = deque()
        self._quiet_until = -np.inf

    def see(self, stamp: float, z: Array) -> str:
        """The tangent z (6,) of a frame's pose; returns a warning, or nothing."""
        self._errors.append((stamp, np.linalg.solve(self._root, z)))
        while self._errors[0][0] < stamp - self._window_s:
            self._errors.popleft()
        span = stamp - self._errors[0][0]
        if span < 0.8 * self._window_s or len(self._errors) < 10 or stamp < self._quiet_until:
            return ""
        mean = np.mean([e for _, e in self._errors], axis=0)
        if float(mean @ mean) < chi2_threshold(6, 0.9):  # of single poses: the mean of many is far less if all is well
            return ""
        self._quiet_until = stamp + self._pause_s
        shift, turn = self._root[3:] @ mean, self._root[:3] @ mean
        return (
            "the hand-eye transform no longer holds: poses are off by "
            f"{1e3 * float(np.linalg.norm(shift)):.1f} mm and {np.degrees(float(np.linalg.norm(turn))):.2f} deg "
            f"for {self._window_s:g} s; was the camera moved on its mount?"
        )
