"""Errors of flowers that last: found from residuals, and carried into covariances."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cluster_slam import smooth
from cluster_slam.association.frames import Frames
from cluster_slam.evaluation.metrics import evaluate
from cluster_slam.geometry import Array, inverse, rotate_cov, se3_exp, transform
from cluster_slam.graph import elimination, whole
from cluster_slam.graph.batch import BatchSmoother, Estimate, Pairs
from cluster_slam.graph.poses import PoseModel
from cluster_slam.records import IntArray, Session, Truth
from cluster_slam.simulate import PRESETS, simulate_session
from cluster_slam.smoothing.lasting import LastingErrors, lasting_errors, one_view, turns, views
from cluster_slam.smoothing.looks import COMMON, Looks, looks

PLACES = np.array([[x, y, 0.0] for x in (-0.25, 0.0, 0.25) for y in (-0.15, 0.15) for _ in range(2)])
PLACES[1::2] += [0.02, 0.01, 0.005]
CLUSTER = np.repeat(np.arange(6), 2)
LASTING = LastingErrors(along_m=0.001, across_m=0.0005, new_along=1.0, new_across=1.0, turn=0.6)


def _round_about(n: int, rng: np.random.Generator) -> Array:
    """Camera poses (n, 4, 4) half a metre away that turn to and fro about the flowers."""
    angle = 0.6 * np.sin(np.linspace(0, 9, n))
    tangent = np.column_stack([0.5 * angle, angle, 0.3 * angle, np.zeros((n, 3))])
    away = np.tile(np.eye(4), (n, 1, 1))
    away[:, 2, 3] = -0.55
    poses: Array = se3_exp(tangent + rng.normal(0, 0.02, tangent.shape)) @ away
    return poses


def _errors_that_last(
    view: Array, flower: IntArray, lasting: LastingErrors, points: Array, rng: np.random.Generator
) -> Array:
    """Drawn (m, 3), camera frame: of each flower for itself, alike where views are."""
    out = np.zeros((len(view), 3))
    for j in np.unique(flower[flower >= 0]):
        k = np.flatnonzero(flower == j)
        rho = lasting.correlation(view[k], view[k]) + 1e-6 * np.eye(len(k))
        drawn = np.linalg.cholesky(rho) @ rng.normal(size=(len(k), 3))
        out[k] = (lasting.root(points[k]) @ drawn[..., None])[..., 0]
    return out


def _frames(n: int, seed: int, lasting: LastingErrors | None) -> tuple[Frames, Array, IntArray]:
    rng = np.random.default_rng(seed)
    T = _round_about(n, rng)
    frame, flower = np.repeat(np.arange(n), len(PLACES)), np.tile(np.arange(len(PLACES)), n)
    points = transform(inverse(T)[frame], PLACES[flower])
    covs = np.tile(np.diag([0.0012, 0.0012, 0.002]) ** 2, (len(frame), 1, 1))
    starts = np.arange(n + 1) * len(PLACES)
    frames = Frames(np.arange(len(frame)), starts, frame, points, covs, np.arange(n) / 30)
    noisy = points + rng.normal(size=points.shape) @ np.linalg.cholesky(covs[0])
    if lasting is not None:
        noisy += _errors_that_last(views(frames, T), flower, lasting, points, rng)
    return replace(frames, points=noisy), T, flower


def test_turns_are_angles() -> None:
    axis = np.array([0.2, -0.5, 0.8]) / np.linalg.norm([0.2, -0.5, 0.8])
    R = se3_exp(np.concatenate([0.3 * axis, np.zeros(3)]))[:3, :3]
    assert turns(np.eye(3)[None], R[None])[0, 0] == pytest.approx(2.0 * np.sin(0.15), abs=1e-12)
    assert one_view(np.stack([np.eye(3), R, np.eye(3)]), 0.2).tolist() == [0, 1, 0]


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_what_lasts_is_found_with_its_size(seed: int) -> None:
    frames, T, flower = _frames(300, seed, LASTING)
    used = np.ones(len(frames), bool)
    found = lasting_errors(frames, T, flower, PLACES, CLUSTER, used)
    assert found is not None
    # six pairs with about five views that differ: sigmas of 18 % along, of two axes 13 % across, and the turn's part
    assert found.along_m == pytest.approx(LASTING.along_m, rel=0.5)
    assert found.across_m == pytest.approx(LASTING.across_m, rel=0.5)
    assert found.new_along == pytest.approx(1.0, abs=0.1)
    assert found.new_across == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("seed", range(8))
def test_new_errors_do_not_last(seed: int) -> None:
    frames, T, flower = _frames(150, seed, None)
    assert lasting_errors(frames, T, flower, PLACES, CLUSTER, np.ones(len(frames), bool)) is None


def test_flowers_follow_from_looks_as_from_all_at_once() -> None:
    """Against generalised least squares on the observations themselves, poses known."""
    frames, T, flower = _frames(40, 5, LASTING)
    by = looks(frames, T, flower, len(PLACES), LASTING)
    cov = rotate_cov(T[frames.frame, :3, :3], frames.covs)
    W = np.linalg.solve(cov, np.tile(np.eye(3), (len(cov), 1, 1)))
    n = len(by.flower)
    H, g = by.tied.copy(), np.zeros(3 * n)
    world = transform(T[frames.frame], frames.points)
    for k, a in enumerate(by.of):
        H[3 * a : 3 * a + 3, 3 * a : 3 * a + 3] += W[k]
        g[3 * a : 3 * a + 3] += W[k] @ world[k]
    found = by.mean @ np.linalg.solve(H, g)
    claimed = by.mean @ np.linalg.solve(H, by.mean.T) + by.left
    expected, information = _at_once(by, frames, T, W, world)
    np.testing.assert_allclose(found, expected, atol=1e-6)
    np.testing.assert_allclose(claimed, np.linalg.solve(information, np.eye(len(information))), rtol=2e-3, atol=1e-10)


def _at_once(by: Looks, frames: Frames, T: Array, W: Array, world: Array) -> tuple[Array, Array]:
    """Places of flowers and their information, from the mean of each look's observations and how these err."""
    n, view = len(by.flower), views(frames, T)
    block, moment = np.zeros((3 * n, 3 * n)), np.zeros(3 * n)
    roots, centres = np.zeros((n, 3, 3)), np.zeros((n, 3, 3))
    for k, a in enumerate(by.of):
        block[3 * a : 3 * a + 3, 3 * a : 3 * a + 3] += W[k]
        moment[3 * a : 3 * a + 3] += W[k] @ world[k]
        R, share = T[frames.frame[k], :3, :3], 1.0 / np.sum(by.of == a)
        roots[a] += share * R @ LASTING.root(frames.points[k : k + 1])[0] @ R.T
        centres[a] += share * view[k]
    C = np.linalg.solve(block, np.eye(3 * n))
    for a in range(n):
        for b in range(n):
            alike = 1.0 if by.flower[a] == by.flower[b] else COMMON
            alike *= np.exp(-np.linalg.norm(centres[a] - centres[b]) / np.sqrt(2) / LASTING.turn)
            C[3 * a : 3 * a + 3, 3 * b : 3 * b + 3] += alike * roots[a] @ roots[b].T
    one = np.kron(np.eye(len(PLACES))[by.flower], np.eye(3))
    by_one = np.linalg.solve(C, one)
    information = one.T @ by_one
    return np.linalg.solve(information, by_one.T @ np.linalg.solve(block, moment)), information


