"""All metrics of a result, as ``metrics.json`` holds them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace

import numpy as np

from cluster_slam.evaluation.landmarks import (
    LandmarkErrors,
    cluster_errors,
    flower_errors,
    ghost_clusters,
    matched_rest,
    normalised_squared,
)
from cluster_slam.evaluation.trajectory import (
    absolute_error,
    align_points,
    aligned,
    alignment,
    hand_eye_truth,
    relative_error,
)
from cluster_slam.geometry import Array, inverse, se3_log, so3_log
from cluster_slam.records import CLUTTER, IntArray, Result, Session, Truth
from tracking.consistency import mean_band
from tracking.metrics import IdentityScores, hota, identity_scores

_OFTEN = 60  # frames that saw a flower, from which it counts as well observed


@dataclass(frozen=True, slots=True)
class Metrics:
    """A result against the truth; None where the truth for it is missing.

    Trajectory: ``ate_rmse_m`` and ``ate_rotation_rad`` after rigid alignment of the positions, as the field reports
    them; ``*_unaligned`` as they are in ``world``; ``*_given`` the aligned error of the poses that came in. ``rpe_*``:
    over one second. Landmarks: matched by identity, unaligned in ``world`` unless the name says aligned. ``nees_*``:
    mean of e' S^-1 e / dimension, 1 where covariances are true; ``nees_*_low`` and ``high``: where 95 % of such means
    lie if they are (common errors make them spread wider). ``clutter_*``: precision and recall of the label -1.
    ``coverage_*``: shares inside the ellipsoids of the probabilities ``landmarks.NOMINAL``; not in ``metrics.json``.
    """

    ate_rmse_m: float | None = None
    ate_rotation_rad: float | None = None
    ate_rmse_unaligned_m: float | None = None
    ate_rotation_unaligned_rad: float | None = None
    ate_rmse_given_m: float | None = None
    ate_rotation_given_rad: float | None = None
    rpe_translation_m: float | None = None
    rpe_rotation_rad: float | None = None
    cluster_idf1: float | None = None
    flower_idf1: float | None = None
    cluster_hota: float | None = None
    flower_hota: float | None = None
    flower_deta: float | None = None
    flower_assa: float | None = None
    clutter_precision: float | None = None
    clutter_recall: float | None = None
    n_flowers_true: int | None = None
    n_flowers_found: int | None = None
    n_ghost_flowers: int | None = None
    n_clusters_true: int | None = None
    n_clusters_found: int | None = None
    n_ghost_clusters: int | None = None
    flower_rmse_m: float | None = None
    flower_rmse_aligned_m: float | None = None
    flower_median_m: float | None = None
    flower_rmse_60_m: float | None = None
    cluster_rmse_m: float | None = None
    n_flowers_compared: int | None = None
    n_clusters_compared: int | None = None
    nees_flowers: float | None = None
    nees_clusters: float | None = None
    nees_flowers_median: float | None = None
    inside95_flowers: float | None = None
    inside95_clusters: float | None = None
    hand_eye_m: float | None = None
    hand_eye_rad: float | None = None
    hand_eye_given_m: float | None = None
    hand_eye_given_rad: float | None = None
    nees_hand_eye: float | None = None
    nees_flowers_low: float | None = None
    nees_flowers_high: float | None = None
    nees_clusters_low: float | None = None
    nees_clusters_high: float | None = None
    coverage_flowers: tuple[float, ...] | None = None
    coverage_clusters: tuple[float, ...] | None = None

    def as_json(self) -> dict[str, float]:
        """The metrics that are known, in the order above; what is not finite is left out."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if not f.name.startswith("coverage")}
        return {name: value for name, value in values.items() if value is not None and np.isfinite(value)}


def evaluate(result: Result, session: Session, truth: Truth) -> Metrics:
    """Compare a result with the truth of its session.

    Parameters
    ----------
    result : Result
        What ``smooth`` or ``track`` gave.
    session : Session
        The session it was made from: given poses and stated hand-eye transform.
    truth : Truth
        Any part may be missing; what depends on it is then None.
    """
    metrics = _trajectory(Metrics(), result, session, truth)
    metrics = _hand_eye(metrics, result, session, truth)
    if truth.flower_ids is None:
        return metrics
    matching = identity_scores(truth.flower_ids, result.flower_ids)
    metrics = _labels(metrics, matching, result, truth, truth.flower_ids)
    return _landmarks(metrics, matching, result, truth)


def _trajectory(metrics: Metrics, result: Result, session: Session, truth: Truth) -> Metrics:
    if truth.T_world_camera is None:
        return metrics
    known = np.isfinite(truth.T_world_camera).all((1, 2))
    if not known.any():
        return metrics
    true, estimated, given = truth.T_world_camera[known], result.T_world_camera[known], session.T_world_camera[known]
    best = absolute_error(aligned(alignment(estimated, true), estimated), true)
    before = absolute_error(aligned(alignment(given, true), given), true)
    plain = absolute_error(estimated, true)
    relative = relative_error(estimated, true, session.stamps[known])
    return replace(
        metrics,
        ate_rmse_m=best.position_m,
        ate_rotation_rad=best.rotation_rad,
        ate_rmse_unaligned_m=plain.position_m,
        ate_rotation_unaligned_rad=plain.rotation_rad,
        ate_rmse_given_m=before.position_m,
        ate_rotation_given_rad=before.rotation_rad,
        rpe_translation_m=relative.position_m if relative else None,
        rpe_rotation_rad=relative.rotation_rad if relative else None,
    )


