"""The closed-form step against GTSAM's elimination of the whole graph."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cluster_slam.association.displacement import cluster_pairs
from cluster_slam.association.frames import Frames
from cluster_slam.errors import EstimationError
from cluster_slam.geometry import Array, inverse, se3_exp, transform
from cluster_slam.graph import elimination, whole
from cluster_slam.graph.batch import BatchSmoother, Estimate, Pairs
from cluster_slam.graph.poses import PoseModel
from cluster_slam.graph.variance import _taken_up
from cluster_slam.records import IntArray

N_FRAMES, N_PLACES = 70, 9  # several chunks of frames
CLUSTER = np.array([0, 0, 0, 1, 1, 1, 1, 2, 3])


def _stretches(frame: IntArray, cluster: IntArray, rng: np.random.Generator) -> tuple[IntArray, int]:
    """Stretches of another length for each cluster; cluster 2 has none."""
    length = np.array([7, 30, 1, 200])[cluster]
    key = cluster * 1000 + frame // length
    _, of = np.unique(key, return_inverse=True)
    of = np.where(cluster == 2, -1, of)
    _, of[of >= 0] = np.unique(of[of >= 0], return_inverse=True)
    order = rng.permutation(int(of.max()) + 1)  # numbered in no order
    return np.where(of >= 0, order[of], -1), len(order)


def _problem(*, in_stretches: bool, hand_eye: bool, seed: int) -> tuple[BatchSmoother, Estimate]:
    rng = np.random.default_rng(seed)
    seen = rng.random((N_FRAMES, N_PLACES)) < 0.6
    seen[40] = False  # a frame without observations
    frame, label = np.nonzero(seen)
    label = np.where(rng.random(len(label)) < 0.1, -1, label)
    places = rng.uniform(-0.3, 0.3, (N_PLACES, 3)) + np.array([0, 0, 0.7])
    X = se3_exp(np.array([0.02, -0.03, 0.04, 0.05, 0.02, -0.01])) if hand_eye else np.eye(4)
    T = se3_exp(rng.normal(0, 0.1, (N_FRAMES, 6)))
    points = transform(inverse(T)[frame], places[label]) + rng.normal(0, 0.003, (len(frame), 3))
    covs = np.array([np.diag(v) for v in rng.uniform(1e-6, 1e-5, (len(frame), 3))])
    stamps = np.arange(N_FRAMES) / 30
    frames = Frames(np.arange(len(frame)), np.searchsorted(frame, np.arange(N_FRAMES + 1)), frame, points, covs, stamps)
    of, at, cluster = cluster_pairs(frames, label, CLUSTER)
    sigma = rng.uniform(0.001, 0.01, len(at))
    stretch, n = _stretches(at, cluster, rng) if in_stretches else (np.full(len(at), -1), 0)
    pairs = Pairs(of, at, cluster, sigma, stretch, rng.uniform(0.002, 0.01, n))
    cov = np.diag(np.repeat([2e-3, 1e-3], 3) ** 2)
    noisy = T @ inverse(X) @ se3_exp(rng.normal(0, 1e-3, (N_FRAMES, 6)))
    model = PoseModel(noisy, cov, None, X if hand_eye else None, np.diag(np.repeat([0.01, 0.005], 3) ** 2))
    smoother = BatchSmoother(frames, model, label, pairs, correlation=1.7)
    start = Estimate(
        T=T @ se3_exp(rng.normal(0, 1e-3, (N_FRAMES, 6))),
        X=X @ se3_exp(rng.normal(0, 1e-3, 6)) if hand_eye else None,
        places=places + rng.normal(0, 0.002, places.shape),
        d=rng.normal(0, 0.003, (len(at), 3)),
        weight=rng.uniform(0.2, 1.0, len(frame)) * (label >= 0),
        residual_chi2=np.full(len(frame), np.nan),
    )
    smoother._stretch_mean = rng.normal(0, 0.002, (n, 3))  # as in the middle of a solution
    return smoother, start


CASES = [(in_stretches, hand_eye) for in_stretches in (False, True) for hand_eye in (False, True)]


@pytest.mark.parametrize(("in_stretches", "hand_eye"), CASES)
def test_step_is_that_of_the_whole_graph(in_stretches: bool, hand_eye: bool) -> None:
    smoother, e = _problem(in_stretches=in_stretches, hand_eye=hand_eye, seed=4)
    told, found = (way.solve_step(smoother.links, smoother.linearised(e)) for way in (whole, elimination))
    for name in ("z", "d", "b", "places", "x"):
        a: Array = getattr(found, name)
        assert a.shape == getattr(told, name).shape
        np.testing.assert_allclose(a, getattr(told, name), atol=1e-10)
    assert np.abs(found.places).max() > 1e-4  # there was something to do


@pytest.mark.parametrize(("in_stretches", "hand_eye"), CASES)
def test_marginals_of_the_whole_graph_are_those_of_the_closed_form(in_stretches: bool, hand_eye: bool) -> None:
    smoother, e = _problem(in_stretches=in_stretches, hand_eye=hand_eye, seed=5)
    cov = np.linalg.inv(elimination.remaining(smoother.links, smoother.linearised(e)))
    found = smoother.marginals(e)
    n = 3 * N_PLACES
    np.testing.assert_allclose(found.places, cov[:n, :n], rtol=1e-6, atol=1e-9 * cov[:n, :n].max())
    if hand_eye:
        np.testing.assert_allclose(found.hand_eye, cov[n:, n:], rtol=1e-6, atol=1e-9 * cov[n:, n:].max())
    assert (found.hand_eye is None) == (not hand_eye)


def test_nothing_seen_leaves_the_poses_as_they_are_given() -> None:
    smoother, e = _problem(in_stretches=False, hand_eye=False, seed=6)
    none = np.full(len(smoother.frames), -1)
    pairs = Pairs(none, *(np.empty(0, dtype=np.int64),) * 2, np.empty(0), np.empty(0, dtype=np.int64), np.empty(0))
    empty = BatchSmoother(smoother.frames, smoother.poses, none, pairs)
    moved, change = empty.step(replace(e, places=np.empty((0, 3)), d=np.empty((0, 3))))
    assert change == 0.0
    np.testing.assert_allclose(moved.T, smoother.poses.given, atol=1e-5)  # a Gauss-Newton step from 1e-3 away


def test_degrees_of_freedom_that_unknowns_take_are_those_of_each_frame_alone() -> None:
    """Against the trace of the influence matrix of each frame's own least squares."""
    smoother, e = _problem(in_stretches=False, hand_eye=True, seed=7)
    used = np.random.default_rng(7).random(len(smoother.rows)) < 0.9
    A_z, A_d, _ = smoother.whitened(e)
    prior = smoother.pose_information(e)
    poses, displacements = _taken_up(smoother, A_z, A_d, used, prior)
    by_hand = np.zeros(2)
    for i in range(N_FRAMES):
        here = np.flatnonzero(used & (smoother.frame == i))
        pairs, column = np.unique(smoother.pair[here], return_inverse=True)
        J = np.zeros((len(here), 3, 6 + 3 * len(pairs)))
        J[:, :, :6] = A_z[here]
        for k, c in enumerate(column):
            J[k, :, 6 + 3 * c : 9 + 3 * c] = A_d[here[k]]
        J = J.reshape(-1, J.shape[2])
        P = np.zeros((J.shape[1], J.shape[1]))
        P[:6, :6] = prior[i]
        P[6:, 6:] = np.diag(np.repeat(smoother.pairs.total_sigma[pairs] ** -2, 3))
        taken = np.diag(np.linalg.solve(J.T @ J + P, J.T @ J))
        by_hand += taken[:6].sum(), taken[6:].sum()
    np.testing.assert_allclose([poses, displacements.sum()], by_hand, rtol=1e-9)


def test_what_is_not_determined_ends_in_a_word(monkeypatch: pytest.MonkeyPatch) -> None:
    """LAPACK's words for it help nobody."""
    smoother, start = _problem(in_stretches=False, hand_eye=False, seed=1)
    indefinite = 2.0 * np.ones((3 * N_PLACES, 3 * N_PLACES)) - np.eye(3 * N_PLACES)
    monkeypatch.setattr("cluster_slam.graph.whole.remaining", lambda *_: indefinite)
    with pytest.raises(EstimationError, match="do not determine"):
        smoother.marginals(start)
