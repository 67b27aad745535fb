"""A vehicle on a floor in a map of landmarks that nobody can tell apart."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cluster_slam.association.calibration import delayed
from cluster_slam.geometry import Array, inverse, se3_exp, se3_log, transform
from cluster_slam.localisation.beliefs import Beliefs, everywhere
from cluster_slam.localisation.instruments import news_of, put_right
from cluster_slam.localisation.landmarks import Landmarks, landmarks
from cluster_slam.localisation.motion import motion_of
from cluster_slam.localisation.planar import flat_world
from cluster_slam.localisation.vehicle import FlatFollower
from cluster_slam.pipeline.localise import localise
from cluster_slam.records import Observations, Session, StatedNoise

PLACES = np.array([[0.0, 0.0], [3.1, 0.4], [5.2, 2.9], [1.2, 3.3], [-1.4, 1.9], [3.4, 5.6], [-0.6, 5.0], [6.4, 5.1]])


def drive(n: int, rng: np.random.Generator, gain: float = 0.0) -> tuple[Session, Array, Landmarks]:
    """A session of odometry on the plane y = 0 of the camera, its true poses in the map, and the map."""
    t = 0.5 * np.arange(n)
    x, z = 2.5 + 1.6 * np.sin(0.11 * t), 2.7 + 1.6 * np.sin(0.17 * t + 1.0)
    heading = np.arctan2(np.gradient(x), np.gradient(z))
    tangents = np.zeros((n, 6))
    tangents[:, 1] = heading
    flat = se3_exp(tangents)
    flat[:, 0, 3], flat[:, 2, 3] = x, z
    upright = se3_exp(np.array([-np.pi / 2, 0.0, 0.0, 0.0, 0.0, 0.0]))  # the map's z is up
    true = upright @ flat
    marks = landmarks(transform(upright, np.column_stack([PLACES[:, 0], np.zeros(8), PLACES[:, 1]])), np.arange(8))
    step = inverse(flat[:-1]) @ flat[1:]
    error = np.zeros((n - 1, 6))
    error[:, 1], error[:, 5] = 0.01 * rng.normal(size=n - 1), 0.01 * rng.normal(size=n - 1)
    given = [np.eye(4)]
    for k in range(n - 1):
        given.append(given[-1] @ step[k] @ se3_exp(error[k]))
    frame, points = [], []
    for k in range(n):
        seen = transform(inverse(true[k]), marks.positions)
        here = seen[(seen[:, 2] > 0.3) & (np.abs(seen[:, 0]) < 0.7 * seen[:, 2])]
        r = np.linalg.norm(here, axis=1)
        noisy = here * (1.0 + gain + 0.02 * rng.normal(size=len(here)) / r)[:, None]
        noisy[:, 0] += 0.01 * r * rng.normal(size=len(here))
        noisy[:, 1] = 0.0
        frame += [k] * len(here)
        points += list(noisy)
    m = len(points)
    seen_all = Observations(
        np.array(frame), np.array(points), np.tile(np.diag([0.03, 0.01, 0.04]) ** 2, (m, 1, 1)), np.full(m, np.nan)
    )
    noise = replace(StatedNoise(), odometry_translation=0.05, odometry_rotation=0.1)
    session = Session("drive", 100.0 + t, np.array(given), "T_world_camera", "odometry", None, noise, seen_all)
    return session, true, marks


@pytest.mark.parametrize(("seed", "gain"), [(0, 0.0), (1, 0.04)])
def test_a_vehicle_is_found_also_where_its_ranges_are_too_long(seed: int, gain: float) -> None:
    session, true, marks = drive(160, np.random.default_rng(seed), gain)
    found = localise(session, [marks])
    here = found.is_located
    assert here[-60:].mean() > 0.9
    xi = se3_log(inverse(found.T_map_camera[here]) @ true[here])
    away = np.linalg.norm(xi[:, 3:], axis=1)
    assert np.median(away) < 0.06
    assert (away < 0.5).all()


def test_what_is_not_flat_is_no_floor() -> None:
    session, _, marks = drive(20, np.random.default_rng(2))
    assert flat_world(session, motion_of(session), marks) is not None
    tall = landmarks(marks.positions + np.random.default_rng(3).normal(0.0, 0.5, (8, 3)), np.arange(8))
    assert flat_world(session, motion_of(session), tall) is None


def test_a_clock_of_odometry_that_is_ahead_does_not_move_the_frames() -> None:
    """Frames are where the camera was when it looked, whatever odometry's clock says."""
    session, true, _ = drive(300, np.random.default_rng(4))
    ahead = replace(session, poses=delayed(session.poses, session.stamps, -0.4))  # shows what comes 0.4 s later
    right, steps = put_right(ahead).session, inverse(true[:-1]) @ true[1:]
    off = [se3_log(inverse(inverse(P[:-1]) @ P[1:]) @ steps)[20:-20] for P in (ahead.poses, right.poses)]
    before, after = (float(np.sqrt((x[:, 1] ** 2).mean())) for x in off)
    assert after < 0.8 * before
    assert after < 0.013  # odometry's own noise is 0.01 rad a step


