"""Smoothing with the true association: what anybody could reach who was told which detection is which flower."""

from __future__ import annotations

import numpy as np

from cluster_slam.association.frames import sort_by_frame
from cluster_slam.config import SmoothConfig
from cluster_slam.evaluation.trajectory import hand_eye_truth
from cluster_slam.graph.innovations import squared_innovations
from cluster_slam.graph.noise import pose_model
from cluster_slam.graph.variance import VarianceFactors
from cluster_slam.records import Result, Session, Truth
from cluster_slam.smoothing.finish import make_result
from cluster_slam.smoothing.rounds import solve
from cluster_slam.smoothing.world import World, for_solving, learn, say_how_sure


def smooth_with_truth(session: Session, truth: Truth, config: SmoothConfig | None = None) -> Result:
    """The pipeline's own smoothing, given the true labels and started at the truth, so that it cannot get lost."""
    assert truth.flower_ids is not None
    assert truth.T_world_camera is not None
    config = config or SmoothConfig()
    stated = sort_by_frame(session.observations, session.stamps)
    stated_poses = pose_model(session)
    ids, landmark, cluster = _true_landmarks(truth, stated.order)
    true_hand_eye = hand_eye_truth(session, truth)
    world = World(
        T=truth.T_world_camera,
        X=None if session.T_flange_camera is None or true_hand_eye is None else true_hand_eye.T_flange_camera,
        landmark=landmark,
        places=_true_places(truth, ids),
        cluster=cluster,
        radius=1.0,
        noise=VarianceFactors(1.0, 1.0, 1.0),
        held=np.zeros((6, 6)),
    )
    for in_stretches in (False, False, True):  # each time with the displacements and the noise that were found before
        frames, model = for_solving(stated, stated_poses, world)
        smoother, estimate = solve(frames, model, world, config, 6, in_stretches=in_stretches)
        world = learn(world, smoother, estimate)
    say_how_sure(smoother, stated, stated_poses, world)
    marginals = smoother.marginals(estimate)
    nis = squared_innovations(smoother, estimate)
    return make_result(session, frames, world, smoother, estimate, marginals, nis, config, 0, [], {})


def _true_landmarks(truth: Truth, order: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """True flower ids that were seen (l,), landmark of each sorted observation, cluster of each landmark."""
    assert truth.flower_ids is not None
    assert truth.cluster_ids is not None
    flower, cluster_of = truth.flower_ids[order], truth.cluster_ids[order]
    seen = flower >= 0
    ids, first, inverse = np.unique(flower[seen], return_index=True, return_inverse=True)
    landmark = np.full(len(flower), -1, dtype=np.int64)
    landmark[seen] = inverse
    _, cluster = np.unique(cluster_of[seen][first], return_inverse=True)
    return ids, landmark, cluster


def _true_places(truth: Truth, ids: np.ndarray) -> np.ndarray:
    assert truth.rest_flower_ids is not None
    assert truth.rest_positions is not None
    order = np.argsort(truth.rest_flower_ids)
    places: np.ndarray = truth.rest_positions[order[np.searchsorted(truth.rest_flower_ids[order], ids)]]
    return places