def _hand_eye(metrics: Metrics, result: Result, session: Session, truth: Truth) -> Metrics:
    true = hand_eye_truth(session, truth)
    if true is None or session.T_flange_camera is None:
        return metrics
    given = inverse(true.T_flange_camera) @ session.T_flange_camera
    metrics = replace(metrics, hand_eye_given_m=_norm(given[:3, 3]), hand_eye_given_rad=_norm(so3_log(given[:3, :3])))
    if result.calibration is None:
        return metrics
    difference = inverse(true.T_flange_camera) @ result.calibration.T_flange_camera
    xi = se3_log(difference)
    # A truth that is known from the given poses errs by their mean error, and the estimate errs by the same.
    # Where the estimate claims to be surer than that, truth cannot judge it.
    nees = float(normalised_squared(xi[None], (result.calibration.cov - true.cov)[None])[0] / 6.0)
    judged = nees if np.isfinite(nees) else None
    return replace(metrics, hand_eye_m=_norm(difference[:3, 3]), hand_eye_rad=_norm(xi[:3]), nees_hand_eye=judged)


def _labels(
    metrics: Metrics, matching: IdentityScores, result: Result, truth: Truth, true_flowers: IntArray
) -> Metrics:
    flower = hota(true_flowers, result.flower_ids)
    called, clutter = result.flower_ids == CLUTTER, true_flowers == CLUTTER
    n_both = int((called & clutter).sum())
    n_true = len(np.unique(true_flowers[~clutter]))
    metrics = replace(
        metrics,
        flower_idf1=matching.idf1,
        flower_hota=flower.hota,
        flower_deta=flower.detection,
        flower_assa=flower.association,
        clutter_precision=n_both / int(called.sum()) if called.any() else 1.0,
        clutter_recall=n_both / int(clutter.sum()) if clutter.any() else 1.0,
        n_flowers_true=n_true,
        n_flowers_found=len(matching.true_ids),
        n_ghost_flowers=len(result.flowers) - int(np.isin(result.flowers.ids, matching.estimated_ids).sum()),
        n_ghost_clusters=len(ghost_clusters(result.clusters, result.flowers, matching)),
    )
    if truth.cluster_ids is None:
        return metrics
    clusters = identity_scores(truth.cluster_ids, result.cluster_ids)
    return replace(
        metrics,
        cluster_idf1=clusters.idf1,
        cluster_hota=hota(truth.cluster_ids, result.cluster_ids).hota,
        n_clusters_true=len(np.unique(truth.cluster_ids[truth.cluster_ids != CLUTTER])),
        n_clusters_found=len(clusters.true_ids),
    )


def _landmarks(metrics: Metrics, matching: IdentityScores, result: Result, truth: Truth) -> Metrics:
    rest = matched_rest(result.flowers, matching, truth)
    flowers = flower_errors(result.flowers, rest)
    clusters = cluster_errors(result.clusters, result.flowers, rest)
    if not len(flowers):
        return metrics
    often = flowers.norms[result.flowers.n_observations[flowers.index] >= _OFTEN]
    moved = align_points(result.flowers.positions[flowers.index], flowers.true_positions) - flowers.true_positions
    metrics = replace(
        metrics,
        n_flowers_compared=len(flowers),
        flower_rmse_m=_rms(flowers),
        flower_rmse_aligned_m=float(np.sqrt((moved * moved).sum(-1).mean())),
        flower_median_m=float(np.median(flowers.norms)),
        flower_rmse_60_m=float(np.sqrt((often * often).mean())) if len(often) else None,
        nees_flowers=float(flowers.nees.mean()),
        nees_flowers_median=float(np.median(flowers.nees)),
        inside95_flowers=flowers.inside95,
        n_clusters_compared=len(clusters),
        nees_flowers_low=(band := mean_band(3, len(flowers))).low / 3.0,
        nees_flowers_high=band.high / 3.0,
        coverage_flowers=flowers.coverage,
    )
    if not len(clusters):
        return metrics
    return replace(
        metrics,
        cluster_rmse_m=_rms(clusters),
        nees_clusters=float(clusters.nees.mean()),
        inside95_clusters=clusters.inside95,
        nees_clusters_low=(band := mean_band(3, len(clusters))).low / 3.0,
        nees_clusters_high=band.high / 3.0,
        coverage_clusters=clusters.coverage,
    )


def _rms(errors: LandmarkErrors) -> float:
    return float(np.sqrt((errors.norms * errors.norms).mean()))


def _norm(vector: Array) -> float:
    return float(np.linalg.norm(vector))
