"""Calibration of the camera's mounting on the flange, to be read like the method section of a paper."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Literal

import numpy as np

from cluster_slam.errors import InputError
from cluster_slam.geometry import Array, inverse, transform
from cluster_slam.graph.calibration import (
    Mounting,
    StillPoints,
    larger,
    motion_pairs,
    park_martin,
    refine_mounting,
    scatter_of,
)
from cluster_slam.graph.noise import pose_model
from cluster_slam.pipeline.calibrate_report import STILL_RAD, CalibrationReport, excitation_of, report_on
from cluster_slam.pipeline.smooth import smooth
from cluster_slam.records import CLUTTER, IntArray, Result, Session
from cluster_slam.sensors.interpolation import interpolate

Progress = Callable[[str, float], None]
TIME_SIGMA_S = 0.1  # how far the clocks may be apart, one sigma
SCALE_SIGMA = 0.05  # of the depth scale


def calibrate(
    session: Session,
    *,
    time_offset: bool = False,
    depth_scale: bool = False,
    seed: int = 0,
    progress: Progress | None = None,
) -> CalibrationReport:
    """The hand-eye transform of a session from its flowers, whoever they are.

    Parameters
    ----------
    session : with poses of the flange.
    time_offset : find the offset between the clocks of arm and camera too.
    depth_scale : find the scale of the distances too.
    seed : of what is random.
    progress : called with the stage in words and a fraction 0..1.

    Raises
    ------
    InputError
        Poses are not the flange's, or there is nothing to calibrate by.
    """
    _check(session)
    say = progress or (lambda _stage, _fraction: None)
    if (excitation_of(session) < STILL_RAD).all():
        return _unmoved(session, time_offset, depth_scale)
    say("who is who", 0.0)
    result = smooth(session, seed=seed, progress=lambda stage, share: say(stage, 0.45 * share))
    seen, mounting = _refined(session, result, time_offset, depth_scale)
    if time_offset or depth_scale:
        corrected = _corrected(session, mounting)
        again = smooth(corrected, seed=seed, progress=lambda stage, share: say(stage, 0.5 + 0.45 * share))
        seen, rest = _refined(corrected, again, time_offset, depth_scale)
        mounting = replace(
            rest,
            time_offset_s=mounting.time_offset_s + rest.time_offset_s,
            depth_scale=mounting.depth_scale * rest.depth_scale,
        )
        result = again
    if result.calibration is not None and not (time_offset or depth_scale):
        X, cov = result.calibration.T_flange_camera, larger(mounting.cov, result.calibration.cov)
        mounting = replace(mounting, X=X, cov=cov, scatter_m=scatter_of(seen, X))
    unobserved = () if result.calibration is None else result.calibration.unobserved
    return report_on(session, mounting, len(seen.points), unobserved, "flowers", time_offset, depth_scale)


def calibrate_by_board(
    session: Session,
    frame: IntArray,
    label: IntArray,
    points: Array,
    var: Array,
    board: Array,
    *,
    time_offset: bool = False,
    depth_scale: bool = False,
) -> CalibrationReport:
    """The hand-eye transform from a board at rest.

    Parameters
    ----------
    session : with poses of the flange.
    frame, label : (q,) of each corner seen: frame and which corner.
    points : (q, 3) camera, m.
    var : (q,) m^2 an axis.
    board : (n, 4, 4) ``T_camera_board`` of each frame, NaN where it was not seen.
    """
    _check(session, "board")
    there = np.flatnonzero(np.isfinite(board).all((1, 2)))
    if len(there) < 3:
        raise InputError(f"the board was found in {len(there)} pictures, expected at least 3")
    pairs = there[motion_pairs(session.poses[there])]
    if len(pairs) < 2:
        raise InputError("the arm hardly turned while it saw the board: turn it about two axes, 20 degrees or more")
    flange = inverse(session.poses[pairs[:, 0]]) @ session.poses[pairs[:, 1]]
    camera = board[pairs[:, 0]] @ inverse(board[pairs[:, 1]])
    X = park_martin(flange, camera)
    model = pose_model(session)
    seen = _still_points(session, frame, points, var, label)
    mounting = refine_mounting(
        seen,
        X,
        100.0 * np.eye(6) if model.X0 is None else model.cov_hand_eye + 100.0 * np.eye(6),
        time_sigma_s=TIME_SIGMA_S if time_offset else None,
        scale_sigma=SCALE_SIGMA if depth_scale else None,
        start=X,
    )
    return report_on(session, mounting, len(points), (), "board", time_offset, depth_scale)


def _check(session: Session, source: Literal["flowers", "board"] = "flowers") -> None:
    if session.T_flange_camera is None:
        raise InputError(
            f"session {session.id!r} has poses of the camera, expected poses of the flange "
            '(frames.pose = "T_world_flange") to calibrate the mounting'
        )
    if session.pose_error == "odometry":
        raise InputError(f"session {session.id!r} has poses from odometry, expected an arm's absolute poses")
    if source == "flowers" and len(session.observations) == 0:
        raise InputError(f"session {session.id!r} shows no flowers, expected some to calibrate by")


def _refined(session: Session, result: Result, time_offset: bool, depth_scale: bool) -> tuple[StillPoints, Mounting]:
    """The mounting under which the flowers that were found stand still."""
    o = session.observations
    rows = np.flatnonzero(result.flower_ids != CLUTTER)
    if len(rows) < 6:
        raise InputError(f"only {len(rows)} observations could be told apart, expected more to calibrate by")
    _, label = np.unique(result.flower_ids[rows], return_inverse=True)
    model = pose_model(session)
    X = session.T_flange_camera if result.calibration is None else result.calibration.T_flange_camera
    begin = model.X0 if X is None else X
    if begin is None or model.X0 is None:
        raise InputError(f"session {session.id!r} has no hand-eye transform to begin with")
    lever = np.linalg.norm(transform(begin, o.points[rows]), axis=1)
    var = np.trace(o.covs[rows], axis1=1, axis2=2) / 3.0 + model.cov[3, 3] + model.cov[0, 0] * lever**2
    seen = _still_points(session, o.frame[rows], o.points[rows], var, label.astype(np.int64))
    mounting = refine_mounting(
        seen,
        model.X0,
        model.cov_hand_eye,
        start=begin,
        time_sigma_s=TIME_SIGMA_S if time_offset else None,
        scale_sigma=SCALE_SIGMA if depth_scale else None,
    )
    return seen, mounting


def _still_points(session: Session, frame: IntArray, points: Array, var: Array, label: IntArray) -> StillPoints:
    def flange_at(offset: float) -> Array:
        if offset == 0.0:
            return session.poses[frame]
        return interpolate(session.stamps, session.poses, session.stamps + offset)[frame]

    return StillPoints(flange_at, points, var, label, session.stamps[frame])


def _corrected(session: Session, mounting: Mounting) -> Session:
    """The session with the offset of the clocks and the depth scale taken out."""
    poses = interpolate(session.stamps, session.poses, session.stamps + mounting.time_offset_s)
    o = session.observations
    scaled = replace(o, points=o.points * mounting.depth_scale, covs=o.covs * mounting.depth_scale**2)
    return replace(session, poses=poses, observations=scaled)


def _unmoved(session: Session, with_time: bool, with_scale: bool) -> CalibrationReport:
    """Nothing to learn from an arm that did not turn: what was measured before stays."""
    model = pose_model(session)
    if model.X0 is None:
        raise InputError(f"session {session.id!r} has no hand-eye transform to begin with")
    sigma = [TIME_SIGMA_S] * with_time + [SCALE_SIGMA] * with_scale
    cov = np.zeros((6 + len(sigma), 6 + len(sigma)))
    cov[:6, :6] = model.cov_hand_eye
    cov[range(6, len(cov)), range(6, len(cov))] = np.square(sigma)
    unobserved = ("all: the arm did not turn",)
    return report_on(session, Mounting(model.X0, 0.0, 1.0, cov, 0.0), 0, unobserved, "flowers", with_time, with_scale)