def test_what_ties_looks_says_nothing_of_where_flowers_are() -> None:
    frames, T, flower = _frames(40, 6, None)
    by = looks(frames, T, flower, len(PLACES), LASTING)
    one = np.kron(np.eye(len(PLACES))[by.flower], np.eye(3))
    np.testing.assert_allclose(by.tied @ one, 0.0, atol=1e-6 * np.abs(by.tied).max())
    np.testing.assert_allclose(by.mean @ one, np.eye(3 * len(PLACES)), atol=1e-9)
    assert np.linalg.eigvalsh(by.left).min() > 0


def test_tied_places_in_closed_form_and_in_gtsam() -> None:
    frames, T, flower = _frames(20, 7, LASTING)
    by = looks(frames, T, flower, len(PLACES), LASTING)
    model = PoseModel(T, np.diag(np.repeat([2e-3, 1e-3], 3) ** 2), None, None, np.eye(6))
    pair = 6 * frames.frame + CLUSTER[flower]
    n = 6 * frames.n_frames
    pairs = Pairs(pair, np.arange(n) // 6, np.arange(n) % 6, np.full(n, 1e-3), np.full(n, -1), np.empty(0))
    smoother = BatchSmoother(frames, model, by.of, pairs, tied=by.tied)
    places = PLACES[by.flower]
    e = Estimate(T, None, places, np.zeros((n, 3)), np.ones(len(frames)), np.full(len(frames), np.nan))
    at = smoother.linearised(e)
    one, two = elimination.remaining(smoother.links, at), whole.remaining(smoother.links, at)
    np.testing.assert_allclose(one, two, rtol=1e-6, atol=1e-6 * np.abs(two).max())


@pytest.fixture(scope="module")
def biased() -> tuple[Session, Truth]:
    """A session whose detector errs with the view."""
    made = simulate_session(replace(PRESETS["moderate"], duration_s=20.0), seed=4)
    seen, truth = made.session.observations, made.truth
    assert truth.flower_ids is not None
    assert truth.T_world_camera is not None
    starts = np.searchsorted(seen.frame, np.arange(len(made.session.stamps) + 1))
    frames = Frames(np.arange(len(seen)), starts, seen.frame, seen.points, seen.covs, made.session.stamps)
    lasting = replace(LASTING, along_m=0.0015, across_m=0.0015)
    drawn = _errors_that_last(
        views(frames, truth.T_world_camera), truth.flower_ids, lasting, seen.points, np.random.default_rng(0)
    )
    return replace(made.session, observations=replace(seen, points=seen.points + drawn)), truth


def test_covariances_are_true_where_errors_last(biased: tuple[Session, Truth]) -> None:
    """All as if errors were new in each frame, their NEES is 3.5."""
    session, truth = biased
    result = smooth(session)
    metrics = evaluate(result, session, truth)
    assert result.diagnostics.estimated_noise["flower_lasting_across"] == pytest.approx(0.0015, rel=0.3)
    assert metrics.nees_flowers is not None
    # Of some fifty flowers, whose errors have the hand-eye transform's in common.
    assert 0.5 < metrics.nees_flowers < 1.7