def test_points_of_a_piece_count_for_less_the_closer_they_follow() -> None:
    piece, times = np.array([0, 1, 0, 0, 1]), np.array([0.0, 0.0, 0.1, 60.0, 10.0])
    news = news_of(piece, times)
    np.testing.assert_array_equal(news[:2], 1.0)
    c = 0.8 * np.exp(-1.0)
    assert news[4] == pytest.approx((1.0 - c) / (1.0 + c))
    assert news[2] < 0.13
    assert news[3] > 0.99


def test_views_of_beliefs_have_the_numerical_derivative() -> None:
    mean = np.array([[0.3, -0.2, 0.7, 0.04, 0.06], [1.0, 2.0, -2.0, -0.02, -0.03]])
    cov, marks = np.tile(np.diag([0.01, 0.02, 0.001, 1e-4, 1e-4]), (2, 1, 1)), np.array([[[2.0, 1.0]], [[0.5, 0.1]]])
    rows, q = np.arange(2), np.array([1.0, 0.5])

    def expected(m: Array) -> Array:
        return q - Beliefs(m, cov, np.ones(2), np.zeros(2)).views(rows, q, marks)[0][:, 0]

    _, H, HPH = Beliefs(mean, cov, np.ones(2), np.zeros(2)).views(rows, q, marks)
    step = 1e-6 * np.eye(5)
    numeric = np.stack([(expected(mean + e) - expected(mean - e)) / 2e-6 for e in step], axis=-1)
    np.testing.assert_allclose(H[:, 0], numeric, atol=1e-8)
    np.testing.assert_allclose(HPH[:, 0], numeric @ cov @ np.swapaxes(numeric, 1, 2), rtol=1e-6)


def test_one_point_leaves_every_heading_and_side_open() -> None:
    """Each belief sees the point where it was, and is as unsure along the ray as point, gain and offset are."""
    q, S = np.array([3.0, 0.5]), np.diag([0.01, 0.01]) ** 2
    beliefs = everywhere(q, S, PLACES)
    places = PLACES[np.arange(8).repeat(144)] * np.column_stack([np.ones(len(beliefs)), beliefs.side])
    off, _, HPH = beliefs.views(np.arange(len(beliefs)), q, places[:, None])
    np.testing.assert_allclose(off, 0.0, atol=1e-6)
    assert (np.trace(HPH[:, 0], axis1=1, axis2=2) < 2.1 * 0.01**2).all()  # of where it is seen: the point's own
    away = np.sqrt(beliefs.cov[:, 0, 0] + beliefs.cov[:, 1, 1])
    lever = np.hypot(3.0, 0.5)
    sigma = np.sqrt(2 * 0.01**2 + (0.03 * lever) ** 2 + 0.05**2 + (np.pi / 72 * lever) ** 2)
    np.testing.assert_allclose(away, sigma, rtol=0.01)


def follower_of(session: Session, marks: Landmarks) -> FlatFollower:
    motion = motion_of(session)
    flat = flat_world(session, motion, marks)
    assert flat is not None
    return FlatFollower(flat, marks, motion, np.random.default_rng(5))


