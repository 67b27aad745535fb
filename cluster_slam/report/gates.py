"""Each gate of the association put to the test: how probable it says that its true matches are.

Matches of a session that was smoothed are known, so for each gate the chi-square of every match is turned into the
probability of a smaller one. Where the gate's covariance is true these probabilities are uniform, and a gate of 95 %
lets 95 % of them pass.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields

import numpy as np

from cluster_slam.association.depth_noise import NoiseShape, expected_depth
from cluster_slam.geometry import Array, rotate_cov
from cluster_slam.records import IntArray, Result

_FEWEST, _MOST = 3, 6  # members that are seen together; larger clusters are judged by their first ones
_SAMPLES = 400  # views of each number of members, evenly over the session


@dataclass(frozen=True, slots=True, eq=False)
class GateTest:
    """Of one gate: probability (m,) of a smaller chi-square, by its own covariance, for every true match."""

    name: str
    probability: Array


@dataclass(frozen=True, slots=True, eq=False)
class _Views:
    """Clusters of which k members were seen in one frame: as seen, in the world, and as mapped, with covariances.

    Those of the map are what detections of each flower average out to: errors that a whole cluster shares (of the
    hand-eye transform, of the world) change neither descriptor nor shape.
    """

    seen: Array  # (v, k, 3) m
    seen_covs: Array  # (v, k, 3, 3)
    mapped: Array  # (v, k, 3)
    mapped_covs: Array  # (v, k, 3, 3)


def gate_tests(result: Result) -> tuple[GateTest, ...]:
    """Of the position of each detection, of the descriptor and of the full geometry of each view of a cluster."""
    from scipy.stats import chi2

    nis = result.diagnostics.nis[np.isfinite(result.diagnostics.nis)]
    if len(nis) <= len(result.flowers):
        return ()
    tests = [GateTest("position", chi2.cdf(nis, 3))]
    views = list(_views(result)) if np.isfinite(result.session.observations.covs).all() else []
    if views:  # a result folder alone does not hold the covariances of detections
        tests.append(GateTest("descriptor", np.concatenate([chi2.cdf(_descriptor_chi2(v), 2) for v in views])))
        tests.append(GateTest("full geometry", np.concatenate([chi2.cdf(*_geometry_chi2(v)) for v in views])))
    return tuple(tests)


def _descriptor_chi2(views: _Views) -> Array:
    """Of the descriptor as seen against what the map and the noise lead one to expect (v,), two degrees of freedom."""
    from cluster_slam.descriptors import descriptor_moments, inertia_and_mean_distance
    from tracking.gating import mahalanobis_sq

    mean, cov = descriptor_moments(views.mapped, _joint(views.mapped_covs + views.seen_covs))
    return mahalanobis_sq(inertia_and_mean_distance(views.seen) - mean, cov)


def _geometry_chi2(views: _Views) -> tuple[Array, Array]:
    """What the best rigid motion leaves (v,), and its degrees of freedom (v,)."""
    from cluster_slam.descriptors.alignment import align

    left = align(views.mapped, _joint(views.mapped_covs), views.seen, _joint(views.seen_covs))
    return left.distance_sq, left.dof


def _joint(covs: Array) -> Array:
    """Covariances (v, 3 k, 3 k) of independent members (v, k, 3, 3)."""
    v, k = covs.shape[:2]
    out = np.zeros((v, k, 3, k, 3))
    for i in range(k):
        out[:, i, :, i] = covs[:, i]
    return out.reshape(v, 3 * k, 3 * k)


def _views(result: Result) -> Iterator[_Views]:
    """Views of clusters, by the number of members that were seen; sorted out where a detection was an outlier."""
    rows = np.flatnonzero((result.flower_ids >= 0) & np.isfinite(result.diagnostics.nis))
    frame = result.session.observations.frame
    order = rows[np.lexsort((result.flower_ids[rows], result.cluster_ids[rows], frame[rows]))]
    key = np.column_stack([frame[order], result.cluster_ids[order]])
    starts = (
        np.flatnonzero(np.append(True, (np.diff(key, axis=0) != 0).any(axis=1))) if len(order) else np.zeros(0, int)
    )
    sizes = np.diff(np.append(starts, len(order)))
    for k in range(_FEWEST, _MOST + 1):
        here = starts[(sizes == k) if k < _MOST else (sizes >= k)]
        if len(here):
            chosen = here[np.unique(np.linspace(0, len(here) - 1, _SAMPLES).astype(int))]
            yield _view_of(result, order[chosen[:, None] + np.arange(k)])


def _view_of(result: Result, rows: IntArray) -> _Views:
    observations, flowers = result.session.observations, result.flowers
    T = result.T_world_camera[observations.frame[rows]]
    where = np.searchsorted(flowers.ids, result.flower_ids[rows])
    covs = rotate_cov(T[..., :3, :3], _covs_found(result, rows.ravel()).reshape(*rows.shape, 3, 3))
    return _Views(
        seen=(T[..., :3, :3] @ observations.points[rows][..., None])[..., 0] + T[..., :3, 3],
        seen_covs=covs,
        mapped=flowers.positions[where],
        mapped_covs=covs / flowers.n_observations[where][..., None, None],
    )


def _covs_found(result: Result, rows: IntArray) -> Array:
    """Covariances (m, 3, 3) of observations in the camera frame, as the session's residuals have them."""
    noise, observations = result.diagnostics.estimated_noise, result.session.observations
    if "flower_depth" not in noise:
        return noise.get("flower_factor", 1.0) ** 2 * observations.covs[rows]
    shape = NoiseShape(**{field.name: noise[f"flower_{field.name}"] for field in fields(NoiseShape)})
    points = observations.points[rows]
    return shape.covs(points, expected_depth(points, None))
