"""The figures that the report speaks of, computed once from a result."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.evaluation import Metrics
from cluster_slam.evaluation.landmarks import NOMINAL
from cluster_slam.evaluation.trajectory import absolute_error
from cluster_slam.geometry import Array, inverse, se3_log, transform
from cluster_slam.records import CLUTTER, IntArray, RejectReason, Result
from cluster_slam.report.gates import gate_tests
from tracking.consistency import mean_band, share_band
from tracking.gating import chi2_threshold

_BINS = 160  # of the time axis of the chart of misfits
_MOVED_PROBABILITY = 0.999  # a cluster counts as moved where being at rest is less likely than 1 in 1000


@dataclass(frozen=True, slots=True)
class Summary:
    """Figures of a whole result; None where there is nothing to compute them from."""

    n_clusters: int  # confirmed, two members or more
    n_single: int  # confirmed, one member
    n_unsure: int  # tentative or lost
    n_flowers: int
    n_frames: int
    seconds: float
    n_observations: int
    n_rejected: int
    rejected: tuple[tuple[RejectReason, int], ...]  # most frequent first
    sigma_m: float | None  # median over clusters of the root mean square sigma of an axis
    radius95_m: float | None  # median over clusters of the longest half-axis of the 95 % ellipsoid
    worst_radius95_m: float | None
    worst_cluster: int | None
    path_shift_m: float | None  # root mean square between given and estimated camera positions; None where they agree
    path_turn_rad: float | None
    misfit: float | None  # mean NIS / 3; None where flowers were seen but once, and fit by themselves
    hand_eye_m: float | None
    hand_eye_rad: float | None


def summarise(result: Result) -> Summary:
    """The figures of a result."""
    confirmed = np.array([s == "confirmed" for s in result.clusters.states], dtype=bool)
    single = result.clusters.n_flowers == 1
    radius = radius95(result.clusters.covs)
    worst = int(radius.argmax()) if len(radius) else None
    shift = absolute_error(result.session.T_world_camera, result.T_world_camera)
    is_moved = shift.position_m > 1e-9 or shift.rotation_rad > 1e-9
    nis = result.diagnostics.nis[np.isfinite(result.diagnostics.nis)]
    xi = hand_eye_correction(result)
    return Summary(
        n_clusters=int((confirmed & ~single).sum()),
        n_single=int((confirmed & single).sum()),
        n_unsure=int((~confirmed).sum()),
        n_flowers=len(result.flowers),
        n_frames=result.session.n_frames,
        seconds=float(result.session.stamps[-1] - result.session.stamps[0]) if result.session.n_frames else 0.0,
        n_observations=len(result.flower_ids),
        n_rejected=int((result.flower_ids == CLUTTER).sum()),
        rejected=_rejections(result),
        sigma_m=float(np.median(sigma(result.clusters.covs))) if len(radius) else None,
        radius95_m=float(np.median(radius)) if len(radius) else None,
        worst_radius95_m=float(radius[worst]) if worst is not None else None,
        worst_cluster=int(result.clusters.ids[worst]) if worst is not None else None,
        path_shift_m=shift.position_m if is_moved else None,
        path_turn_rad=shift.rotation_rad if is_moved else None,
        misfit=float(nis.mean() / 3.0) if len(nis) > len(result.flowers) else None,
        hand_eye_m=None if xi is None else float(np.linalg.norm(xi[3:])),
        hand_eye_rad=None if xi is None else float(np.linalg.norm(xi[:3])),
    )


def sigma(covs: Array) -> Array:
    """Root mean square standard deviation of an axis (n,), of covariances (n, 3, 3)."""
    out: Array = np.sqrt(np.trace(covs, axis1=-2, axis2=-1) / 3.0)
    return out


def radius95(covs: Array) -> Array:
    """Longest half-axis (n,) of the 95 % ellipsoids of covariances (n, 3, 3)."""
    if not len(covs):
        return np.zeros(0)
    largest = np.maximum(np.linalg.eigvalsh(covs)[:, -1], 0.0)
    out: Array = np.sqrt(chi2_threshold(3, 0.95) * largest)
    return out


def hand_eye_correction(result: Result) -> Array | None:
    """Tangent (6,) from the stated to the estimated hand-eye transform; None where there are not both."""
    if result.calibration is None or result.session.T_flange_camera is None:
        return None
    xi: Array = se3_log(inverse(result.session.T_flange_camera) @ result.calibration.T_flange_camera)
    return xi


def world_points(result: Result) -> Array:
    """Where each observation (m, 3) lies in the world, by the estimated camera poses."""
    observations = result.session.observations
    return transform(result.T_world_camera[observations.frame], observations.points)


def _rejections(result: Result) -> tuple[tuple[RejectReason, int], ...]:
    rejected = result.diagnostics.reasons[result.flower_ids == CLUTTER]
    found = [(reason, int((rejected == reason).sum())) for reason in RejectReason]
    return tuple(sorted(((r, n) for r, n in found if n), key=lambda pair: (-pair[1], pair[0])))


@dataclass(frozen=True, slots=True, eq=False)
class Fit:
    """How well the observations of each of some landmarks fit."""

    n: IntArray  # (l,) observations with a known misfit
    misfit: Array  # (l,) mean NIS / 3; NaN where n is 0
    inside95: Array  # (l,) share inside the 95 % gate; NaN where n is 0


def fit_of(result: Result, ids: IntArray, labels: IntArray) -> Fit:
    """Fit of the landmarks of increasing ids (l,) by the labels (m,) of the observations."""
    nis = result.diagnostics.nis
    rows = np.isfinite(nis) & np.isin(labels, ids)
    where = np.searchsorted(ids, labels[rows])
    n = np.bincount(where, minlength=len(ids))
    total = np.bincount(where, weights=nis[rows], minlength=len(ids))
    inside = np.bincount(where[nis[rows] <= chi2_threshold(3, 0.95)], minlength=len(ids))
    known = np.where(n > 0, n, np.nan)
    return Fit(n, np.asarray(total / known / 3.0), np.asarray(inside / known))


@dataclass(frozen=True, slots=True, eq=False)
class MisfitCurve:
    """Mean NIS of accepted observations over time, and the band that holds 95 % of such means if all is true."""

    times: Array  # (b,) s since the first frame
    mean: Array  # (b,)
    low: Array  # (b,)
    high: Array  # (b,)
    n: IntArray  # (b,) observations behind each mean

    @property
    def share_inside(self) -> float:
        """Share of the means inside the band; NaN where there are none."""
        return float(((self.mean >= self.low) & (self.mean <= self.high)).mean()) if len(self.mean) else float("nan")


def misfit_curve(result: Result) -> MisfitCurve:
    """NIS over time in at most 160 bins of equal length."""
    known = np.isfinite(result.diagnostics.nis)
    stamps = result.session.stamps
    if known.sum() <= len(result.flowers):
        return MisfitCurve(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0, np.int64))
    times = (stamps - stamps[0])[result.session.observations.frame[known]]
    n_bins = max(1, min(_BINS, result.session.n_frames))
    width = max(float(stamps[-1] - stamps[0]), 1e-9) / n_bins
    bin_of = np.minimum((times / width).astype(np.int64), n_bins - 1)
    n = np.bincount(bin_of, minlength=n_bins)
    total = np.bincount(bin_of, weights=result.diagnostics.nis[known], minlength=n_bins)
    kept = np.flatnonzero(n)
    bands = [mean_band(3, int(k)) for k in n[kept]]
    return MisfitCurve(
        np.asarray((kept + 0.5) * width, dtype=np.float64),
        total[kept] / n[kept],
        np.array([b.low for b in bands]),
        np.array([b.high for b in bands]),
        n[kept],
    )


@dataclass(frozen=True, slots=True)
class CoverageCurve:
    """Shares of errors inside the regions that should hold so many of them."""

    name: str
    nominal: tuple[float, ...]
    actual: tuple[float, ...]
    low: tuple[float, ...]  # where 95 % of such shares lie, if all is true and independent
    high: tuple[float, ...]
    n: int


def coverage_curves(result: Result, metrics: Metrics | None) -> tuple[CoverageCurve, ...]:
    """Of the gates' true matches, and against truth of flowers and clusters."""
    curves = [
        _coverage_curve(
            f"{test.name} gate", tuple(float((test.probability <= p).mean()) for p in NOMINAL), len(test.probability)
        )
        for test in gate_tests(result)
    ]
    if metrics is not None and metrics.coverage_flowers and metrics.n_flowers_compared:
        curves.append(_coverage_curve("flowers against truth", metrics.coverage_flowers, metrics.n_flowers_compared))
    if metrics is not None and metrics.coverage_clusters and metrics.n_clusters_compared:
        curves.append(_coverage_curve("clusters against truth", metrics.coverage_clusters, metrics.n_clusters_compared))
    return tuple(curves)


