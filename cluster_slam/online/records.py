"""What one step of the live tracker says."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from cluster_slam.geometry import Array
from cluster_slam.records import IntArray, State

Subject = Literal["cluster", "flower", "hand_eye"]
RevisionKind = Literal["confirmed", "lost", "returned", "merged", "moved", "forgotten", "undone", "calibrated"]


@dataclass(frozen=True, slots=True)
class Revision:
    """Something that is known better than a frame ago: ids of clusters (or flowers) before and after, and why."""

    kind: RevisionKind
    subject: Subject
    before: int
    after: int
    reason: str


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """All living clusters as they are at one instant."""

    ids: IntArray  # (c,)
    positions: Array  # (c, 3) centroid, world, m
    velocities: Array  # (c, 3) m/s
    covs: Array  # (c, 6, 6) of position and velocity
    scales: Array  # (c,) relative to the shape at rest
    states: tuple[State, ...]  # (c,)
    motions: tuple[str, ...]  # (c,) rest, sway or growth
    reasons: tuple[str, ...]  # (c,) why this motion
    n_flowers: IntArray  # (c,)
    seen: IntArray  # (c,) flowers of it seen in this frame

    def __len__(self) -> int:
        return len(self.ids)


@dataclass(frozen=True, slots=True, eq=False)
class Update:
    """What is known when one frame has just been processed."""

    stamp: float  # s
    is_accepted: bool  # False: the frame was refused, nothing has changed
    reason: str  # why it was refused, or empty
    T_world_camera: Array  # (4, 4)
    pose_cov: Array  # (6, 6) of its tangent
    flower_ids: IntArray  # (q,) of each point of the frame, -1 clutter
    cluster_ids: IntArray  # (q,)
    reasons: IntArray  # (q,) RejectReason
    nis: Array  # (q,) chi-square of each accepted point, 3 degrees of freedom, NaN else
    tracks: Tracks
    revisions: tuple[Revision, ...]
    warnings: tuple[str, ...]
