"""A session with odometry as its instruments should have given it: clocks that agree, distances that are what they say.

What the instruments err by shows in the session itself, before anything is matched with the map
(``cluster_slam.association.calibration``). Poses of the corrected session are those of the instants at which the camera
truly looked; ``on_time`` brings what was found back to the stamps.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.association.calibration import calibrate, delayed
from cluster_slam.association.frames import sort_by_frame
from cluster_slam.config import ParticleConfig
from cluster_slam.geometry import Array, adjoint, inverse
from cluster_slam.records import Session


@dataclass(frozen=True, slots=True, eq=False)
class Corrected:
    """A session without the errors of its instruments."""

    session: Session
    since: Array  # (n, 4, 4) motion from when the camera looked to the stamp of the frame

    def on_time(self, i: int, T: Array, cov: Array) -> tuple[Array, Array]:
        """A pose (4, 4) of frame i and its covariance (6, 6), at the frame's stamp."""
        back = adjoint(inverse(self.since[i]))
        return T @ self.since[i], back @ cov @ back.T


def corrected(session: Session) -> Corrected:
    """The session with late clocks and depths taken for ranges put right, where it insists on them."""
    frames = sort_by_frame(session.observations, session.stamps)
    found = calibrate(frames, session.poses, ParticleConfig())
    right = found.correct(frames)
    o = session.observations
    points, covs = np.empty_like(o.points), np.empty_like(o.covs)
    points[frames.order], covs[frames.order] = right.points, right.covs
    poses = delayed(session.poses, session.stamps, found.lag_s)
    changed = replace(session, poses=poses, observations=replace(o, points=points, covs=covs))
    return Corrected(changed, inverse(poses) @ session.poses)
