"""What is known of the poses of a session, as covariances of tangent vectors."""

from __future__ import annotations

import numpy as np

from cluster_slam.geometry import Array, adjoint, inverse, se3_log
from cluster_slam.graph.poses import PoseModel
from cluster_slam.records import Session, StatedNoise

_GAP = 1.5  # usual intervals; odometry over a longer one has not seen the way
_LEAST_SIGMA = 1e-7  # m or rad: a pose that is stated exact still has an invertible covariance


def pose_model(session: Session) -> PoseModel:
    """The poses of a session with what they are stated to err."""
    noise = session.noise
    step = None
    if session.pose_error == "odometry":
        moved = se3_log(inverse(session.poses[:-1]) @ session.poses[1:])
        turned = np.linalg.norm(moved[:, :3], axis=1)
        travelled = np.linalg.norm(moved[:, 3:], axis=1)
        step = _step_covs(turned, travelled, np.diff(session.stamps), noise)
        axis = planar_axis(moved)
        if axis is not None:
            step = _in_plane(step, axis)
    return PoseModel(
        given=session.poses,
        cov=_diagonal(np.array(noise.pose_rotation), np.array(noise.pose_translation)),
        cov_step=step,
        X0=session.T_flange_camera,
        cov_hand_eye=_diagonal(np.array(noise.hand_eye_rotation), np.array(noise.hand_eye_translation)),
    )


def _step_covs(turned: Array, travelled: Array, dt: Array, noise: StatedNoise) -> Array:
    """Covariances (s, 6, 6) of steps that turned (s,) rad and travelled (s,) m in dt (s,) s.

    Over a gap only the net motion is known, and the way may have been longer: it is taken to have turned and travelled
    at the session's usual rate, and the part that is always there to have been there once for each usual step. A
    turning error moves the end of the way too: by its root mean square over the way, s / sqrt(3).
    """
    usual = float(np.median(dt)) if len(dt) else 1.0
    short = dt <= _GAP * usual
    gap = np.where(short, 0.0, dt)
    turned = np.hypot(turned, gap * turned[short].sum() / dt[short].sum())
    travelled = np.hypot(travelled, gap * travelled[short].sum() / dt[short].sum())
    times = np.sqrt(np.where(short, 1.0, dt / usual))
    rotation = np.hypot(noise.pose_rotation * times, noise.odometry_rotation * turned)
    translation = np.hypot(noise.pose_translation * times, noise.odometry_translation * travelled)
    return _diagonal(rotation, np.hypot(translation, rotation * travelled / np.sqrt(3.0)))


def planar_axis(moved: Array, tolerance: float = 1e-5) -> Array | None:
    """Axis (3,) about which all motions (n, 6) turn and across which all move: a vehicle on a floor; None if none.

    Only poses that were computed in a plane pass so exactly; a measured 3-D motion never does.
    """
    size = np.abs(moved).max(initial=0.0)
    if size == 0.0:
        return None
    axis = np.linalg.svd(moved[:, :3], full_matrices=False)[2][0]
    off = np.concatenate([moved[:, :3] - np.outer(moved[:, :3] @ axis, axis), (moved[:, 3:] @ axis)[:, None]], axis=1)
    return axis if np.abs(off).max() < tolerance * size else None


def _in_plane(cov: Array, axis: Array) -> Array:
    """Covariances (n, 6, 6) with the motions out of the plane of ``axis`` known to all but a rest."""
    along = np.outer(axis, axis)
    keep = np.zeros((6, 6))
    keep[:3, :3], keep[3:, 3:] = along, np.eye(3) - along
    rest: Array = keep @ cov @ keep.T + _LEAST_SIGMA**2 * np.eye(6)
    return rest


def camera_covs(model: PoseModel, X: Array | None) -> tuple[Array, Array | None]:
    """Pose covariance (6, 6) and step covariances (n - 1, 6, 6) moved from the flange's frame into the camera's."""
    if X is None:
        return model.cov, model.cov_step
    A = adjoint(inverse(X))
    step = None if model.cov_step is None else A @ model.cov_step @ A.T
    return A @ model.cov @ A.T, step


def _diagonal(sigma_rotation: Array, sigma_translation: Array) -> Array:
    """Diagonal covariances (..., 6, 6) with a rotation part and a translation part."""
    sigma = np.stack([sigma_rotation] * 3 + [sigma_translation] * 3, axis=-1)
    return np.maximum(sigma, _LEAST_SIGMA)[..., None] ** 2 * np.eye(6)