def _coverage_curve(name: str, actual: tuple[float, ...], n: int) -> CoverageCurve:
    bands = [share_band(p, n) for p in NOMINAL]
    return CoverageCurve(name, NOMINAL, actual, tuple(b.low for b in bands), tuple(b.high for b in bands), n)


@dataclass(frozen=True, slots=True, eq=False)
class Sway:
    """Displacements from rest, row for row as ``drift``, and the largest of each cluster that is no mere noise."""

    cluster: IntArray  # (d,) row of the cluster's table
    displacement: Array  # (d, 3) m
    sigma: Array  # (d,) m, of an axis
    largest: Array  # (c,) m; 0 where the cluster was never seen away from rest


def sway(result: Result) -> Sway:
    """How far each cluster was from its rest position, frame by frame."""
    drift, clusters = result.drift, result.clusters
    known = np.isin(drift.cluster_ids, clusters.ids)
    cluster = np.searchsorted(clusters.ids, drift.cluster_ids[known])
    displacement = drift.positions[known] - clusters.positions[cluster]
    spread = sigma(drift.covs[known])
    distance = np.linalg.norm(displacement, axis=-1)
    moved = distance**2 > chi2_threshold(3, _MOVED_PROBABILITY) * spread**2
    largest = np.zeros(len(clusters))
    np.maximum.at(largest, cluster[moved], distance[moved])
    return Sway(cluster, displacement, spread, largest)
