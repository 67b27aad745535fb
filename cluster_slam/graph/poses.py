"""What is known of the poses before anything is seen, linearised at an estimate."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from cluster_slam.geometry import Array, adjoint, inverse, se3_log

_TIGHT = 1e12  # 1 / m^2 and 1 / rad^2: with odometry the first pose defines the world


@dataclass(frozen=True, slots=True, eq=False)
class PoseModel:
    """What is known of the poses. ``given`` (n, 4, 4) are the flange's (with ``X0``) or the camera's (``X0`` None).

    ``cov`` (6, 6): each pose for itself; ``cov_step`` (n - 1, 6, 6): odometry from frame to frame (None: absolute).
    ``cov_hand_eye`` (6, 6): the prior of the hand-eye tangent.
    """

    given: Array
    cov: Array
    cov_step: Array | None
    X0: Array | None
    cov_hand_eye: Array


@dataclass(frozen=True, slots=True, eq=False)
class PosePrior:
    """Information and its vector of the tangents z of n poses and x of the hand-eye transform, k = 6, or 0 without.

    With a ``chain`` that of y = z - x: x moves all poses of the camera, and steps of the flange do not see it. In z
    and x the same would be differences of large numbers, where a vehicle's steps are known next to exactly.
    """

    z_information: Array  # (n, 6, 6)
    z_vector: Array  # (n, 6)
    chain: Array | None  # (n - 1, 6, 6) of each pose with the next
    zx_information: Array  # (n, 6, k)
    x_information: Array  # (k, k)
    x_vector: Array  # (k,)


def pose_prior(model: PoseModel, lever: Array, T: Array, X: Array | None) -> PosePrior:
    """At poses T (n, 4, 4) and hand-eye transform X; ``lever`` (6, 6) brings errors of given poses to the camera."""
    predicted = model.given if X is None else model.given @ X
    k = 0 if X is None else 6
    x_information: Array = np.zeros((k, k))
    x_vector: Array = np.zeros(k)
    if X is not None and model.X0 is not None:
        x_information = np.asarray(np.linalg.inv(model.cov_hand_eye), dtype=np.float64)
        x_vector = -x_information @ se3_log(inverse(model.X0) @ X)
    if model.cov_step is not None:
        tied = _odometry(predicted, lever @ model.cov_step @ lever.T, T, k)
        return replace(tied, x_information=x_information, x_vector=x_vector)
    W = np.linalg.inv(lever @ model.cov @ lever.T)
    error = se3_log(inverse(predicted) @ T)
    by_x = np.zeros((len(T), 6, 0)) if X is None else -adjoint(inverse(T) @ predicted)
    zx_information = W @ by_x
    return PosePrior(
        z_information=np.broadcast_to(W, (len(T), 6, 6)),
        z_vector=-error @ W,
        chain=None,
        zx_information=zx_information,
        x_information=x_information + np.einsum("nai,naj->ij", by_x, zx_information),
        x_vector=x_vector - np.einsum("nai,na->i", zx_information, error),
    )


def _odometry(predicted: Array, cov_step: Array, T: Array, k: int) -> PosePrior:
    """The first pose defines the world, each step (n - 1, 6, 6) of the camera ties two poses.

    Of the flange's poses both depend on the hand-eye transform, k = 6: T_0 = F_0 X, and a step is X^-1 D X. The
    camera's tangents are z = y + x with y the flange's, brought to the camera; of x by itself odometry says nothing.
    """
    step = np.linalg.inv(cov_step)
    now = inverse(T[:-1]) @ T[1:]
    error = se3_log(inverse(inverse(predicted[:-1]) @ predicted[1:]) @ now)
    by_first = -adjoint(inverse(now))
    chain = np.swapaxes(by_first, 1, 2) @ step
    information, vector = np.zeros((len(T), 6, 6)), np.zeros((len(T), 6))
    information[0] = _TIGHT * np.eye(6)
    vector[0] = -_TIGHT * se3_log(inverse(predicted[0]) @ T[0])
    information[1:] += step
    information[:-1] += chain @ by_first
    vector[1:] -= (step @ error[..., None])[..., 0]
    vector[:-1] -= (chain @ error[..., None])[..., 0]
    return PosePrior(information, vector, chain, np.zeros((len(T), 6, k)), np.zeros((k, k)), np.zeros(k))
