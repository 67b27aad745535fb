"""Where the robot was at a stamp of the camera: samples of the controller, on its clock, and the clocks between."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable
from dataclasses import dataclass, field
from enum import Enum

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.sensors.clock import Clock, ClockEstimator
from cluster_slam.sensors.interpolation import interpolate, pose_from_rotation_vector
from cluster_slam.sensors.rtde.link import RobotSample

MAX_GAP_S = 0.1  # between two samples: a longer one and nobody knows where the arm was
_KEPT_S = 30.0  # of samples; a camera that is later than this finds none
_TCP_JUMP_M = 1e-3  # a pose that moves so far while ...
_JOINTS_STILL_RAD = 1e-4  # ... all joints stand: the tool's point was changed, not the arm moved


class PoseState(Enum):
    """Why there is a pose, or why not."""

    KNOWN = "known"
    NOT_YET = "not yet"  # the robot's samples have not come so far
    LOST = "lost"  # the robot was silent then
    TOO_OLD = "too old"  # before the first sample that is kept


@dataclass(frozen=True, slots=True, eq=False)
class PoseAnswer:
    """The pose at a time, where it is known."""

    state: PoseState
    T_world_flange: Array | None = None  # (4, 4)


@dataclass(slots=True, eq=False)
class _Stretch:
    """Samples under one setting of the controller's clock."""

    clock: Clock | None = None  # as last estimated
    stamps: deque[float] = field(default_factory=deque)
    rows: deque[tuple[float, ...]] = field(default_factory=deque)


class RobotPoses:
    """The last half minute of a robot, on this machine's clock."""

    def __init__(self) -> None:
        self._estimator = ClockEstimator()
        self._stretches = [_Stretch()]
        self._last: RobotSample | None = None
        self._joints_move = False  # ever: else they are not told truly, as by a controller that has none

    @property
    def clock(self) -> Clock | None:
        """The controller's clock against this machine's; None before the first sample."""
        return self._estimator.clock

    def add(self, samples: Iterable[RobotSample]) -> list[str]:
        """Take samples in; what they show of clocks and tools, in words."""
        told = []
        for sample in samples:
            stretch = self._stretches[-1]
            if self._estimator.add(sample.stamp, sample.arrival):
                told.append(f"the controller's clock was set: {sample.stamp:.3f} after {stretch.stamps[-1]:.3f} s")
                stretch = _Stretch()
                self._stretches = [self._stretches[-1], stretch]
            stretch.clock = self._estimator.clock
            if self._last is not None and self._is_tool_change(self._last, sample):
                told.append("the pose jumped while the joints stood: was the active TCP changed?")
            self._last = sample
            stretch.stamps.append(sample.stamp)
            stretch.rows.append(sample.pose)
            while stretch.stamps[-1] - stretch.stamps[0] > _KEPT_S:
                stretch.stamps.popleft()
                stretch.rows.popleft()
        return told

    def at(self, time: float) -> PoseAnswer:
        """The pose at a time of this machine's clock, s."""
        for stretch in reversed(self._stretches):
            if stretch.clock is None:
                return PoseAnswer(PoseState.NOT_YET)
            stamp = float(stretch.clock.stamp(np.array([time]))[0])
            if stamp >= stretch.stamps[0]:
                return _between(stretch, stamp, is_last=stretch is self._stretches[-1])
        if len(self._stretches) > 1 and time > self._begin_of_first():
            return PoseAnswer(PoseState.LOST)
        return PoseAnswer(PoseState.TOO_OLD)

    def _is_tool_change(self, before: RobotSample, after: RobotSample) -> bool:
        turned = max(abs(a - b) for a, b in zip(after.joints, before.joints, strict=True))  # NaN without joints
        self._joints_move = self._joints_move or turned > _JOINTS_STILL_RAD
        return self._joints_move and turned < _JOINTS_STILL_RAD and _distance(before, after) > _TCP_JUMP_M

    def _begin_of_first(self) -> float:
        first = self._stretches[0]
        return float("inf") if first.clock is None else float(first.clock.arrival(np.array([first.stamps[0]]))[0])


def _between(stretch: _Stretch, stamp: float, *, is_last: bool) -> PoseAnswer:
    if stamp > stretch.stamps[-1]:
        return PoseAnswer(PoseState.NOT_YET if is_last else PoseState.LOST)
    stamps = np.array(stretch.stamps)
    i = max(int(np.searchsorted(stamps, stamp)), 1)
    if i == len(stamps):  # the only sample, hit exactly
        return PoseAnswer(PoseState.KNOWN, pose_from_rotation_vector(np.array(stretch.rows[0])))
    if stamps[i] - stamps[i - 1] > MAX_GAP_S:
        return PoseAnswer(PoseState.LOST)
    ends = pose_from_rotation_vector(np.array([stretch.rows[i - 1], stretch.rows[i]]))
    return PoseAnswer(PoseState.KNOWN, interpolate(stamps[i - 1 : i + 1], ends, np.array([stamp]))[0])


def _distance(before: RobotSample, after: RobotSample) -> float:
    return float(np.linalg.norm(np.subtract(after.pose[:3], before.pose[:3])))
