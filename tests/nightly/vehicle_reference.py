"""A filter for a vehicle on a floor that is told which landmark each point is, and where it began."""

from __future__ import annotations

import numpy as np

from cluster_slam.geometry import Array, se3_log
from cluster_slam.localisation.landmarks import landmarks
from cluster_slam.localisation.motion import motion_of
from cluster_slam.localisation.planar import Flat, flat_world
from cluster_slam.records import Session, Truth

STEP_SCALE = 1.5  # stated sigmas of odometry are taken times this, as ours takes them


def told_filter(session: Session, truth: Truth) -> Array:
    """Poses (n, 4, 4) of a plain extended Kalman filter over x, y and heading, on the session as it was given."""
    assert truth.T_world_camera is not None
    assert truth.rest_positions is not None
    assert truth.rest_cluster_ids is not None
    assert truth.cluster_ids is not None
    motion = motion_of(session)
    flat = flat_world(session, motion, landmarks(truth.rest_positions, truth.rest_cluster_ids))
    assert flat is not None
    turned = flat.map.T @ truth.T_world_camera[0, :3, :3] @ flat.camera
    flat = Flat(flat.camera, flat.map @ np.diag([1.0, *[np.sign(turned[2, 2])] * 2]), flat.origin, flat.height)
    turned = flat.map.T @ truth.T_world_camera[0, :3, :3] @ flat.camera
    places = dict(
        zip(truth.rest_cluster_ids.tolist(), (truth.rest_positions - flat.origin) @ flat.map[:, :2], strict=True)
    )
    begin = flat.map[:, :2].T @ (truth.T_world_camera[0, :3, 3] - flat.origin)
    x, P = np.array([*begin, np.arctan2(turned[1, 0], turned[0, 0])]), 1e-6 * np.eye(3)
    C, o, out = flat.camera, session.observations, []
    for i in range(session.n_frames):
        if i:
            step, cov = motion.camera_step(i - 1, i, None), motion.step_cov(i - 1, i)
            Q = np.diag([*np.diag(C[:, :2].T @ cov[3:, 3:] @ C[:, :2]), C[:, 2] @ cov[:3, :3] @ C[:, 2]])
            x, P = _moved(x, P, C[:, :2].T @ step[:3, 3], float(C[:, 2] @ se3_log(step)[:3]), STEP_SCALE**2 * Q)
        for k in np.flatnonzero(o.frame == i).tolist():
            one = int(truth.cluster_ids[k])
            if one in places:
                x, P = _seen(x, P, places[one], o.points[k] @ C[:, :2], C[:, :2].T @ o.covs[k] @ C[:, :2])
        out.append(flat.pose(x, 1.0, P)[0])
    return np.array(out)


def _turn(heading: float) -> Array:
    c, s = np.cos(heading), np.sin(heading)
    return np.array([[c, -s], [s, c]])


def _moved(x: Array, P: Array, shift: Array, turn: float, Q: Array) -> tuple[Array, Array]:
    R = _turn(x[2])
    F, G = np.eye(3), np.eye(3)
    F[:2, 2] = np.array([[0.0, -1.0], [1.0, 0.0]]) @ R @ shift
    G[:2, :2] = R
    return x + np.array([*(R @ shift), turn]), F @ P @ F.T + G @ Q @ G.T


def _seen(x: Array, P: Array, place: Array, point: Array, S: Array) -> tuple[Array, Array]:
    R = _turn(x[2])
    expected = R.T @ (place - x[:2])
    H = np.column_stack([-R.T, np.array([[0.0, 1.0], [-1.0, 0.0]]) @ expected])
    K = np.linalg.solve(H @ P @ H.T + S, H @ P).T
    P = P - K @ H @ P
    return x + K @ (point - expected), 0.5 * (P + P.T)