def test_a_place_is_as_wide_as_it_is_stated_and_two_places_stay_two() -> None:
    """Beliefs that are normally distributed are one place, also where that is wider than landmarks are apart."""
    session, _, marks = drive(20, np.random.default_rng(6))
    follower, rng, n = follower_of(session, marks), np.random.default_rng(7), 2000
    mean = np.zeros((n, 5))
    mean[:, :3] = rng.normal(size=(n, 3)) * [3.0, 2.0, 0.2]
    own = np.tile(np.diag([0.1, 0.1, 0.01, 1e-4, 1e-4]) ** 2, (n, 1, 1))
    one = Beliefs(mean, own, np.ones(n), np.zeros(n))
    assert follower._mode(one, one.weights).mean() > 0.97  # 0.99 of the Gaussian itself
    apart = mean * [0.1, 0.1, 0.1, 1.0, 1.0]
    apart[: n // 4, 0] += 8.0
    two = Beliefs(apart, own, np.ones(n), np.zeros(n))
    assert follower._mode(two, two.weights).mean() == pytest.approx(0.75, abs=0.01)


def test_all_is_not_begun_from_a_point_that_nothing_follows() -> None:
    session, _, marks = drive(20, np.random.default_rng(8))
    follower = follower_of(session, marks)
    assert follower._beginning(np.array([1.0])) == -1
    assert follower._beginning(np.array([1.0, 0.2, 1.0])) == 1
    assert [follower._beginning(np.ones(1)) for _ in range(6)] == [-1] * 5 + [0]
    assert follower._beginning(np.zeros(0)) == -1


def test_who_stands_elsewhere_is_not_sure_for_long_and_finds_back() -> None:
    """All beliefs in one wrong place: what is begun beside them explains the points better and replaces them."""
    session, true, marks = drive(160, np.random.default_rng(9))
    follower, o = follower_of(session, marks), session.observations
    off = np.full(session.n_frames, np.nan)
    for i in range(session.n_frames):
        rows = np.flatnonzero(o.frame == i)
        if i == 60:
            assert follower.beliefs is not None
            follower.beliefs.mean[:, :3] += [3.0, -2.0, 2.0]
        place = follower.step(i, o.points[rows], o.covs[rows], np.full(len(rows), 0.3 if i % 5 else 1.0))
        if place.reason == "":
            off[i] = np.linalg.norm(place.T_map_camera[:3, 3] - true[i, :3, 3])
    assert np.nanmax(off[:60]) < 0.5
    assert (off[60:] > 0.5).sum() <= 20  # points until a doubt
    assert (off[-30:] < 0.3).mean() > 0.8


def test_the_likelihood_of_a_point_is_that_of_all_beliefs_together() -> None:
    q, S = np.array([3.0, 0.5]), np.diag([0.1, 0.1]) ** 2
    beliefs = everywhere(np.array([2.0, 0.1]), S, PLACES)
    w = np.random.default_rng(10).random(len(beliefs))
    beliefs.log_weight = np.log(w)
    upright = beliefs.side > 0
    marks = np.where(upright[:, None, None], PLACES, PLACES * [1.0, -1.0])
    off, _, HPH = beliefs.views(np.arange(len(beliefs)), q, marks)
    total = np.zeros(len(beliefs))
    for share, factor in ((0.9, 1.0), (0.1, 16.0)):
        C = HPH + factor * S
        d2 = np.einsum("nki,nki->nk", off, np.linalg.solve(C, off[..., None])[..., 0])
        total += 0.97 * share * (np.exp(-0.5 * d2) / (2.0 * np.pi * np.sqrt(np.linalg.det(C)))).mean(1)
    expected = np.log((w / w.sum()) @ (total + 0.03 / 50.0))
    _, got = beliefs.see(q, S, 1.0, PLACES, 50.0, np.random.default_rng(11))
    assert got == pytest.approx(expected)


def test_a_map_of_another_floor_is_not_believed() -> None:
    session, _, marks = drive(160, np.random.default_rng(12))
    shuffled = np.random.default_rng(13).uniform(-2.0, 7.0, (8, 2))
    places = np.zeros((8, 3))
    places[:, [0, 1]] = shuffled
    wrong = localise(session, [landmarks(places, np.arange(8))])
    assert wrong.is_located.mean() < 0.05
    assert localise(session, [marks]).is_located.mean() > 0.7
