"""A beginning for smoothing where poses drift: what a live tracker makes of the session."""

from __future__ import annotations

import numpy as np

from cluster_slam.association.frames import Frames
from cluster_slam.association.landmarks import group_means
from cluster_slam.association.refine import compact
from cluster_slam.geometry import transform
from cluster_slam.graph.poses import PoseModel
from cluster_slam.graph.variance import VarianceFactors
from cluster_slam.live.replay import Replay
from cluster_slam.online.result import rows_of
from cluster_slam.online.tracker import OnlineTracker
from cluster_slam.pipeline.track import can_be_tracked
from cluster_slam.records import Session
from cluster_slam.smoothing.first import radius_of_pieces, shortest_piece
from cluster_slam.smoothing.world import World, scalar_var


def world_followed_live(session: Session, frames: Frames, model: PoseModel, seed: int) -> World | None:
    """Follow the session frame by frame: each pose is corrected by the landmarks so far, and loops close on the way.

    Pieces are laid upon each other by given poses; these may be off by more than flowers stand apart when the camera
    comes back to a place. A tracker has the error of its way between two looks at a cluster alone.

    Parameters
    ----------
    session : its poses are odometry.
    frames, model : the same session, as it is smoothed.
    seed : of what is random (K-means only).

    Returns
    -------
    World | None
        None where the camera's mount is not known well enough to follow, or where no flower was seen again.
    """
    if not can_be_tracked(session):
        return None
    tracker = OnlineTracker(session.noise, session.T_flange_camera, pose_error=session.pose_error, seed=seed)
    updates = [tracker.step(frame) for frame in Replay(session).frames()]
    table = tracker.world.flowers
    rows = np.flatnonzero(table.confirmed)
    if len(rows) == 0:
        return None
    landmark = rows_of(np.concatenate([u.flower_ids for u in updates]), table.ids[rows], tracker)
    keep = np.bincount(landmark[landmark >= 0], minlength=len(rows)) > 0
    landmark, rows = compact(keep, landmark), rows[keep]
    T = np.array([u.T_world_camera for u in updates])
    seen, var = transform(T[frames.frame], frames.points), scalar_var(frames, model)
    return World(
        T=T,
        X=tracker.X,
        landmark=landmark,
        places=group_means(seen, var, landmark, len(rows)).mean,
        cluster=np.unique(table.slot[rows], return_inverse=True)[1],
        radius=radius_of_pieces(frames, seen, var, landmark, shortest_piece(frames)),
        noise=VarianceFactors(tracker.noise_watch.factor, 1.0, 1.0),
        held=np.zeros((6, 6)),
    )
