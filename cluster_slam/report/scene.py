"""What the three-dimensional view and the charts need, as JSON."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from cluster_slam.geometry import Array, quaternion_from_rotation
from cluster_slam.records import CLUTTER, IntArray, Result
from cluster_slam.report.colours import colour_indices
from cluster_slam.report.pack import box_around, pack, rounded, upper
from cluster_slam.report.statistics import Sway, fit_of, radius95, sigma, sway, world_points

NONE = 65535
MAX_OBSERVATIONS = 300_000  # in the page; of more, every second (third ...) frame's are kept
MAX_DRIFT = 120_000  # rows of the drift table, likewise


@dataclass(frozen=True, slots=True, eq=False)
class _Seen:
    """The observations that go into the page, sorted by frame."""

    rows: IntArray  # (k,) into the session's
    every: int  # each so manieth frame was kept


def scene_json(result: Result) -> dict[str, object]:
    """Paths, clusters, flowers, drift and observations of a result."""
    points = world_points(result)
    box = box_around(np.concatenate([result.flowers.positions, result.T_world_camera[:, :3, 3]]))
    moved = sway(result)
    seen = _kept(result)
    stamps = result.session.stamps
    return {
        "up": up_axis(result.T_world_camera),
        "start": float(stamps[0]) if len(stamps) else 0.0,
        "stamps": pack(stamps - stamps[:1], "f4"),
        "after": pack(result.T_world_camera[:, :3, 3], "f4"),
        "before": pack(result.session.T_world_camera[:, :3, 3], "f4"),
        "orientation": pack(quaternion_from_rotation(result.T_world_camera[:, :3, :3]), "f4"),
        "box": box.as_json(),
        "clusters": _clusters(result, moved),
        "flowers": _flowers(result),
        "drift": _drift(result, moved, seen.every),
        "observations": _observations(result, seen, points, box.steps(points[seen.rows])),
    }


def up_axis(T_world_camera: Array) -> list[float]:
    """The axis of the world that is nearest to the camera's upward direction, on average."""
    mean = -T_world_camera[:, :3, 1].mean(0) if len(T_world_camera) else np.array([0.0, 0.0, 1.0])
    k = int(np.abs(mean).argmax())
    axis = np.zeros(3)
    axis[k] = 1.0 if mean[k] >= 0 else -1.0
    return axis.tolist()


def _clusters(result: Result, moved: Sway) -> list[dict[str, object]]:
    clusters = result.clusters
    start = result.session.stamps[0] if len(result.session.stamps) else 0.0
    colour, spread, radius = colour_indices(clusters.positions), sigma(clusters.covs), radius95(clusters.covs)
    covs = upper(clusters.covs)
    fit = fit_of(result, clusters.ids, result.cluster_ids)
    seen = _frames_that_saw(result)
    merged = [[int(a) for a, b in result.merged if b == i] for i in clusters.ids.tolist()]
    return [
        {
            "id": int(clusters.ids[j]),
            "p": rounded(clusters.positions[j]),
            "cov": covs[j],
            "n": int(clusters.n_flowers[j]),
            "sigma": float(spread[j]),
            "r95": float(radius[j]),
            "size": float(clusters.descriptors[j, 1]),
            "inertia": float(clusters.descriptors[j, 0]),
            "first": float(clusters.first_seen[j] - start),
            "last": float(clusters.last_seen[j] - start),
            "seen": int(seen[j]),
            "state": clusters.states[j],
            "colour": int(colour[j]),
            "sway": float(moved.largest[j]),
            "misfit": _or_none(fit.misfit[j]),
            "inside": _or_none(fit.inside95[j]),
            "merged": merged[j],
        }
        for j in range(len(clusters))
    ]


