"""Instruments that err, and maps on both sides of a gap."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cluster_slam.association.calibration import Calibration, calibrate, delayed, follow_points, pairs_of
from cluster_slam.association.compatibility import match_jointly
from cluster_slam.association.drift_smoother import Steps
from cluster_slam.association.frames import Frames, sort_by_frame
from cluster_slam.association.submaps import (
    Part,
    gap_cov,
    identified,
    joined,
    motions,
    sides,
    spans_between_gaps,
    window,
)
from cluster_slam.config import ParticleConfig
from cluster_slam.geometry import Array, inverse, se3_exp, se3_log, transform
from cluster_slam.records import IntArray, Observations

_PLACES = np.array([[2.0, 0, 3.0], [2.6, 0, 3.3], [-2.0, 0, 3.0], [0.0, 0, -3.0], [3.0, 0, -1.0], [-3.0, 0, -1.0]])
_DT = 0.2


def _way(n: int, ahead: int) -> Array:
    """Poses (n, 4, 4) of a vehicle that turns left and right by turns, ``ahead`` quarters of a step later."""
    fine = np.tile(np.eye(4), (4 * n + 8, 1, 1))
    for i in range(1, len(fine)):
        rate = 0.8 * np.sin(i / 12.0) + 0.15
        fine[i] = fine[i - 1] @ se3_exp(0.25 * _DT * np.array([0, rate, 0, 0, 0, 0.15]))
    return fine[4 + ahead : 4 * n + 4 + ahead : 4]


def _drive(seed: int, sigma: float = 0.02, n: int = 300) -> tuple[Frames, Array, IntArray]:
    """Points that a vehicle sees on a way that turns left and right by turns, its true poses, and labels."""
    rng = np.random.default_rng(seed)
    T = _way(n, 0)
    seen = transform(inverse(T)[:, None], np.broadcast_to(_PLACES, (n, *_PLACES.shape)))
    visible = (seen[..., 2] > 0.3) & (np.abs(seen[..., 0]) < seen[..., 2])
    frame, label = np.nonzero(visible)
    noise = sigma * rng.standard_normal((len(frame), 3)) * [1, 0, 1]
    covs = np.tile(np.diag([0.05**2, 1e-4, 0.1**2]), (len(frame), 1, 1))
    observations = Observations(frame, seen[visible] + noise, covs, np.full(len(frame), np.nan))
    return sort_by_frame(observations, _DT * np.arange(n)), T, label


def test_depth_taken_for_range_is_found_and_undone() -> None:
    """Lengths along the ray that were given as z: the power is one, and the correction brings the points back."""
    frames, T, _ = _drive(1)
    cosine = frames.points[:, 2] / np.linalg.norm(frames.points, axis=1)
    short = replace(frames, points=frames.points * cosine[:, None])
    found = calibrate(short, T, ParticleConfig())
    assert found.power == pytest.approx(1.0, abs=0.05)
    assert found.lag_s == pytest.approx(0.0, abs=0.02)
    back = replace(found, power=1.0).correct(short)
    np.testing.assert_allclose(back.points, frames.points, atol=1e-12)
    u = frames.points / np.linalg.norm(frames.points, axis=1)[:, None]
    factor = np.einsum("ni,nij,nj->n", u, back.covs, u) / np.einsum("ni,nij,nj->n", u, frames.covs, u)
    r = np.linalg.norm(frames.points, axis=1)
    expected = np.minimum(found.along * (r / found.middle_m) ** found.growth, 1.0)
    np.testing.assert_allclose(factor, expected**2, rtol=0.05)  # ranges before and after the correction
    assert 0.2 < found.along < 0.8  # stated 0.1 m, true 0.02 m, and twice that for what repeats
    assert found.growth < 0.3


def test_noise_that_grows_with_the_range_is_found() -> None:
    frames, T, _ = _drive(1, 1e-3)
    r = np.linalg.norm(frames.points, axis=1)
    u = frames.points / r[:, None]
    error = 0.004 * r**1.5 * np.random.default_rng(2).standard_normal(len(r))
    cosine = u[:, 2]
    round_covs = np.broadcast_to(0.1**2 * np.eye(3), frames.covs.shape)
    short = replace(frames, points=(frames.points + error[:, None] * u) * cosine[:, None], covs=round_covs)
    found = calibrate(short, T, ParticleConfig())
    assert found.growth == pytest.approx(1.5, abs=0.25)
    at_middle = 2.0 * 0.004 * found.middle_m**1.5 / 0.1  # twice, for what repeats
    assert found.along == pytest.approx(at_middle, rel=0.3)  # points a of the pairs are from other ranges


@pytest.mark.parametrize("quarters", [-3, 4])
def test_odometry_ahead_of_the_camera_is_found(quarters: int) -> None:
    """Poses that say now what the camera sees some quarters of a step later."""
    frames, _, _ = _drive(2)
    found = calibrate(frames, _way(frames.n_frames, quarters), ParticleConfig())
    assert found.lag_s == pytest.approx(0.25 * quarters * _DT, abs=0.03)
    assert found.power == 0.0


def test_sound_instruments_are_left_alone() -> None:
    for seed in range(2):
        frames, T, _ = _drive(seed)
        assert calibrate(frames, T, ParticleConfig()) == Calibration()
    assert calibrate(frames, T, ParticleConfig(calibrate=False)) == Calibration()


def test_poses_that_jitter_are_no_late_clock() -> None:
    """Between two poses noise is less than in each: half a step's delay would look better, either way."""
    frames, T, _ = _drive(3)
    rng = np.random.default_rng(5)
    noisy = T @ se3_exp(np.array([0, 0.01, 0, 0.03, 0, 0.03]) * rng.standard_normal((len(T), 6)))
    assert calibrate(frames, noisy, ParticleConfig()).lag_s == 0.0


