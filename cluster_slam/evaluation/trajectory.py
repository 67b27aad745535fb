"""Errors of trajectories and of the hand-eye transform."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, inverse, kabsch, se3_exp, se3_log, so3_log, transform
from cluster_slam.records import Session, Truth

_RANK_TOLERANCE = 1e-6  # second extent of a path over its first, below which positions do not fix a rotation
_RPE_INTERVAL_S = 1.0
_RPE_SLACK = 1.5  # pairs of frames further apart than this times the interval are left out


@dataclass(frozen=True, slots=True)
class TrajectoryError:
    """Root mean square errors of camera poses: position in metres, rotation (geodesic) in radians."""

    position_m: float
    rotation_rad: float


def absolute_error(estimated: Array, true: Array) -> TrajectoryError:
    """Errors of poses (n, 4, 4) as they are, in one frame."""
    position = np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=-1)
    rotation = np.linalg.norm(so3_log(np.swapaxes(true[:, :3, :3], -1, -2) @ estimated[:, :3, :3]), axis=-1)
    return TrajectoryError(_rms(position), _rms(rotation))


def alignment(estimated: Array, true: Array) -> Array:
    """Rigid motion T (4, 4) that takes the estimated positions onto the true ones best (Umeyama 1991, no scale).

    Where the positions lie on a line or a point they leave the rotation open: then the mean difference of the
    orientations fixes it.
    """
    a, b = estimated[:, :3, 3], true[:, :3, 3]
    extents = np.linalg.svd(a - a.mean(0), compute_uv=False)
    if len(extents) > 1 and extents[1] > _RANK_TOLERANCE * max(extents[0], 1e-12):
        return kabsch(a, b)
    U, _, Vt = np.linalg.svd((true[:, :3, :3] @ np.swapaxes(estimated[:, :3, :3], -1, -2)).sum(0))
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    T[:3, 3] = b.mean(0) - T[:3, :3] @ a.mean(0)
    return T


def relative_error(estimated: Array, true: Array, stamps: Array) -> TrajectoryError | None:
    """Errors of the motion over one second (Sturm 2012, equation 2); None where no two frames are that far apart."""
    later = np.searchsorted(stamps, stamps + _RPE_INTERVAL_S - 1e-9)
    first = np.flatnonzero(later < len(stamps))
    later = later[first]
    close = stamps[later] - stamps[first] <= _RPE_SLACK * _RPE_INTERVAL_S
    i, j = first[close], later[close]
    if not len(i):
        return None
    return absolute_error(inverse(estimated[i]) @ estimated[j], inverse(true[i]) @ true[j])


@dataclass(frozen=True, slots=True, eq=False)
class HandEyeTruth:
    """The true hand-eye transform, and how well it is known."""

    T_flange_camera: Array  # (4, 4)
    cov: Array  # (6, 6) of the tangent on the right; zero where truth states the transform. Estimates that were made
    # from the same given poses share this error: all their errors in common look like another mounting.


def hand_eye_truth(session: Session, truth: Truth) -> HandEyeTruth | None:
    """The true hand-eye transform as truth states it, else as true camera poses and given flange poses have it.

    The mean of ``inverse(T_world_flange[k]) @ T_world_camera[k]`` over frames, taken in the tangent space; its
    covariance is that of the sample over n. None where poses are the camera's, or drift (then each frame would have
    another transform).
    """
    if truth.T_flange_camera is not None:
        return HandEyeTruth(truth.T_flange_camera, np.zeros((6, 6)))
    if truth.T_world_camera is None or session.pose_frame != "T_world_flange" or session.pose_error != "absolute":
        return None
    known = np.isfinite(truth.T_world_camera).all((1, 2))
    samples = inverse(session.poses[known]) @ truth.T_world_camera[known]
    if len(samples) < 2:
        return None
    mean = samples[0]
    for _ in range(5):  # converges quadratically from a spread of milliradians
        mean = mean @ se3_exp(se3_log(inverse(mean) @ samples).mean(0))
    return HandEyeTruth(mean, np.atleast_2d(np.cov(se3_log(inverse(mean) @ samples).T)) / len(samples))


def aligned(T: Array, poses: Array) -> Array:
    """Poses (n, 4, 4) after a rigid motion of their frame."""
    return T @ poses


def align_points(points: Array, onto: Array) -> Array:
    """Points (n, 3) after the rigid motion that brings them onto others best; as they are where fewer than 3."""
    return transform(kabsch(points, onto), points) if len(points) >= 3 else points


def _rms(values: Array) -> float:
    return float(np.sqrt((values * values).mean()))
