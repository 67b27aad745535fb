"""A session, its truth, and a result of known quality, made without the simulator and without any estimation.

The result's errors are drawn from the covariances that it states, so what evaluation has to say about it is known.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cluster_slam.geometry import Array, adjoint, inverse, rotate_cov, se3_exp, transform
from cluster_slam.records import (
    Calibration,
    Clusters,
    Diagnostics,
    Drift,
    Flowers,
    Observations,
    RejectReason,
    Result,
    Session,
    StatedNoise,
    Truth,
)

CLUTTER_SHARE = 0.05
FLANGE_SIGMA = np.array([0.002] * 3 + [0.001] * 3)
HAND_EYE_SIGMA = np.array([0.0008] * 3 + [0.0003] * 3)
CAMERA_SIGMA = np.array([0.0005] * 3 + [0.0005] * 3)
FLOWER_SIGMA = np.array([0.0004, 0.0004, 0.0009])  # m, along the world's axes


@dataclass(frozen=True, slots=True, eq=False)
class Made:
    """What belongs together."""

    session: Session
    truth: Truth
    result: Result


@dataclass(frozen=True, slots=True, eq=False)
class _Plant:
    flower_ids: np.ndarray  # (f,)
    cluster_ids: np.ndarray  # (f,)
    rest: Array  # (f, 3)
    sway: Array  # (n, c, 3)


def make(
    seed: int, n_frames: int = 240, n_clusters: int = 6, absolute_stamp: float = 1.7e9, sway_m: float = 0.02
) -> Made:
    """A sweep past a plant of clusters of 3 to 6 flowers; the last cluster is never touched."""
    rng = np.random.default_rng(seed)
    stamps = absolute_stamp + np.arange(n_frames) / 15.0
    plant = _plant(rng, stamps - absolute_stamp, n_clusters, sway_m)
    T_flange_camera = se3_exp(np.array([0.02, -0.01, 1.57, 0.01, -0.02, 0.06]))
    true = _camera_path(n_frames)
    errors = rng.normal(size=(n_frames, 6)) * FLANGE_SIGMA
    flange = true @ inverse(T_flange_camera) @ se3_exp(errors)
    given = T_flange_camera @ se3_exp(np.array([0.006, -0.005, 0.004, 0.003, -0.002, 0.002]))
    observations, flower_ids = _observe(rng, true, plant)
    session = Session(
        "made", stamps, flange, "T_world_flange", "absolute", given, StatedNoise(), observations, plant="row3"
    )
    cluster_ids = np.where(flower_ids >= 0, plant.cluster_ids[flower_ids], -1)
    truth = Truth(true, flower_ids, cluster_ids, plant.flower_ids, plant.cluster_ids, plant.rest)
    # Nobody can tell what all given poses have in common from the mounting.
    mounting = se3_exp(-errors.mean(axis=0)) @ T_flange_camera
    return Made(session, truth, _result(rng, session, truth, plant, mounting))


def _plant(rng: np.random.Generator, seconds: Array, n_clusters: int, sway_m: float) -> _Plant:
    sizes = rng.integers(3, 7, n_clusters)
    cluster_ids = np.repeat(np.arange(n_clusters), sizes)
    centres = np.column_stack(
        [0.13 * (np.arange(n_clusters) % 4), 0.6 + rng.normal(0, 0.03, n_clusters), 0.15 * (np.arange(n_clusters) // 4)]
    )
    rest = centres[cluster_ids] + rng.normal(0, 0.02, (len(cluster_ids), 3))
    sway = np.zeros((len(seconds), n_clusters, 3))
    for cluster in range(n_clusters - 1):
        since = np.maximum(seconds - 0.6 * seconds[-1] * cluster / n_clusters - 1.0, 0.0)
        wave = sway_m * np.exp(-since / 1.5) * np.sin(2 * np.pi * 1.2 * since)
        sway[:, cluster] = wave[:, None] * np.array([0.8, 0.3, 0.5])
    return _Plant(np.arange(len(rest)), cluster_ids, rest, sway)


def _camera_path(n_frames: int) -> Array:
    u = np.linspace(0, 2 * np.pi, n_frames)
    positions = np.column_stack([0.2 + 0.25 * np.sin(u), 0.05 * np.sin(3 * u), 0.1 + 0.12 * np.sin(2 * u)])
    forward = np.array([0.2, 0.65, 0.08]) - positions
    z = forward / np.linalg.norm(forward, axis=1, keepdims=True)
    x = np.cross(z, np.array([0.0, 0.0, 1.0]))
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    T = np.tile(np.eye(4), (n_frames, 1, 1))
    T[:, :3, :3] = np.stack([x, np.cross(z, x), z], axis=-1)
    T[:, :3, 3] = positions
    return T


def _observe(rng: np.random.Generator, T: Array, plant: _Plant) -> tuple[Observations, np.ndarray]:
    n_frames, n_flowers = len(T), len(plant.rest)
    seen = rng.random((n_frames, n_flowers)) < 0.85
    frame, flower = np.nonzero(seen)
    clutter = rng.random(len(frame)) < CLUTTER_SHARE
    where = plant.rest[flower] + plant.sway[frame, plant.cluster_ids[flower]]
    where = where + clutter[:, None] * rng.normal(0, 0.15, (len(frame), 3))
    points = transform(inverse(T[frame]), where)
    sigma = np.column_stack([0.002 + 0 * points[:, 2], 0.002 + 0 * points[:, 2], 0.006 * points[:, 2] ** 2 + 0.001])
    covs = np.zeros((len(points), 3, 3))
    covs[:, [0, 1, 2], [0, 1, 2]] = sigma**2
    points = points + rng.normal(size=points.shape) * sigma
    return Observations(frame, points, covs, rng.random(len(frame))), np.where(clutter, -1, flower)


def _result(rng: np.random.Generator, session: Session, truth: Truth, plant: _Plant, T_flange_camera: Array) -> Result:
    """Labels with 1 % of flowers lost and 10 % of the clutter taken for flowers, under other names than the truth's."""
    assert truth.flower_ids is not None
    flower_ids = np.where(truth.flower_ids >= 0, truth.flower_ids + 100, -1)
    flower_ids[rng.random(len(flower_ids)) < 0.01] = -1
    fooled = (truth.flower_ids < 0) & (rng.random(len(flower_ids)) < 0.1)
    flower_ids[fooled] = rng.integers(0, len(plant.rest), fooled.sum()) + 100
    cluster_ids = np.where(flower_ids >= 0, plant.cluster_ids[np.maximum(flower_ids - 100, 0)] + 10, -1)
    flowers = _flowers(rng, session, plant, flower_ids)
    clusters = _clusters(session, flowers, cluster_ids)
    xi = rng.normal(size=6) * HAND_EYE_SIGMA
    A = adjoint(inverse(T_flange_camera))
    hand_eye_cov = np.diag(HAND_EYE_SIGMA**2) + A @ np.diag(FLANGE_SIGMA**2) @ A.T / session.n_frames
    unsure = rng.normal(size=(session.n_frames, 6)) * CAMERA_SIGMA
    T_world_camera = _camera_path(session.n_frames) @ se3_exp(unsure)
    reasons = np.where(
        flower_ids >= 0,
        RejectReason.ACCEPTED,
        rng.choice(
            [RejectReason.POSITION_GATE, RejectReason.GEOMETRY_GATE, RejectReason.UNCONFIRMED, RejectReason.OUTLIER],
            len(flower_ids),
            p=[0.6, 0.1, 0.25, 0.05],
        ),
    )
    nis = np.where(flower_ids >= 0, rng.chisquare(3, len(flower_ids)), np.nan)
    noise = {"flower": 0.0047, "pose_translation": 0.00103, "pose_rotation": 0.0019, "depth": 0.0063, "sway": 0.006}
    return Result(
        session,
        T_world_camera,
        flower_ids,
        cluster_ids,
        flowers,
        clusters,
        _drift(rng, session, plant, clusters, cluster_ids),
        Calibration(T_flange_camera @ se3_exp(xi), hand_eye_cov),
        Diagnostics(nis, reasons, noise),
        timings_s={"associate": 2.1, "smooth": 0.7},
        counts={"rounds": 2},
    )