def test_what_only_a_part_of_the_session_says_is_not_believed() -> None:
    """Points that lie too near off the axis, and later too far, as where things moved: no instrument errs so."""
    frames, T, _ = _drive(1)
    cosine = frames.points[:, 2] / np.linalg.norm(frames.points, axis=1)
    power = np.where(frames.frame < 0.55 * frames.n_frames, 1.0, -0.5)
    found = calibrate(replace(frames, points=frames.points * (cosine**power)[:, None]), T, ParticleConfig())
    assert found.power == 0.0


def test_pieces_are_pure_and_pairs_lie_within_the_span() -> None:
    frames, T, label = _drive(3)
    piece = follow_points(frames, T, 1.0)
    assert all(len(np.unique(label[piece == p])) == 1 for p in np.unique(piece))
    a, b = pairs_of(frames, piece, 0.5)
    assert len(a) > 0
    assert (piece[a] == piece[b]).all()
    dt = frames.stamps[frames.frame[b]] - frames.stamps[frames.frame[a]]
    assert dt.min() > 0
    assert dt.max() <= 0.5


def test_delay_of_a_steady_turn_is_a_constant_angle() -> None:
    T = se3_exp(np.outer(np.arange(10), [0, 0.1, 0, 0, 0, 0.2]))
    late = delayed(T, _DT * np.arange(10), 0.5 * _DT)
    np.testing.assert_allclose(late[5], se3_exp(np.array([0, 0.45, 0, 0, 0, 0.9])), atol=1e-12)
    np.testing.assert_allclose(late[0], T[0], atol=1e-12)


def _two_parts(z: Array) -> tuple[Part, Part, Steps, Array]:
    """Two parts of two frames each that saw the same landmarks; odometry in the gap between them errs by z."""
    basis = np.eye(6)[:, [1, 3, 5]]
    true = se3_exp(
        np.array([[0, 0, 0, 0, 0, 0], [0, 0.1, 0, 0, 0, 0.1], [0, 1.0, 0, 0.5, 0, 1], [0, 1.1, 0, 0.5, 0, 1.1]])
    )
    motion = inverse(true[:-1]) @ true[1:]
    motion[1] = motion[1] @ se3_exp(basis @ -z)
    cov = np.stack([np.diag([0.3, 1.0, 1.0]) ** 2 if k == 1 else 1e-6 * np.eye(3) for k in range(3)])
    steps = Steps(motion, basis, cov, np.full(3, 3.0), np.array([1.0, 50.0, 1.0]))
    frame, label = np.repeat([0, 1], len(_PLACES)), np.tile(np.arange(len(_PLACES)), 2)
    var = np.full(len(_PLACES), 0.02**2)
    elsewhere = se3_exp(np.array([0, 2.0, 0, 4, 0, -3]))
    a = Part(0, 2, true[:2], label, _PLACES, var, frame)
    b = Part(2, 4, elsewhere @ true[2:], label, transform(elsewhere, _PLACES), var, frame)
    return a, b, steps, true


