"""How good the located poses of a session are, where its truth is known."""

from __future__ import annotations

from dataclasses import asdict, dataclass

import numpy as np

from cluster_slam.evaluation.trajectory import absolute_error, alignment
from cluster_slam.geometry import Array, inverse, se3_log
from cluster_slam.records import SessionLocalisation, Truth
from tracking.metrics import identity_scores

_NEAR = (0.01, np.pi / 180.0)  # m and rad


@dataclass(frozen=True, slots=True)
class LocalisationMetrics:
    """Of the located frames only, but for ``located``; None where the truth does not tell.

    Where the session does not say where its world lies in the map (``T_map_world``), the poses are first laid onto
    the true ones as well as can be (``is_aligned``): then an error that is common to all of them does not show.
    """

    located: float  # share of all frames
    is_aligned: bool = False
    ate_rmse_m: float | None = None
    ate_rotation_rad: float | None = None
    within_1cm_1deg: float | None = None
    nees_poses: float | None = None  # squared errors over covariances / 6: 1 where covariances are true
    flower_idf1: float | None = None
    cluster_idf1: float | None = None
    clutter_precision: float | None = None
    clutter_recall: float | None = None

    def as_json(self) -> dict[str, float | bool]:
        """What is known, by name."""
        return {name: value for name, value in asdict(self).items() if value is not None}


def evaluate_localisation(found: SessionLocalisation, truth: Truth) -> LocalisationMetrics:
    """Compare the located frames of a session with the truth."""
    here = found.is_located
    values: dict[str, float | bool] = {"located": float(here.mean()) if len(here) else 0.0}
    if not here.any():
        return LocalisationMetrics(**values)  # type: ignore[arg-type]
    if truth.T_world_camera is not None:
        true, estimated = truth.T_world_camera[here], found.T_map_camera[here]
        values["is_aligned"] = truth.T_map_world is None
        T = inverse(alignment(estimated, true)) if truth.T_map_world is None else truth.T_map_world
        values |= _pose_values(estimated, found.covs[here], T @ true)
    return LocalisationMetrics(**values, **_identity_values(found, truth))  # type: ignore[arg-type]


def _pose_values(estimated: Array, covs: Array, true: Array) -> dict[str, float]:
    error = absolute_error(estimated, true)
    return {
        "ate_rmse_m": error.position_m,
        "ate_rotation_rad": error.rotation_rad,
        "within_1cm_1deg": float(is_near(estimated, true).mean()),
        "nees_poses": float(pose_nees(estimated, covs, true).mean() / 6.0),
    }


def is_near(estimated: Array, true: Array) -> Array:
    """Which poses (n,) lie within 1 cm and 1 degree of the true ones (n, 4, 4)."""
    xi = se3_log(inverse(estimated) @ true)
    away = np.linalg.norm(estimated[:, :3, 3] - true[:, :3, 3], axis=1)
    return np.asarray((away < _NEAR[0]) & (np.linalg.norm(xi[:, :3], axis=1) < _NEAR[1]))


def pose_nees(estimated: Array, covs: Array, true: Array) -> Array:
    """Squared errors (n,) of poses over their covariances (n, 6, 6): 6 on average where these are true."""
    xi = se3_log(inverse(estimated) @ true)
    return np.asarray(np.einsum("ni,ni->n", xi, np.linalg.solve(covs, xi[..., None])[..., 0]))


def _identity_values(found: SessionLocalisation, truth: Truth) -> dict[str, float]:
    if truth.flower_ids is None or truth.cluster_ids is None:
        return {}
    rows = found.is_located[found.session.observations.frame]
    if not rows.any():
        return {}
    true, given = truth.flower_ids[rows], found.flower_ids[rows]
    clutter, called = true < 0, given < 0
    both = float((clutter & called).sum())
    values = {
        "flower_idf1": identity_scores(true, given).idf1,
        "cluster_idf1": identity_scores(truth.cluster_ids[rows], found.cluster_ids[rows]).idf1,
    }
    if called.any():
        values["clutter_precision"] = both / float(called.sum())
    if clutter.any():
        values["clutter_recall"] = both / float(clutter.sum())
    return values
