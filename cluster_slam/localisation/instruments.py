"""A session with odometry as its instruments should have given it, and which of its points repeat each other.

What the instruments err by shows in the session itself, before anything is matched with the map
(``cluster_slam.association.calibration``): a clock of odometry that is ahead, a depth taken for a range. Poses of the
corrected session are where odometry was as the camera looked: a frame's pose is that of the camera at its stamp.

Points of successive frames that stay together, odometry taken out, are pieces of one landmark's history, and their
errors are alike for seconds: a hundred sightings of a landmark say hardly more of where the vehicle is than a few.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.association.calibration import calibrate, delayed, follow_points
from cluster_slam.association.frames import sort_by_frame
from cluster_slam.config import ParticleConfig
from cluster_slam.geometry import Array
from cluster_slam.records import IntArray, Session

_PATIENCE = 5.0  # usual steps for which a piece waits for its next point
_ALIKE, _ALIKE_S = 0.8, 10.0  # correlation of the errors of points that follow each other at once, and for how long


@dataclass(frozen=True, slots=True, eq=False)
class Instruments:
    """A session without the errors of its instruments."""

    session: Session
    news: Array  # (m,) of each observation: as so much of an independent one it counts


def put_right(session: Session) -> Instruments:
    """The session with late clocks and depths taken for ranges put right, where it insists on them."""
    frames = sort_by_frame(session.observations, session.stamps)
    found = calibrate(frames, session.poses, ParticleConfig())
    right = found.correct(frames)
    poses = delayed(session.poses, session.stamps, found.lag_s)
    usual = float(np.median(np.diff(session.stamps))) if session.n_frames > 1 else 1.0
    piece = follow_points(right, poses, _PATIENCE * usual)
    o = session.observations
    points, covs, news = np.empty_like(o.points), np.empty_like(o.covs), np.empty(len(o.points))
    points[frames.order], covs[frames.order] = right.points, right.covs
    news[frames.order] = news_of(piece, frames.stamps[frames.frame])
    return Instruments(replace(session, poses=poses, observations=replace(o, points=points, covs=covs)), news)


def news_of(piece: IntArray, times: Array) -> Array:
    """What each point (m,) counts for: one for the first of a piece, less for those that follow it closely.

    Errors of a piece's points are taken for a Markov chain: a point that correlates with the one before by c adds
    (1 - c) / (1 + c) of an independent one to what is known of a place that stays.
    """
    order = np.lexsort((times, piece))
    same = piece[order][1:] == piece[order][:-1]
    alike = _ALIKE * np.exp(-np.diff(times[order]) / _ALIKE_S)
    out = np.ones(len(piece))
    out[order[1:]] = np.where(same, (1.0 - alike) / (1.0 + alike), 1.0)
    return out
