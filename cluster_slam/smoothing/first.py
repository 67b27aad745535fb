"""The beginning: pieces, the hand-eye transform from them, landmarks from the pieces, and a first grouping."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cluster_slam.association.displacement import (
    presence_of,
)
from cluster_slam.association.drifting import drifts_far, frames_tell_poses, trace_drifting
from cluster_slam.association.frames import Frames, view_volume
from cluster_slam.association.landmarks import flower_spacing, group_means, merge_pieces
from cluster_slam.association.refine import compact, supported
from cluster_slam.association.tracklets import build_tracklets, relative_pose_cov
from cluster_slam.config import SmoothConfig
from cluster_slam.geometry import Array, transform
from cluster_slam.graph.hand_eye import hand_eye_from_pieces
from cluster_slam.graph.noise import camera_covs
from cluster_slam.graph.poses import PoseModel
from cluster_slam.graph.variance import VarianceFactors
from cluster_slam.grouping import group_flowers
from cluster_slam.records import BoolArray, IntArray
from cluster_slam.smoothing.rounds import solve
from cluster_slam.smoothing.world import World, fewest_observations, scalar_var, with_variances
from tracking.gating import chi2_threshold

_ODOMETRY_ROUNDS = 2  # of pieces and poses, which drift the less the longer the pieces
_CALM_HAND_EYE_RAD = 0.005  # a hand-eye transform known so well does not spoil pieces


def first_world(
    stated: Frames,
    stated_poses: PoseModel,
    config: SmoothConfig,
    rng: np.random.Generator,
    followed: Callable[[], World | None],
) -> World:
    """Landmarks to begin with: poses that drift too far are followed, others can be relied upon.

    ``followed`` gives what a tracker finds that corrects each pose by the landmarks so far; None for nothing.
    """
    _, step = camera_covs(stated_poses, stated_poses.X0)
    T = stated_poses.given if stated_poses.X0 is None else stated_poses.given @ stated_poses.X0
    if step is None or not drifts_far(stated, T, step):
        return world_of_pieces(stated, stated_poses, config, rng)
    if not frames_tell_poses(stated):
        return world_of_drifting_poses(stated, stated_poses, T, step, config, rng)
    return followed() or world_of_pieces(stated, stated_poses, config, rng)


def world_of_drifting_poses(
    frames: Frames, model: PoseModel, T: Array, step: Array, config: SmoothConfig, rng: np.random.Generator
) -> World:
    """Follow the drift from stretch to stretch, landmarks growing with the estimate; the association is then known."""
    traced = trace_drifting(frames, T, step, config.particles, rng=rng)
    presence = presence_of(frames.frame, traced.label, len(traced.places), frames.n_frames)
    return World(
        T=traced.T,
        X=model.X0,
        landmark=traced.label,
        places=traced.places,
        cluster=group_flowers(traced.places, presence, None, view_volume(frames), config.grouping, rng=rng),
        radius=float(np.sqrt(np.median(scalar_var(frames, model)))),
        noise=VarianceFactors(1.0, 1.0, 1.0),
        held=np.zeros((6, 6)),
        cov_step=traced.cov_step if model.X0 is None else None,
        instruments=traced.instruments,
    )


def world_of_pieces(stated: Frames, stated_poses: PoseModel, config: SmoothConfig, rng: np.random.Generator) -> World:
    """Pieces, the hand-eye transform from them, landmarks from the pieces, and a first grouping."""
    X, cov_X = stated_poses.X0, stated_poses.cov_hand_eye
    noise = VarianceFactors(1.0, 1.0, 1.0)
    held = np.zeros((6, 6))
    shortest = shortest_piece(stated)
    for _ in range(3):
        frames, model = with_variances(stated, stated_poses, noise)
        T = model.given if X is None else model.given @ X
        cov, step = camera_covs(model, X)
        relative = relative_pose_cov(T, frames.stamps, cov, None if X is None else cov_X, step, 0.5)
        pieces = build_tracklets(frames, T, relative, config.tracklets)
        long = in_long_pieces(pieces.labels, shortest)
        factor = innovation_factor(pieces.innovation_chi2[long])
        noise = VarianceFactors(noise.flower * factor, noise.pose * factor, 1.0)
        cov_before = cov_X
        if model.X0 is not None and long.any():
            found = hand_eye_from_pieces(
                model.given[frames.frame[long]],
                frames.points[long],
                scalar_var(frames, model)[long],
                pieces.labels[long],
                model.X0,
                model.cov_hand_eye,
                float(model.cov[0, 0]),
            )
            X, held = found.X, found.held
            cov_X = np.linalg.inv(found.information + np.linalg.inv(model.cov_hand_eye))
        if factor == 1.0 and (X is None or cov_X[0, 0] + cov_before[0, 0] < _CALM_HAND_EYE_RAD**2):
            break
    T = model.given if X is None else model.given @ X
    for _ in range(0 if step is None else _ODOMETRY_ROUNDS):
        T = _smoothed_by_pieces(frames, model, T, X, in_order(pieces.labels, long), noise, config)
        pieces = build_tracklets(frames, T, relative, config.tracklets)
        long = in_long_pieces(pieces.labels, shortest)
    landmark, places, radius = _landmarks_of_pieces(frames, model, T, pieces.labels, shortest, config)
    presence = presence_of(frames.frame, landmark, len(places), frames.n_frames)
    cluster = group_flowers(places, presence, None, view_volume(frames), config.grouping, rng=rng)
    return World(T, X, landmark, places, cluster, radius, noise, held)


def _landmarks_of_pieces(
    frames: Frames, model: PoseModel, T: Array, labels: IntArray, shortest: int, config: SmoothConfig
) -> tuple[IntArray, Array, float]:
    """Landmark of each observation (m,), places (l, 3), and within what radius pieces were taken for one flower."""
    w, var = transform(T[frames.frame], frames.points), scalar_var(frames, model)
    radius = radius_of_pieces(frames, w, var, labels, shortest)
    landmark, places = merge_pieces(w, var, labels, frames.frame, frames.n_frames, radius, shortest)
    keep = supported(frames, T, places, landmark, fewest_observations(frames, config))
    return compact(keep, landmark), places[keep], radius


def radius_of_pieces(frames: Frames, w: Array, var: Array, labels: IntArray, shortest: int) -> float:
    """Within what radius, m, pieces are of one flower: less than flowers stand apart."""
    return 0.65 * spacing(frames, w, var, labels, shortest)


def _smoothed_by_pieces(
    frames: Frames,
    model: PoseModel,
    T: Array,
    X: Array | None,
    label: IntArray,
    noise: VarianceFactors,
    config: SmoothConfig,
) -> Array:
    """Poses (n, 4, 4) that drift less: each piece is a flower of its own, which holds the poses of its time together.

    What drift is left from the beginning of a session to its end parts the pieces of a flower by less than flowers
    stand apart; landmarks, made from them next, close the loops.
    """
    known = label >= 0
    if not known.any():
        return T
    w, n = transform(T[frames.frame[known]], frames.points[known]), int(label.max()) + 1
    places = group_means(w, scalar_var(frames, model)[known], label[known], n).mean
    alone = World(T, X, label, places, np.arange(n), 1.0, noise, np.zeros((6, 6)))
    return solve(frames, model, alone, config, 2)[1].T


def in_order(labels: IntArray, keep: BoolArray) -> IntArray:
    """Labels 0, 1, 2 ... of the observations (m,) to keep, -1 for the others."""
    out = np.full(len(labels), -1, dtype=np.int64)
    out[keep] = np.unique(labels[keep], return_inverse=True)[1]
    return out


def innovation_factor(chi2: Array) -> float:
    """Factor on the stated variances that innovations of pieces ask for; one where they are about right."""
    chi2 = chi2[np.isfinite(chi2)]
    if len(chi2) < 50:
        return 1.0
    factor = float(np.median(chi2)) / chi2_threshold(3, 0.5)
    return factor if factor > 1.6 else 1.0  # errors that change slowly hide from innovations: never narrower here


def shortest_piece(frames: Frames) -> int:
    """Observations of a piece that counts: half a second, 5 to 15; fewer where the session is short."""
    if frames.n_frames < 2:
        return 1
    dt = float(np.median(np.diff(frames.stamps)))
    return int(min(np.clip(round(0.5 / dt), 5, 15), max(1, frames.n_frames // 4)))


def in_long_pieces(labels: IntArray, shortest: int) -> BoolArray:
    count = np.bincount(labels[labels >= 0])
    long: BoolArray = count[labels] >= shortest
    return long


def spacing(frames: Frames, w: Array, var: Array, labels: IntArray, shortest: int) -> float:
    """How close flowers stand, m, from pieces seen at the same time; where there are none, from the noise."""
    long = in_long_pieces(labels, shortest)
    if not long.any():
        return 1.0
    _, piece = np.unique(labels[long], return_inverse=True)
    n = int(piece.max()) + 1
    groups = group_means(w[long], var[long], piece, n)
    presence = presence_of(frames.frame[long], piece, n, frames.n_frames)
    spacing = flower_spacing(groups.mean, presence, groups.count / np.maximum(groups.chi2, 0.5))
    return spacing if np.isfinite(spacing) else 6.0 * float(np.sqrt(np.median(var)))
