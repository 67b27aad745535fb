"""A session with odometry as its instruments should have given it: clocks that agree, distances that are what they say.

What the instruments err by shows in the session itself, before anything is matched with the map
(``cluster_slam.association.calibration``). Poses of the corrected session are where odometry was as the camera looked:
a frame's pose is that of the camera at its stamp, so a clock of odometry that is ahead must not move it.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from cluster_slam.association.calibration import calibrate, delayed
from cluster_slam.association.frames import sort_by_frame
from cluster_slam.config import ParticleConfig
from cluster_slam.records import Session


def corrected(session: Session) -> Session:
    """The session with late clocks and depths taken for ranges put right, where it insists on them."""
    frames = sort_by_frame(session.observations, session.stamps)
    found = calibrate(frames, session.poses, ParticleConfig())
    right = found.correct(frames)
    o = session.observations
    points, covs = np.empty_like(o.points), np.empty_like(o.covs)
    points[frames.order], covs[frames.order] = right.points, right.covs
    poses = delayed(session.poses, session.stamps, found.lag_s)
    return replace(session, poses=poses, observations=replace(o, points=points, covs=covs))