def _matched(a: Part, b: Part, steps: Steps) -> Part:
    """Part b joined to part a by the likeliest of the joint matches."""
    n = 3 * len(_PLACES)
    both, prior = sides(a, b, (np.zeros((n, n)), np.zeros((n, n))), steps), gap_cov(a, b, steps)
    starts = motions(*both, prior, steps.basis, 20)
    np.testing.assert_allclose(starts[0].z, 0.0)
    best = max((match_jointly(*both, s, prior, steps.basis, 3.0) for s in starts), key=lambda match: match.score)
    return identified(joined(a, b, best.z, steps), a, best.pairs)


@pytest.mark.parametrize("z", [np.zeros(3), np.array([0.4, -0.8, 0.6]), np.array([-0.5, 0.3, 1.2])])
def test_motion_in_a_gap_is_found_from_the_landmarks(z: Array) -> None:
    a, b, steps, true = _two_parts(z)
    whole = _matched(a, b, steps)
    np.testing.assert_array_equal(whole.label, np.tile(np.arange(len(_PLACES)), 4))
    np.testing.assert_allclose(whole.T, true, atol=0.02)


def test_the_part_before_is_joined_like_the_part_after() -> None:
    a, b, steps, _ = _two_parts(np.array([0.4, -0.8, 0.6]))
    best = _matched(b, a, steps)
    assert (best.first, best.end, len(best.T)) == (0, 4, 4)
    np.testing.assert_array_equal(best.label, np.tile(np.arange(len(_PLACES)), 4))
    np.testing.assert_allclose(inverse(best.T[1]) @ best.T[2], _true_gap(), atol=0.03)


def test_covariance_in_a_gap_is_the_same_from_either_side() -> None:
    """Where b stands beside a, drawn through the gap forwards and backwards."""
    a, b, steps, _ = _two_parts(np.zeros(3))
    rng = np.random.default_rng(0)
    drawn = steps.motion[1] @ se3_exp(1e-3 * rng.standard_normal((20_000, 3)) * [0.3, 1.0, 1.0] @ steps.basis.T)
    forwards = se3_log(inverse(steps.motion[1]) @ drawn) @ steps.basis
    backwards = se3_log(steps.motion[1] @ inverse(drawn)) @ steps.basis
    np.testing.assert_allclose(1e6 * np.cov(forwards.T), gap_cov(a, b, steps), atol=0.04)
    np.testing.assert_allclose(1e6 * np.cov(backwards.T), gap_cov(b, a, steps), atol=0.08)


def _true_gap() -> Array:
    before, after = se3_exp(np.array([[0, 0.1, 0, 0, 0, 0.1], [0, 1.0, 0, 0.5, 0, 1]]))
    return np.asarray(inverse(before) @ after)


def test_gaps_bound_the_parts_and_windows_hold_their_points() -> None:
    frames, _, _ = _drive(4, n=40)
    length = np.ones(39)
    length[[9, 24]] = 30.0, 12.0
    steps = Steps(np.tile(np.eye(4), (39, 1, 1)), np.eye(6), np.tile(np.eye(6), (39, 1, 1)), length, length)
    assert spans_between_gaps(steps, 40, 25.0) == [(0, 10), (10, 40)]
    part = window(frames, 10, 25)
    assert part.n_frames == 15
    inside = (frames.frame >= 10) & (frames.frame < 25)
    np.testing.assert_array_equal(part.points, frames.points[inside])
    np.testing.assert_array_equal(part.frame, frames.frame[inside] - 10)
    assert len(steps.between(10, 25).motion) == 14
