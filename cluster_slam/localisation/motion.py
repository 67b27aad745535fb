"""How the camera moves between frames, as far as a session's poses tell: relative motion only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, adjoint, inverse
from cluster_slam.graph.noise import pose_model
from cluster_slam.records import Session


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """Given poses with what they err: each for itself (``cov``), or from one to the next (``cov_step``)."""

    stamps: Array  # (n,) s
    given: Array  # (n, 4, 4) T_world_flange (with X0) or T_world_camera
    cov: Array  # (6, 6)
    cov_step: Array | None  # (n - 1, 6, 6), None: the poses are absolute
    X0: Array | None  # (4, 4) T_flange_camera, None where poses are the camera's
    cov_hand_eye: Array  # (6, 6)

    @property
    def is_odometry(self) -> bool:
        return self.cov_step is not None

    def camera_in_world(self, i: int, X: Array | None) -> Array:
        """``T_world_camera`` (4, 4) of frame i as the poses have it."""
        given: Array = self.given[i]
        return given if X is None else given @ X

    def camera_step(self, a: int, b: int, X: Array | None) -> Array:
        """Motion (4, 4) of the camera from frame a to frame b, ``T_camera[a]_camera[b]``."""
        return inverse(self.camera_in_world(a, X)) @ self.camera_in_world(b, X)

    def step_cov(self, a: int, b: int) -> Array:
        """Covariance (6, 6) of the given motion from frame a to frame b with odometry, tangent at the end."""
        if b < a:
            back = adjoint(inverse(self.given[b]) @ self.given[a])
            return back @ self.step_cov(b, a) @ back.T
        if self.cov_step is None:
            raise ValueError("absolute poses have no steps")
        total = np.zeros((6, 6))
        for k in range(a, b):
            rest = adjoint(inverse(self.given[b]) @ self.given[k + 1])
            total = total + rest @ self.cov_step[k] @ rest.T
        return total


def motion_of(session: Session) -> Motion:
    """What a session says of the camera's motion."""
    model = pose_model(session)
    return Motion(session.stamps, model.given, model.cov, model.cov_step, model.X0, model.cov_hand_eye)