def _flowers(rng: np.random.Generator, session: Session, plant: _Plant, flower_ids: np.ndarray) -> Flowers:
    f = len(plant.rest)
    covs = np.tile(np.diag(FLOWER_SIGMA**2), (f, 1, 1))
    frames = [session.observations.frame[flower_ids == i + 100] for i in range(f)]
    return Flowers(
        plant.flower_ids + 100,
        plant.cluster_ids + 10,
        plant.rest + rng.normal(size=(f, 3)) * FLOWER_SIGMA,
        covs,
        np.array([session.stamps[k[0]] for k in frames]),
        np.array([session.stamps[k[-1]] for k in frames]),
        np.array([len(k) for k in frames]),
    )


def _clusters(session: Session, flowers: Flowers, cluster_ids: np.ndarray) -> Clusters:
    ids = np.unique(flowers.cluster_ids)
    members = [flowers.cluster_ids == i for i in ids]
    frames = [session.observations.frame[cluster_ids == i] for i in ids]
    centroids = np.array([flowers.positions[m].mean(0) for m in members])
    spread = [np.linalg.norm(flowers.positions[m] - c, axis=1) for m, c in zip(members, centroids, strict=True)]
    return Clusters(
        ids,
        centroids,
        np.array([flowers.covs[m].sum(0) / m.sum() ** 2 for m in members]),
        np.array([m.sum() for m in members]),
        np.array([[(r * r).sum(), r.mean()] for r in spread]),
        np.tile(np.diag([1e-8, 1e-7]), (len(ids), 1, 1)),
        np.array([session.stamps[k[0]] for k in frames]),
        np.array([session.stamps[k[-1]] for k in frames]),
        np.array([len(np.unique(k)) for k in frames]),
        ("confirmed",) * len(ids),
    )


def _drift(
    rng: np.random.Generator, session: Session, plant: _Plant, clusters: Clusters, cluster_ids: np.ndarray
) -> Drift:
    pairs = np.unique(np.column_stack([session.observations.frame, cluster_ids])[cluster_ids >= 0], axis=0)
    frame, cluster = pairs[:, 0], pairs[:, 1] - 10
    covs = np.tile(np.diag([1.5e-6, 4e-6, 1.5e-6]), (len(frame), 1, 1))
    where = clusters.positions[cluster] + plant.sway[frame, cluster]
    covs = rotate_cov(np.eye(3), covs)
    return Drift(
        frame, pairs[:, 1], where + rng.normal(size=where.shape) * np.sqrt(covs[:, [0, 1, 2], [0, 1, 2]]), covs
    )