def _frames_that_saw(result: Result) -> IntArray:
    """Number of frames (c,) in which at least one flower of each cluster was seen."""
    known = np.isin(result.cluster_ids, result.clusters.ids)
    row = np.searchsorted(result.clusters.ids, result.cluster_ids[known])
    n = max(result.session.n_frames, 1)
    pairs = np.unique(row * n + result.session.observations.frame[known])
    return np.bincount(pairs // n, minlength=len(result.clusters))


def _flowers(result: Result) -> list[dict[str, object]]:
    flowers = result.flowers
    start = result.session.stamps[0] if len(result.session.stamps) else 0.0
    spread, covs = sigma(flowers.covs), upper(flowers.covs)
    cluster = np.searchsorted(result.clusters.ids, flowers.cluster_ids)
    fit = fit_of(result, flowers.ids, result.flower_ids)
    return [
        {
            "id": int(flowers.ids[i]),
            "c": int(cluster[i]),
            "p": rounded(flowers.positions[i]),
            "cov": covs[i],
            "sigma": float(spread[i]),
            "first": float(flowers.first_seen[i] - start),
            "last": float(flowers.last_seen[i] - start),
            "seen": int(flowers.n_observations[i]),
            "misfit": _or_none(fit.misfit[i]),
        }
        for i in range(len(flowers))
    ]


def _drift(result: Result, moved: Sway, every: int) -> dict[str, object]:
    known = np.isin(result.drift.cluster_ids, result.clusters.ids)
    frame = result.drift.frame[known]
    order = np.lexsort((frame, moved.cluster))
    order = order[frame[order] % every == 0]
    step = max(float(np.abs(moved.displacement).max(initial=0.0)), 1e-6) / 32000
    return {
        "frame": pack(frame[order], "u4"),
        "cluster": pack(moved.cluster[order], "u2"),
        "d": pack(np.round(moved.displacement[order] / step), "i2"),
        "step": step,
        "sigma": pack(moved.sigma[order], "f4"),
    }


def _kept(result: Result) -> _Seen:
    frame = result.session.observations.frame
    every = max(1, -(-len(frame) // MAX_OBSERVATIONS), -(-len(result.drift.frame) // MAX_DRIFT))
    rows = np.flatnonzero(frame % every == 0)
    return _Seen(rows[np.argsort(frame[rows], kind="stable")], every)


def _observations(result: Result, seen: _Seen, points: Array, steps: NDArray[np.int16]) -> dict[str, object]:
    rows = seen.rows
    frame = result.session.observations.frame[rows]
    first = np.searchsorted(frame, np.arange(result.session.n_frames + 1))
    flower = np.searchsorted(result.flowers.ids, result.flower_ids[rows])
    known = np.isin(result.flower_ids[rows], result.flowers.ids) & (result.flower_ids[rows] != CLUTTER)
    near, distance = _nearest_cluster(result, points[rows])
    nis = np.nan_to_num(result.diagnostics.nis[rows], nan=-1.0)
    return {
        "first": pack(first, "u4"),
        "flower": pack(np.where(known, flower, NONE), "u2"),
        "reason": pack(result.diagnostics.reasons[rows], "u1"),
        "nis": pack(np.where(nis < 0, NONE, np.minimum(np.round(nis * 100), NONE - 1)), "u2"),
        "near": pack(np.where(known, NONE, near), "u2"),
        "distance": pack(np.where(known, 0, np.minimum(np.round(distance * 1e4), NONE)), "u2"),
        "p": pack(steps, "i2"),
        "every": seen.every,
    }


def _nearest_cluster(result: Result, points: Array) -> tuple[IntArray, Array]:
    """The cluster of the nearest flower for each point, and the distance to that flower in metres."""
    if not len(result.flowers) or not len(points):
        return np.full(len(points), NONE), np.zeros(len(points))
    distance, flower = cKDTree(result.flowers.positions).query(points)
    return np.searchsorted(result.clusters.ids, result.flowers.cluster_ids[flower]), np.asarray(distance)


def _or_none(value: float) -> float | None:
    return float(f"{value:.5g}") if np.isfinite(value) else None
