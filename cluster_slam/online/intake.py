"""What a live source may get wrong, frame by frame: refused with a reason, or taken with what is broken left out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.records import BoolArray, Frame

_BACK = 5  # frames in order among themselves, but older than the last: then the clock was set back
_ROTATION_TOLERANCE = 1e-3
_FAR_M = 1e3  # no camera sees a flower so far away


@dataclass(frozen=True, slots=True, eq=False)
class Taken:
    """A frame's time on the tracker's own clock, which of its points can be used (q,), and what is odd."""

    stamp: float
    usable: BoolArray
    warnings: tuple[str, ...]


class Intake:
    """Keeps time running forwards."""

    def __init__(self) -> None:
        self.last: float | None = None
        self.last_given = 0.0
        self.offset = 0.0
        self._back: list[float] = []

    def take(self, frame: Frame) -> Taken | str:
        """The frame as it can be used, or why it is refused."""
        if not np.isfinite(frame.stamp):
            return f"its stamp is {frame.stamp}"
        refused = _pose_fault(frame.pose)
        if refused:
            return refused
        stamp = frame.stamp + self.offset
        warnings: list[str] = []
        if self.last is not None and stamp <= self.last:
            if stamp == self.last:
                return f"a frame of {frame.stamp:.6f} s has been there already"
            if not self._clock_was_set_back(frame.stamp):
                return f"late: {frame.stamp:.6f} s is before the last frame, {self.last_given:.6f} s"
            back = self.last_given - frame.stamp
            self.offset += back + (self._back[-1] - self._back[0]) / (_BACK - 1)
            stamp = frame.stamp + self.offset
            warnings.append(f"the clock jumped back by {back:.3f} s; time goes on from the last frame")
        self._back = []
        self.last, self.last_given = stamp, frame.stamp
        usable = usable_points(frame.points, frame.covs)
        if not usable.all():
            warnings.append(f"{int((~usable).sum())} of {len(usable)} points are no points and were left out")
        return Taken(stamp, usable, tuple(warnings))

    def _clock_was_set_back(self, stamp: float) -> bool:
        """Whether so many frames in order have come that none of them can be a late one."""
        if self._back and stamp <= self._back[-1]:
            self._back = []
        self._back.append(stamp)
        return len(self._back) >= _BACK


def _pose_fault(T: Array) -> str:
    if T.shape != (4, 4) or not np.isfinite(T).all():
        return "its pose is not finite"
    R = T[:3, :3]
    if np.abs(R @ R.T - np.eye(3)).max() > _ROTATION_TOLERANCE or np.linalg.det(R) < 0:
        return "its pose is no rigid motion"
    return ""


def usable_points(points: Array, covs: Array) -> BoolArray:
    """Which points (q,) are finite, before the camera, and have a covariance that is one."""
    if len(points) == 0:
        return np.zeros(0, dtype=bool)
    with np.errstate(invalid="ignore"):
        good = (np.abs(points) < _FAR_M).all(1) & (np.abs(covs) < _FAR_M**2).all((1, 2)) & (points[:, 2] > 0)
    safe = np.where(good[:, None, None], covs, np.eye(3))
    symmetric = np.abs(safe - np.swapaxes(safe, 1, 2)).max((1, 2)) <= 1e-6 * np.abs(safe).max((1, 2))
    out: BoolArray = good & symmetric & (np.linalg.eigvalsh(safe)[:, 0] > 0)
    return out
