"""What an emulated arm does: fields recorded over time, and their values in between."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from cluster_slam.geometry import Array
from cluster_slam.sensors.interpolation import interpolate, pose_from_rotation_vector, rotation_vector_from_pose
from cluster_slam.sensors.rtde.fields import type_of
from cluster_slam.sensors.rtde.wire import N_VALUES, Value

_POSES = ("actual_TCP_pose", "target_TCP_pose")
_REAL = ("DOUBLE", "VECTOR3D", "VECTOR6D")


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Fields over time; positions and angles are interpolated, whole numbers keep their last value."""

    times: Array  # (n,) s from 0, strictly increasing, n > 0
    columns: Mapping[str, Array]  # each (n, k) with k as the field's type has it
    goes_back: bool = False  # at the end the way back, and again; else it stays there
    poses: Mapping[str, Array] = field(init=False)  # (n, 4, 4) of the fields that are poses

    def __post_init__(self) -> None:
        poses = {name: pose_from_rotation_vector(self.columns[name]) for name in _POSES if name in self.columns}
        object.__setattr__(self, "poses", poses)

    @property
    def duration_s(self) -> float:
        return float(self.times[-1] - self.times[0])

    def value(self, name: str, time: float) -> Value | None:
        """The value of a field at a time (s from the start); None where it was not recorded."""
        if name not in self.columns:
            return None
        t = self._folded(time)
        kind = type_of(name) or "DOUBLE"
        if name in self.poses:
            T = interpolate(self.times, self.poses[name], np.array([t]))
            return [float(x) for x in rotation_vector_from_pose(T)[0]]
        column = self.columns[name]
        if kind in _REAL:
            row = [float(np.interp(t, self.times, column[:, k])) for k in range(column.shape[1])]
            return row if kind in N_VALUES else row[0]
        i = max(int(np.searchsorted(self.times, t, side="right")) - 1, 0)
        whole = [int(x) for x in column[i]]
        return whole if kind in N_VALUES else whole[0]

    def _folded(self, time: float) -> float:
        """The time in the recording that plays at a time since the start."""
        if self.goes_back and self.duration_s > 0:
            time = time % (2 * self.duration_s)
            time = min(time, 2 * self.duration_s - time)
        return float(self.times[0]) + min(max(time, 0.0), self.duration_s)


def motion_of_poses(stamps: Array, poses: Array, *, goes_back: bool = False) -> Motion:
    """A motion through poses (n, 4, 4) at stamps (n,)."""
    rows = rotation_vector_from_pose(poses)
    return Motion(stamps - stamps[0], {"actual_TCP_pose": rows, "target_TCP_pose": rows}, goes_back)
